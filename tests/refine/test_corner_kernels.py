"""Compiled passes over a face's returns give what NumPy gives."""

import numpy as np
import pytest

from lidarpose.geometry.arrays import unit
from lidarpose.geometry.compiled import forced, installed
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.face_systems import FaceSums, face_sums, loss_factor

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
