"""The laser's stripe in rendered images: against the true line, and against the error that detection states."""

import numpy as np
import pytest

from lidarpose.detect.chessboard import find_panels
from lidarpose.detect.laser_stripe import StripeFinder


@pytest.fixture(scope="module")
def shots(two_panels):
    rng = np.random.default_rng(11)
    return [two_panels.noisy(two_panels.bright(), rng) for _ in range(3)]


@pytest.fixture(scope="module")
def finder(two_panels, shots):
    return StripeFinder(find_panels(shots, [board.panel for board in two_panels.boards]), shots)


def sheet(azimuth_deg: float, through=(0.0, 0.0, 1.0), lean: float = 0.1):
    """Light sheet normal . x = offset; its stripes run at about `azimuth_deg` + 90 degrees in the image."""
    a = np.radians(azimuth_deg)
    normal = np.array([np.cos(a), np.sin(a), lean])
    normal /= np.linalg.norm(normal)
    return normal, float(normal @ np.asarray(through))


def errors(scene, board, normal, offset, points):
    """Signed distances, along the points' normals, from the true centre line (sampled every 0.05 mm)."""
    face = board.rotation[:, 2]
    direction = np.cross(face, normal)
    foot = np.linalg.solve(np.stack([face, normal, direction]), [face @ board.origin, offset, 0.0])
    along = np.linspace(-0.8, 0.8, 32001)[:, None] * direction / np.linalg.norm(direction)
    line = scene.project(foot + along)
    nearest = np.argmin(((points.pixels[:, None] - line[None]) ** 2).sum(-1), axis=1)
    return ((points.pixels - line[nearest]) * points.normals).sum(-1)


@pytest.mark.parametrize("azimuth_deg", [90.0, 75.0, 130.0, 5.0])
@pytest.mark.parametrize("ambient", [0.0, 0.3])
def test_stripes_lie_where_the_sheet_is(two_panels, shots, finder, azimuth_deg, ambient) -> None:
    rng = np.random.default_rng(int(azimuth_deg))
    normal, offset = sheet(azimuth_deg, (-0.09 if azimuth_deg < 45.0 else 0.0, 0.013, 1.0))
    clean = two_panels.stripe(normal, offset, 0.0011) + ambient * two_panels.bright()
    found = finder.find(two_panels.noisy(clean, rng))
    assert found.stripes
    for k, points in found.stripes.items():
        error = errors(two_panels, two_panels.boards[k], normal, offset, points)
        # Points on dark squares are worth little, and say so.
        weight = points.sigma_px**-2.0
        assert weight @ np.abs(error) / weight.sum() < 0.05
        assert 0.3 < np.median(np.abs(error / points.sigma_px)) < 1.2


def test_darkness_has_no_stripe(two_panels, finder) -> None:
    rng = np.random.default_rng(3)
    found = finder.find(two_panels.noisy(0.05 * two_panels.bright(), rng))
    assert not found.stripes
    assert [p.what for p in found.problems] == ["stripe on panel 1", "stripe on panel 2"]
    assert all("no stripe" in p.reason for p in found.problems)


def test_two_lines_are_refused(two_panels, finder) -> None:
    first, second = sheet(90.0, (0.0, 0.05, 1.0)), sheet(85.0, (0.0, -0.04, 1.0))
    clean = two_panels.stripe(*first, 0.0011) + two_panels.stripe(*second, 0.0011)
    found = finder.find(two_panels.noisy(clean, np.random.default_rng(4)))
    assert not found.stripes
    assert all("two lines" in p.reason for p in found.problems)


def test_an_image_of_another_size_is_refused(finder) -> None:
    with pytest.raises(ValueError, match="bright images"):
        finder.find(np.zeros((10, 10), np.uint8))
