"""Compiled passes over a face's returns give what NumPy gives."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import IntArray, unit
from lidarpose.geometry.compiled import forced, installed
from lidarpose.model.corner_result import CornerPlaceFaces, FaceReturns
from lidarpose.refine.direction_cells import DirectionGrid
from lidarpose.refine.face_rims import without_rims
from lidarpose.refine.face_screening import without_foreign_spots
from lidarpose.refine.face_systems import FaceSums, face_sums, loss_factor
from lidarpose.refine.spot_scatter import _spots_off

pytestmark = pytest.mark.skipif(not installed(), reason="numba is not installed")

NORMAL = unit(np.array([-1.0, 0.3, 0.2]))
CORNER = np.array([2.0, 0.3, -0.4])
SIGMA_M = 0.008


def returns(count: int = 3000) -> FaceReturns:
    """Returns of eight frames from a plane, one in ten of something else."""
    rng = np.random.default_rng(1)
    rays = unit(np.array([1.0, 0.0, 0.0]) + 0.2 * rng.standard_normal((count, 3)))
    range_m = (NORMAL @ CORNER) / (rays @ NORMAL) + SIGMA_M * rng.standard_normal(count)
    range_m[::10] += rng.uniform(-0.2, 0.2, len(range_m[::10]))
    return FaceReturns(rays, range_m, np.sort(rng.integers(0, 8, count)))


@pytest.mark.parametrize("by_frame", [False, True])
def test_kernels_collapse_a_face_as_numpy_does(by_frame: bool) -> None:
    face = returns()
    starts = np.flatnonzero(np.diff(face.frame, prepend=-1)) if by_frame else None

    def collapsed(way: bool) -> FaceSums:
        with forced(way):
            return face_sums(face, NORMAL, CORNER, SIGMA_M, starts)

    plain, compiled = collapsed(False), collapsed(True)
    np.testing.assert_allclose(compiled.residual, plain.residual, atol=1e-14)
    np.testing.assert_allclose(compiled.information, plain.information, rtol=1e-10, atol=1e-6)
    np.testing.assert_allclose(compiled.gradient, plain.gradient, rtol=1e-10, atol=1e-6)
    np.testing.assert_array_equal(compiled.used, plain.used)
    assert plain.used.sum() < 0.96 * len(face)
    with forced(False):
        expected = loss_factor(plain.residual, SIGMA_M)
    with forced(True):
        assert loss_factor(plain.residual, SIGMA_M) == pytest.approx(expected, rel=1e-12)


def test_frames_together_are_the_face() -> None:
    face = returns()
    with forced(False):
        whole = face_sums(face, NORMAL, CORNER, SIGMA_M).system
        parts = face_sums(face, NORMAL, CORNER, SIGMA_M, np.flatnonzero(np.diff(face.frame, prepend=-1))).system
    np.testing.assert_allclose(parts.information, whole.information, rtol=1e-10, atol=1e-6)
    np.testing.assert_allclose(parts.gradient, whole.gradient, rtol=1e-10, atol=1e-6)


def test_directions_fall_in_the_same_cells() -> None:
    rays = np.ascontiguousarray(returns().rays)
    with forced(False):
        plain = DirectionGrid.of(rays, np.radians(1.2))
    with forced(True):
        compiled = DirectionGrid.of(rays, np.radians(1.2))
    assert plain.width == compiled.width
    np.testing.assert_array_equal(plain.cell, compiled.cell)
    # Neighbours in the grid are neighbours in direction, and a cell is no wider than it should be.
    for cell in np.unique(plain.cell)[::7]:
        mine = rays[:, plain.cell == cell]
        assert np.degrees(np.arccos(np.clip(mine.T @ mine, -1.0, 1.0))).max() < 1.2 * 1.5


def test_the_same_rims_are_left_out() -> None:
    rng = np.random.default_rng(3)
    corners = np.array([[2.0, 0.0, -0.8], [2.4, 0.5, -0.7], [1.8, -0.4, -0.6]])
    frame: IntArray = np.zeros(5000, dtype=np.int64)
    found = []
    for k, corner in enumerate(corners):
        flat = corner + np.column_stack([rng.uniform(-0.3, 0.3, (5000, 2)), np.zeros(5000)])
        to_face = np.linalg.norm(flat, axis=1)
        below = 2.0 * np.maximum(np.abs(flat - corner)[:, :2].max(axis=1) - 0.29, 0.0)
        face = FaceReturns(flat / to_face[:, None], to_face + below + 0.008 * rng.standard_normal(5000), frame)
        found.append(CornerPlaceFaces(str(k), corner, {0: face}, 1))
    left = []
    for way in (False, True):
        with forced(way):
            left.append(without_rims(found, np.eye(3)[[2, 0, 1]], corners, SIGMA_M))
    for before, plain, compiled in zip(found, *left, strict=True):
        np.testing.assert_array_equal(plain.faces[0].range_m, compiled.faces[0].range_m)
        assert 4000 < len(plain.faces[0]) < 0.97 * len(before.faces[0])


@pytest.mark.parametrize("kind", ["clean", "strap", "turned", "rim", "sparse"])
def test_the_same_foreign_spots_are_left_out(kind: str) -> None:
    rng = np.random.default_rng(4)
    corner = np.array([2.0, 0.1, 0.2])
    normal = unit(np.array([-1.0, 0.2, 0.1]))
    rays = np.stack([np.ones(6000), *rng.uniform(-0.15, 0.15, (2, 6000))], axis=1)
    if kind == "sparse":
        rays[:, 2] = 0.15 * np.round(rays[:, 2] / 0.05) / 3.0
    rays = unit(rays)
    met = unit(normal + [0.0, 0.04, 0.0]) if kind == "turned" else normal
    range_m = (met @ corner) / (rays @ met) + SIGMA_M * rng.standard_normal(6000)
    rim = np.abs(rays[:, 1] / rays[:, 0]) > 0.13
    strap = (rays[:, 1] < -0.02) & (rays[:, 1] > -0.08)
    range_m[strap] -= 0.03 * (kind in ("strap", "sparse"))
    range_m[rim] += 0.03 * (kind == "rim")
    face = FaceReturns(rays, range_m, np.sort(rng.integers(0, 8, 6000)))
    left = []
    for way in (False, True):
        with forced(way):
            left.append(without_foreign_spots(face, rim, normal, corner, SIGMA_M))
    plain, compiled = left
    np.testing.assert_array_equal(plain.range_m, compiled.range_m)
    np.testing.assert_array_equal(plain.rays, compiled.rays)
    np.testing.assert_array_equal(plain.frame, compiled.frame)
    gone = ~np.isin(range_m, plain.range_m)
    if kind in ("strap", "sparse"):
        assert gone[strap].mean() > 0.9
        assert gone[~strap & ~rim].mean() < 0.5
    else:
        # Scan lines lie so close that what is outside of the outline is not needed.
        np.testing.assert_array_equal(gone, rim)


def test_spots_scatter_alike_both_ways() -> None:
    face = returns()
    with forced(False):
        squares, spots = _spots_off(face, NORMAL, CORNER, 4.0 * SIGMA_M)
    with forced(True):
        compiled, count = _spots_off(face, NORMAL, CORNER, 4.0 * SIGMA_M)
    assert compiled == pytest.approx(squares, rel=1e-10)
    assert count == spots
    assert 0.6 < squares / SIGMA_M**2 / spots < 1.5
