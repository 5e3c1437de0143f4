"""Planes of the whole cloud from a rough idea of them: against plain least squares, and along seams."""

from collections.abc import Iterator

import numpy as np
import pytest

from lidarpose.detect.plane_claims import Claim, Slab, _Team, patches_of_slabs
from lidarpose.geometry import compiled
from lidarpose.geometry.arrays import BoolArray, FloatArray, angle_between
from lidarpose.geometry.planes import Plane, fit_plane

SIGMA_M = 0.005


@pytest.fixture(autouse=True, params=["numpy", "compiled"])
def way(request: pytest.FixtureRequest) -> Iterator[None]:
    """Everything here both ways."""
    if request.param == "compiled" and not compiled.installed():
        pytest.skip("numba is not installed")
    with compiled.forced(request.param == "compiled"):
        yield


def face(n: int, rng: np.random.Generator) -> FloatArray:
    """Points (n, 3) on z = 0, in [0, 1] by [0, 2], with noise across."""
    return np.column_stack([rng.uniform(0.0, 1.0, n), rng.uniform(0.0, 2.0, n), rng.normal(0.0, SIGMA_M, n)])


def claims(points: FloatArray, free: BoolArray | None, slabs: list[Slab]) -> list[Claim | None]:
    return patches_of_slabs(points, free, slabs)


def rough(points: FloatArray, seed: int) -> Slab:
    """A slab from few of the points, as a subsample gives it."""
    few = points[np.random.default_rng(seed).integers(0, len(points), 200)]
    return Slab.around(few, fit_plane(few), SIGMA_M)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_plane_is_that_of_least_squares_over_all_points(dtype: type) -> None:
    points = face(90_000, np.random.default_rng(1)) + [5.0, -3.0, 2.0]
    answer = claims(points.astype(dtype), None, [rough(points, 1)])[0]
    assert answer is not None
    patch, variances = answer.patch, answer.variances
    best = fit_plane(points[np.abs(points[:, 2] - 2.0) < 3.0 * SIGMA_M])
    # A tenth of the standard deviation that 90 000 points leave.
    assert angle_between(patch.plane.normal, best.flipped().normal if best.offset > 0 else best.normal) < 6e-6
    assert abs(abs(patch.plane.offset) - abs(best.offset)) < 2e-5
    assert patch.plane.offset < 0.0
    assert patch.sigma_m == pytest.approx(SIGMA_M, rel=0.03)
    np.testing.assert_allclose(variances, [1.0 / 12.0, 4.0 / 12.0], rtol=0.02)
    assert len(patch) == pytest.approx(0.9973 * len(points), rel=0.001)


def test_a_step_reaches_the_estimate_among_clutter_too() -> None:
    rng = np.random.default_rng(2)
    points = np.concatenate([face(40_000, rng), rng.uniform([0, 0, -0.1], [1, 2, 0.1], (80_000, 3))])
    start = Plane(np.array([0.003, 0.002, 1.0]), 0.004)
    slab = Slab.around(points[:400], start, SIGMA_M)
    answer = claims(points, None, [slab])[0]
    assert answer is not None
    plane = answer.patch.plane if answer.patch.plane.normal[2] > 0 else answer.patch.plane.flipped()
    # The same estimate by brute force, taken to its end.
    end = start
    for _ in range(60):
        inside = np.abs(end.distance(points)) < 3.0 * SIGMA_M
        end = fit_plane(points[inside])
    end = end if end.normal[2] > 0 else end.flipped()
    assert angle_between(plane.normal, end.normal) < 3e-5
    assert plane.offset == pytest.approx(end.offset, abs=2e-5)


def test_points_along_a_seam_tilt_neither_plane_and_belong_to_one() -> None:
    rng = np.random.default_rng(3)
    floor = face(60_000, rng)
    wall = face(60_000, rng)[:, [2, 1, 0]]
    points = np.concatenate([floor, wall])
    answers = claims(points, None, [rough(floor, 3), rough(wall, 4)])
    normals = []
    for answer in answers:
        assert answer is not None
        normals.append(answer.patch.plane.normal * np.sign(answer.patch.plane.normal.sum()))
    # Three standard deviations that 60 000 points leave, of the tilt about the long side; with the seam it is five.
    limit = 3.0 * SIGMA_M / np.sqrt(60_000 / 12.0)
    assert angle_between(normals[0], np.array([0.0, 0.0, 1.0])) < limit
    assert angle_between(normals[1], np.array([1.0, 0.0, 0.0])) < limit
    first, second = (answer.patch.indices for answer in answers if answer is not None)
    assert len(np.intersect1d(first, second)) == 0
    assert np.all(np.diff(first) > 0)


def test_only_free_points_are_taken_and_too_few_are_no_patch() -> None:
    points = face(50_000, np.random.default_rng(4))
    free = np.zeros(len(points), dtype=bool)
    slab = rough(points, 5)
    assert claims(points, free, [slab]) == [None]
    free[::5] = True
    answer = claims(points, free, [slab])[0]
    assert answer is not None
    assert free[answer.patch.indices].all()
    assert len(answer.patch) == pytest.approx(10_000, rel=0.01)


def test_what_lies_beside_the_patch_on_its_plane_is_not_of_it() -> None:
    rng = np.random.default_rng(5)
    points = np.concatenate([face(30_000, rng), face(30_000, rng) + [3.0, 0.0, 0.0]])
    answer = claims(points, None, [rough(points[:30_000], 6)])[0]
    assert answer is not None
    assert answer.patch.indices.max() < 30_000


def test_every_piece_of_work_is_done_once_and_an_error_in_any_thread_is_raised() -> None:
    with _Team(4) as team:
        assert team.each(lambda a, b: a - b, range(100), range(0, 200, 2)) == [-k for k in range(100)]
        assert team.each(abs, []) == []
        for wrong in range(4):
            with pytest.raises(ZeroDivisionError):
                team.each(lambda k, wrong=wrong: 1 // (k - wrong), range(4))
