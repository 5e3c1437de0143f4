"""Stripes found by compiled kernels: the same that NumPy finds, but for rounding."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
import pytest

from lidarpose.detect.albedo import measure_albedo
from lidarpose.detect.chessboard import find_panels
from lidarpose.detect.laser_stripe import StripeDetection, StripeFinder
from lidarpose.detect.stripe_noise import Samples, learn_noise
from lidarpose.detect.stripe_search import PanelView, find_line, parabola, reduce_image
from lidarpose.geometry import compiled

pytestmark = pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")

AZIMUTHS_DEG = (90.0, 75.0, 130.0, 5.0)
# Pixels have single precision, to which both ways round alike; sums over profiles are double, in another order.
ROUNDING_PX = 1e-9


@pytest.fixture(scope="module")
def shots(two_panels):
    rng = np.random.default_rng(21)
    return [two_panels.noisy(two_panels.bright(), rng) for _ in range(2)]


@pytest.fixture(scope="module")
def images(two_panels):
    """Stripes along rows and columns, faint and saturated, with and without other light; a glare, and nothing."""
    rng = np.random.default_rng(22)
    found = [np.zeros((two_panels.height, two_panels.width), np.uint8)]
    for k, azimuth_deg in enumerate(AZIMUTHS_DEG):
        a = np.radians(azimuth_deg)
        normal = np.array([np.cos(a), np.sin(a), 0.1])
        normal /= np.linalg.norm(normal)
        offset = float(normal @ [-0.09 if azimuth_deg < 45.0 else 0.0, 0.013, 1.0])
        for level in (40.0, 1500.0):
            clean = two_panels.stripe(normal, offset, 0.0011, level) + 0.1 * k * two_panels.bright()
            found.append(two_panels.noisy(clean, rng))
    v, u = np.indices((two_panels.height, two_panels.width))
    glare = 900.0 * np.exp(-0.5 * (((u - 420) / 60.0) ** 2 + ((v - 190) / 9.0) ** 2))
    found.append(two_panels.noisy(clean + glare, rng))
    return found


def found_in(way: bool, two_panels, shots, images) -> list[StripeDetection]:
    with compiled.forced(way):
        finder = StripeFinder(find_panels(shots, [board.panel for board in two_panels.boards]), shots)
        return finder.find_in(images)


def assert_alike(ours: list[StripeDetection], theirs: list[StripeDetection]) -> int:
    """Returns how many stripes there are."""
    for one, other in zip(ours, theirs, strict=True):
        assert one.problems == other.problems
        assert one.stripes.keys() == other.stripes.keys()
        for k, points in one.stripes.items():
            for part in ("pixels", "normals", "sigma_px"):
                np.testing.assert_allclose(
                    getattr(points, part), getattr(other.stripes[k], part), rtol=0.0, atol=ROUNDING_PX
                )
    return sum(len(found.stripes) for found in ours)


def test_both_ways_find_the_same(two_panels, shots, images) -> None:
    ours, theirs = (found_in(way, two_panels, shots, images) for way in (True, False))
    assert assert_alike(ours, theirs) >= 10


def test_sixteen_bits_too(two_panels, shots, images) -> None:
    wide = [np.asarray(image, np.uint16) * np.uint16(200) for image in images[:6]]
    bright = [np.asarray(shot, np.uint16) * np.uint16(200) for shot in shots]
    ours, theirs = (found_in(way, two_panels, bright, wide) for way in (True, False))
    assert assert_alike(ours, theirs) > 5


@pytest.mark.parametrize("factor", [0.3, 0.05])
def test_faint_stripes_are_given_up_alike(two_panels, shots, factor: float) -> None:
    """What is too faint, too short or too rough: every decision on the way falls the same."""
    rng = np.random.default_rng(23)
    dim = []
    for level in (4.0, 8.0, 14.0, 22.0, 40.0):
        clean = two_panels.stripe(np.array([0.0, 1.0, 0.1]) / np.hypot(1.0, 0.1), 0.113, 0.0011, level)
        clean[:, int(factor * two_panels.width) :] *= 0.1
        dim.append(two_panels.noisy(clean, rng))
    ours, theirs = (found_in(way, two_panels, shots, dim) for way in (True, False))
    assert_alike(ours, theirs)
    assert any(found.problems for found in ours)


@pytest.mark.parametrize("factor", [2, 3, 4])
def test_means_of_blocks(factor: int) -> None:
    from lidarpose.detect.stripe_search_kernels import block_means

    image = np.random.default_rng(factor).integers(0, 256, (97, 131), dtype=np.uint8)
    low, high = (5, 3), (5 + 9 * factor, 3 + 7 * factor)
    part = image[low[1] : high[1], low[0] : high[0]]
    np.testing.assert_array_equal(block_means(image, low, high, factor), reduce_image(part, factor))
    np.testing.assert_allclose(
        reduce_image(part, factor), part.reshape(7, factor, 9, factor).mean(axis=(1, 3)), rtol=1e-6
    )


def test_a_parabola_is_the_least_squares_fit() -> None:
    rng = np.random.default_rng(3)
    t = np.sort(rng.choice(300, 60, replace=False))
    y = np.rint(40.0 + 0.3 * t - 1e-3 * t**2 + rng.normal(size=60)).astype(int)
    sums = [int((t**k).sum()) for k in range(5)] + [int((y * t**k).sum()) for k in range(3)]
    np.testing.assert_allclose(parabola(*sums), np.polynomial.polynomial.polyfit(t, y, 2), rtol=1e-6)


def test_the_noise_is_learnt_alike_from_bands_of_all_sizes() -> None:
    rng = np.random.default_rng(4)
    shape = (19, 5, 130)
    signal = rng.gamma(0.5, 40.0, shape)
    level = signal + rng.gamma(2.0, 3.0, shape)
    residual = rng.normal(size=shape) * np.sqrt(2.0 + 0.3 * level + (0.2 * signal) ** 2)
    good = rng.random(shape) < np.array([0.9, 0.5, 0.1, 0.03, 0.0])[:, None]
    samples = Samples.of(good.astype(np.float32), [x.astype(np.float32) for x in (residual, level, signal)])
    before = np.full((5, 3), 7.0)
    found = []
    for way in (True, False):
        with compiled.forced(way):
            found.append(learn_noise(samples, before))
    np.testing.assert_allclose(found[0], found[1], rtol=1e-9)
    assert (found[0][3:] == 7.0).all()
    reading, shots, speckle = found[0][0]
    stated = reading + shots * level + speckle * signal**2
    assert np.median(stated / (2.0 + 0.3 * level + (0.2 * signal) ** 2)) == pytest.approx(1.0, abs=0.25)


@pytest.mark.parametrize("count", [1, 2, 7, 100, 1001])
def test_selecting_is_as_sorting(count: int) -> None:
    from lidarpose.detect.stripe_profile_kernels import select

    rng = np.random.default_rng(count)
    for values in (rng.random(count), rng.integers(0, 5, count).astype(float), np.arange(count, dtype=float)):
        for k in {0, count // 3, count - 1}:
            assert select(values.copy(), count, k) == np.sort(values)[k]


def test_lines_in_reduced_images_are_the_very_same(two_panels, shots, images) -> None:
    """One line or two, of any direction, near the panel's ends, in light of which the board shows more or less."""
    board = find_panels(shots, [board.panel for board in two_panels.boards])
    bright = np.asarray(shots[0], np.float32)
    views = [PanelView.make(measure_albedo(grid_map, bright), bright) for grid_map in board.maps]
    rng = np.random.default_rng(5)
    v, u = np.indices(bright.shape)
    seen = list(images)
    for k in range(24):
        (x, y), a = rng.uniform(0.1, 0.9, 2) * [two_panels.width, two_panels.height], rng.uniform(0.0, np.pi)
        image = 0.3 * (k % 3) * bright
        for offset, width in ((0.0, 2.0), (rng.uniform(-120.0, 120.0), rng.uniform(1.5, 12.0)))[: 1 + k % 2]:
            image = image + 90.0 * np.exp(-0.5 * (((u - x) * np.sin(a) - (v - y) * np.cos(a) - offset) / width) ** 2)
        seen.append(two_panels.noisy(np.roll(image, 70, axis=1) if k % 8 == 5 else image, rng))
    answers = []
    for way in (True, False):
        with compiled.forced(way):
            found = [find_line(view, image) for image in seen for view in views]
        answers.append([line if isinstance(line, str) else astuple(line) for line in found])
    assert answers[0] == answers[1]
    assert len({answer for answer in answers[0] if isinstance(answer, str)}) >= 3
    assert sum(not isinstance(answer, str) for answer in answers[0]) >= 20
