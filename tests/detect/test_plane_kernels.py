"""The compiled passes over a cloud against NumPy's: the same patches, but for points within rounding of a gate."""

from typing import Any

import numpy as np
import pytest
from benchmarks.suites.plane_search import scene
from scipy.spatial import cKDTree

from lidarpose.detect import patch_evidence
from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.geometry import compiled
from lidarpose.geometry.arrays import FloatArray, angle_between, perpendicular_pair
from lidarpose.geometry.planes import Plane
from lidarpose.model.plane_patch import PlanePatch
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session

pytestmark = pytest.mark.skipif(not compiled.installed(), reason="numba is not installed")

# Of the patches' points, which differ; and of their planes, beside 1e-5 rad and 20 um that 100 000 points leave.
MOST_OTHERS = 1e-4
SAME_NORMAL_RAD, SAME_OFFSET_M = 1e-6, 2e-6


def both_ways(points: FloatArray, search: PlaneSearch) -> list[tuple[PlanePatch, ...]]:
    patches = []
    for way in (False, True):
        with compiled.forced(way):
            patches.append(segment_planes(points, search))
    return patches


def assert_the_same(ways: list[tuple[PlanePatch, ...]]) -> None:
    plain, quick = ways
    assert len(plain) == len(quick) > 0
    for a, b in zip(plain, quick, strict=True):
        assert len(np.setxor1d(a.indices, b.indices)) <= MOST_OTHERS * len(a)
        assert angle_between(a.plane.normal, b.plane.normal) < SAME_NORMAL_RAD
        assert a.plane.offset == pytest.approx(b.plane.offset, abs=SAME_OFFSET_M)
        # A median of ten thousand: the next of them is a ten-thousandth off.
        assert a.sigma_m == pytest.approx(b.sigma_m, rel=5e-4)
        assert np.all(np.diff(b.indices) > 0)
    assert_apart(quick)


def assert_apart(patches: tuple[PlanePatch, ...]) -> None:
    every = np.concatenate([patch.indices for patch in patches])
    assert len(np.unique(every)) == len(every)


def test_patches_of_a_cloud_that_is_searched_whole_are_the_same() -> None:
    """And those that come up once the large ones are gone, from several subsamples, down to the clutter's."""
    points, _ = scene(20_000, 0.02, 1)
    assert_the_same(both_ways(points, PlaneSearch(from_sensor=True)))


def test_patches_of_a_lidars_frames_have_the_same_points() -> None:
    """To the last one, as both ways round distances alike: a sighting hangs on its patches' outermost points."""
    session, _ = simulate_corner_session(CornerSceneSpec(frames=1, places=3, room=True, clutter=4, seed=7))
    for place in session.places:
        plain, quick = both_ways(place.clouds[0].load().points, PlaneSearch(from_sensor=True))
        assert len(plain) > 4
        assert [p.indices.tolist() for p in plain] == [q.indices.tolist() for q in quick]


@pytest.mark.parametrize("n", [13, 64, 65, 1500])
def test_nearest_points_are_those_of_a_tree(n: int) -> None:
    from lidarpose.detect.patch_kernels import nearest

    points = np.random.default_rng(n).normal(size=(n, 3)).astype(np.float32)
    seeds = points[::7]
    expected = cKDTree(points).query(seeds, k=12)[1]
    np.testing.assert_array_equal(nearest(points, seeds, 12), expected)
    with compiled.forced(False):
        np.testing.assert_array_equal(patch_evidence.nearest_points(points, seeds, 12), expected)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_the_first_points_of_voxels_are_the_same(dtype: type[np.floating[Any]]) -> None:
    from lidarpose.detect.patch_kernels import first_in_each

    points = np.random.default_rng(4).normal(0.0, 0.5, (5000, 3)).astype(dtype)
    expected = patch_evidence.first_in_each(points, 0.2)
    np.testing.assert_array_equal(first_in_each(points, dtype(0.2)), expected)
    assert 500 < len(expected) < 4500


def test_patches_of_a_small_cloud_are_the_same() -> None:
    points, _ = scene(6000, 0.05, 3)
    assert_the_same(both_ways(points, PlaneSearch(from_sensor=True)))


def test_eigenvalues_and_vectors_of_small_matrices() -> None:
    from lidarpose.detect.patch_kernels import eigen

    rng = np.random.default_rng(3)
    for scale in ([1.0, 1.0, 1.0], [1e-6, 1.0, 2.0], [0.0, 1e-12, 1.0], [0.0, 0.0, 0.0], [3.0, 3.0, 7.0]):
        turn = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        matrix = turn @ np.diag(scale) @ turn.T
        matrix = 0.5 * (matrix + matrix.T)
        values, vectors = eigen(matrix)
        np.testing.assert_allclose(values, np.linalg.eigvalsh(matrix), atol=1e-15)
        np.testing.assert_allclose(vectors @ np.diag(values) @ vectors.T, matrix, atol=2e-15)
        np.testing.assert_allclose(vectors.T @ vectors, np.eye(3), atol=1e-15)


def test_the_largest_piece_is_the_same() -> None:
    """Crumbs of points on a plane, among them pieces of the same size, of which the first one counts."""
    from lidarpose.detect.cloud_planes import largest_component

    plane = Plane(np.array([0.3, -0.2, 1.0]), 1.0)
    across = np.stack(perpendicular_pair(plane.normal))
    rng = np.random.default_rng(4)
    for crumbs in (1, 2, 5, 40):
        middle = rng.uniform(-2.0, 2.0, (crumbs, 2))
        flat = np.concatenate([m + rng.uniform(-0.1, 0.1, (12, 2)) for m in middle])
        points = (flat @ across + plane.offset * plane.normal).astype(np.float32)
        inside = rng.random(len(points)) < 0.9
        pieces = []
        for way in (False, True):
            with compiled.forced(way):
                pieces.append(largest_component(points, inside, plane))
        assert 0 < np.count_nonzero(pieces[0]) <= np.count_nonzero(inside)
        np.testing.assert_array_equal(pieces[0], pieces[1])


@pytest.mark.parametrize("small", [None, 0.02])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_patches_are_the_same(small: float | None, dtype: type) -> None:
    points, _ = scene(240_000, small, 1)
    assert_the_same(both_ways(points.astype(dtype), PlaneSearch(max_planes=3)))


def test_further_rounds_over_what_is_left_find_the_same() -> None:
    """A cloud of many patches, some of them found among the points that the first ones left: a point more or less in
    those, and another subsample is drawn, from which the others start."""
    rng = np.random.default_rng(2)
    faces = []
    for k, count in enumerate([200_000, 150_000, 100_000, 40_000, 9_000, 4_000]):
        flat = np.column_stack([rng.uniform(-1.0, 1.0, (count, 2)), rng.normal(0.0, 0.004, count)])
        faces.append(np.roll(flat, k, axis=1) + [3.0 + 1.3 * k, 2.0 - k, 0.7 * k])
    points = np.concatenate([*faces, rng.uniform(-4.0, 12.0, (300_000, 3))])
    plain, quick = both_ways(points[rng.permutation(len(points))], PlaneSearch(min_points=1000))
    assert len(plain) == len(quick) >= 5
    for a, b in zip(plain, quick, strict=True):
        # Three standard deviations of what so many points tell.
        limit = 3.0 * a.sigma_m / np.sqrt(len(a))
        assert angle_between(a.plane.normal, b.plane.normal) < limit / 0.58
        assert a.plane.offset == pytest.approx(b.plane.offset, abs=7.0 * limit)
        assert len(np.setxor1d(a.indices, b.indices)) <= 0.01 * len(a)
    assert_apart(quick)


def test_points_in_another_order_of_memory() -> None:
    """Columns of a wider array, as a cloud with intensities has them."""
    points, _ = scene(240_000, None, 2)
    wide = np.zeros((len(points), 5), dtype=np.float32)
    wide[:, 1:4] = points
    assert_the_same(both_ways(wide[:, 1:4], PlaneSearch(max_planes=3)))
