"""The laser's stripe in rendered images: against the true line, and against the error that detection states."""

import numpy as np
import pytest

from lidarpose.detect.chessboard import find_panels
from lidarpose.detect.laser_stripe import StripeFinder
from lidarpose.detect.stripe_noise import not_negative
from lidarpose.simulate.rig import draw_rig, paper_camera
from lidarpose.simulate.session import SimulationOptions, simulate_session


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


def test_a_stripe_that_noise_hides_at_first_is_found(two_panels, finder) -> None:
    """As in dark parts of an image, which a camera's gamma spreads over many grey levels."""
    rng = np.random.default_rng(4)
    normal, offset = sheet(84.0, (0.0, 0.013, 1.0))
    clean = 0.3 * two_panels.stripe(normal, offset, 0.0011) + 0.12 * two_panels.bright()
    noisy = np.round(np.clip(clean + rng.normal(0.0, 16.0, clean.shape), 0.0, 255.0)).astype(np.uint8)
    found = finder.find(noisy)
    assert sorted(found.stripes) == [0, 1]
    for k, points in found.stripes.items():
        error = errors(two_panels, two_panels.boards[k], normal, offset, points)
        assert np.median(np.abs(error / points.sigma_px)) < 1.2


@pytest.mark.parametrize("azimuth_deg", [84.0, 5.0])
def test_rows_and_columns_are_alike(two_panels, shots, finder, azimuth_deg) -> None:
    normal, offset = sheet(azimuth_deg, (-0.09 if azimuth_deg < 45.0 else 0.0, 0.013, 1.0))
    image = two_panels.noisy(two_panels.stripe(normal, offset, 0.0011), np.random.default_rng(3))
    found = finder.find(image)
    mirrored = [np.ascontiguousarray(shot.T) for shot in shots]
    panels = [board.panel for board in two_panels.boards]
    other = StripeFinder(find_panels(mirrored, panels), mirrored).find(np.ascontiguousarray(image.T))
    assert found.stripes
    expected = [points for _, points in sorted(found.stripes.items())]
    for points in other.stripes.values():
        # Mirroring may exchange the panels, which have the same size.
        twin = min(expected, key=lambda p: np.linalg.norm(p.pixels.mean(axis=0) - points.pixels.mean(axis=0)[::-1]))
        assert len(points) == pytest.approx(len(twin), abs=3)
        nearest = np.argmin(((points.pixels[:, None, ::-1] - twin.pixels) ** 2).sum(-1), axis=1)
        off = ((points.pixels[:, ::-1] - twin.pixels[nearest]) * twin.normals[nearest]).sum(-1)
        assert np.median(np.abs(off / twin.sigma_px[nearest])) < 0.5
        assert np.median(points.sigma_px) == pytest.approx(np.median(twin.sigma_px), rel=0.15)
    assert len(other.stripes) == len(found.stripes)


def test_images_fitted_together_do_not_matter_to_each_other(two_panels, finder) -> None:
    rng = np.random.default_rng(5)
    images = [np.zeros((two_panels.height, two_panels.width), np.uint8)]
    for azimuth_deg in (90.0, 5.0, 75.0, 130.0):
        normal, offset = sheet(azimuth_deg, (-0.09 if azimuth_deg < 45.0 else 0.0, 0.013, 1.0))
        images.append(two_panels.noisy(two_panels.stripe(normal, offset, 0.0011, 60.0 + azimuth_deg), rng))
    together = finder.find_in([images[k] for k in (2, 1, 0, 4, 3)])
    assert not together[2].stripes
    for image, found in zip((images[k] for k in (2, 1, 0, 4, 3)), together, strict=True):
        alone = finder.find(image)
        assert alone.problems == found.problems
        assert alone.stripes.keys() == found.stripes.keys()
        for k, points in alone.stripes.items():
            np.testing.assert_allclose(found.stripes[k].pixels, points.pixels, atol=1e-3)
            np.testing.assert_allclose(found.stripes[k].sigma_px, points.sigma_px, rtol=1e-2)


@pytest.mark.parametrize("level", [25.0, 1500.0])
def test_faint_and_saturated_stripes(two_panels, finder, level) -> None:
    normal, offset = sheet(84.0, (0.0, 0.013, 1.0))
    clean = two_panels.stripe(normal, offset, 0.0011, level)
    found = finder.find(two_panels.noisy(clean, np.random.default_rng(8)))
    assert set(found.stripes) == {0, 1}
    for k, points in found.stripes.items():
        error = errors(two_panels, two_panels.boards[k], normal, offset, points)
        weight = points.sigma_px**-2.0
        # Little light, or only the skirts of it: less exact, and stated so.
        assert weight @ np.abs(error) / weight.sum() < 0.12
        assert np.sqrt(((error / points.sigma_px) ** 2).mean()) < 2.0


def test_a_long_glare_is_not_taken_for_the_stripe(two_panels, finder) -> None:
    normal, offset = sheet(90.0, (0.0, 0.04, 1.0))
    v, u = np.indices((two_panels.height, two_panels.width))
    glare = 900.0 * np.exp(-0.5 * (((u - 420) / 60.0) ** 2 + ((v - 190) / 9.0) ** 2))
    clean = two_panels.stripe(normal, offset, 0.0011) + glare
    found = finder.find(two_panels.noisy(clean, np.random.default_rng(9)))
    assert set(found.stripes) == {0, 1}
    for k, points in found.stripes.items():
        error = errors(two_panels, two_panels.boards[k], normal, offset, points)
        assert np.abs(error).max() < 1.0


def test_a_moved_board_is_named(two_panels, finder) -> None:
    lit = np.roll(two_panels.bright(), 13, axis=1)
    found = finder.find(two_panels.noisy(lit, np.random.default_rng(10)))
    assert not found.stripes
    assert all("moved" in p.reason for p in found.problems)


def test_board_and_stripe_in_one_image(two_panels) -> None:
    normal, offset = sheet(84.0, (0.0, 0.013, 1.0))
    clean = 0.5 * two_panels.bright() + two_panels.stripe(normal, offset, 0.0011, 120.0)
    image = two_panels.noisy(clean, np.random.default_rng(12))
    board = find_panels([image], [b.panel for b in two_panels.boards])
    found = StripeFinder(board, [image]).find(image)
    assert set(found.stripes) == {0, 1}
    for k, points in found.stripes.items():
        error = errors(two_panels, two_panels.boards[k], normal, offset, points)
        weight = points.sigma_px**-2.0
        assert weight @ np.abs(error) / weight.sum() < 0.06


def test_stated_errors_are_true_on_a_simulated_session() -> None:
    rig = draw_rig(4, camera=paper_camera(812, 617), places=5)
    session = simulate_session(rig, options=SimulationOptions(board_shots=2)).session
    shots = [source.load() for source in session.board_images[""]]
    board = find_panels(shots, rig.panels)
    finder = StripeFinder(board, shots)
    centres = [rig.camera.project(T.translation) for T in rig.T_camera_panel[""]]
    standardised, faint = [], []
    for place in (1, 2, 3):
        source = session.places[place].stripe_image
        assert source is not None
        for k, points in finder.find(source.load()).stripes.items():
            panel = int(np.argmin([np.linalg.norm(c - board.corners[k].pixels, axis=1).min() for c in centres]))
            ends = rig.chord(place, panel)
            assert ends is not None
            along = ends[0] + np.linspace(-0.05, 1.05, 8001)[:, None] * (ends[1] - ends[0])
            line = rig.camera.project(rig.T_camera_panel[""][panel] @ along)
            nearest = np.argmin(((points.pixels[:, None] - line[None]) ** 2).sum(-1), axis=1)
            error = ((points.pixels - line[nearest]) * points.normals).sum(-1)
            assert np.abs(error).mean() < 0.1
            standardised.append(error / points.sigma_px)
            faint.append(points.sigma_px > np.quantile(points.sigma_px, 0.75))
    assert len(standardised) == 6
    scores, weak = np.concatenate(standardised), np.concatenate(faint)
    # Strong points' and faint ones' alike.
    assert 0.8 < np.sqrt((scores[~weak] ** 2).mean()) < 1.3
    assert 0.7 < np.sqrt((scores[weak] ** 2).mean()) < 1.3


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


def test_the_noise_model_never_has_a_negative_part() -> None:
    from scipy.optimize import nnls

    rng = np.random.default_rng(3)
    for _ in range(50):
        design = rng.random((8, 3)) * [1.0, 50.0, 1e4] / rng.random((8, 1))
        goal = rng.normal(size=8) + 1.0
        expected, _ = nnls(design, goal)
        found = not_negative(design[None], goal[None])[0]
        np.testing.assert_allclose(found, expected, rtol=1e-6, atol=1e-9)
