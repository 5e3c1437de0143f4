"""The returns of one face at one place, collapsed: residuals along the beams, and normal equations of the face's plane.

A return enters an estimate through three numbers of its face at its place, the plane's shift along its normal at the
corner and its two tilts about it. So a face at a place collapses to a 3x3 system, or to one for each of its frames.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray, perpendicular_pair
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import mad_sigma
from lidarpose.model.corner_result import FaceReturns

# Tukey's biweight at 6 sigma keeps 98.8 % efficiency; what is no return of a face is tens of sigmas off.
TUKEY_K = 6.0
# By how much weighted least squares follow normal noise under this loss: the mean slope over the mean weight. Steps are
# made longer by it, which leaves a hundredth of the way where weights alone would leave a ninth.
FOLLOWED = (1.0 - 6.0 / TUKEY_K**2 + 15.0 / TUKEY_K**4) / (1.0 - 2.0 / TUKEY_K**2 + 3.0 / TUKEY_K**4)
MIN_RETURNS = 3
# Normal equations, scaled, with a smaller eigenvalue determine nothing.
LEAST_TOLD = 1e-10
MIN_SIGMA_M = 1e-6
MAX_STEPS = 50
# So many returns of a face tell how wide the loss has to be at first.
ENOUGH = 1000
# By how much kernels are done sooner, on one core.
SAVED_S_PER_RETURN = 1e-8

_PAIRS = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_PAIR_OF = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


@dataclass(frozen=True, eq=False)
class FaceSystem:
    """One face at one place, collapsed: normal equations of (shift, tilt, tilt), in units of the range noise.

    Attributes
    ----------
    information : (3, 3)
        Of the plane's shift at the corner along its normal (m) and of its two tilts about the corner (rad).
    gradient : (3,)
        Pull of the residuals on these three.
    """

    information: FloatArray
    gradient: FloatArray

    def scaled(self, factor: float) -> FaceSystem:
        """Of returns whose variance is smaller by a factor."""
        return FaceSystem(self.information * factor, self.gradient * factor)

    def after(self, move: FloatArray) -> FaceSystem:
        """The system once the plane has moved by (shift, tilt, tilt): weights change by next to nothing."""
        return FaceSystem(self.information, self.gradient - self.information @ move)


@dataclass(frozen=True, eq=False)
class FaceSums:
    """One face at one place, collapsed in parts: frame by frame, or all at once.

    Attributes
    ----------
    information, gradient : (S, 3, 3), (S, 3)
        As those of a `FaceSystem`, for each part.
    used : (S,)
        How many returns of each part carry weight.
    residual : (N,)
        Measured minus expected range of each return, metres.
    """

    information: FloatArray
    gradient: FloatArray
    used: IntArray
    residual: FloatArray

    @property
    def system(self) -> FaceSystem:
        """All parts together."""
        if len(self.used) == 1:
            return FaceSystem(self.information[0], self.gradient[0])
        return FaceSystem(self.information.sum(axis=0), self.gradient.sum(axis=0))


def tangents(normal: FloatArray) -> FloatArray:
    """Two unit directions (3, 2) across a normal, along which its tilts are counted."""
    return _tangents(*normal.tolist())


@lru_cache(maxsize=64)
def _tangents(x: float, y: float, z: float) -> FloatArray:
    """All places share three normals, and each asks for them at each step."""
    pair = np.column_stack(perpendicular_pair((x, y, z)))
    pair.setflags(write=False)
    return pair


def normal_and_tangents(normal: FloatArray) -> FloatArray:
    """A normal and its two tangents as rows (3, 3)."""
    return _axes(*normal.tolist())


@lru_cache(maxsize=64)
def _axes(x: float, y: float, z: float) -> FloatArray:
    axes = np.vstack([(x, y, z), _tangents(x, y, z).T])
    axes.setflags(write=False)
    return axes


def face_residuals(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> FloatArray:
    """Measured minus expected ranges (N,), metres."""
    return np.asarray(returns.range_m - (normal @ corner) / (normal @ returns.rays))


def face_rows(rays: FloatArray, normal: FloatArray, corner: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Expected ranges (N,), and their derivatives (3, N) by the plane's shift and two tilts about the corner."""
    axes = normal_and_tangents(normal)
    rows = axes @ rays
    along = axes @ corner
    shift, tilts = np.divide(1.0, rows[0], out=rows[0]), rows[1:]
    expected = along[0] * shift
    tilts *= expected
    np.subtract(along[1:, None], tilts, out=tilts)
    tilts *= shift
    return expected, rows


def weighted_rows(
    returns: FaceReturns, normal: FloatArray, corner: FloatArray, sigma_m: float
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Measured minus expected ranges (N,), the derivatives (3, N) of the expected ones by the plane's shift and its two
    tilts about the corner, and the weights (N,), one over the noise squared times the loss's own."""
    expected, rows = face_rows(returns.rays, normal, corner)
    residual = returns.range_m - expected
    weight = _weights(residual, sigma_m)
    weight *= 1.0 / sigma_m**2
    return residual, rows, weight


def _weights(residual: FloatArray, sigma_m: float) -> FloatArray:
    """Tukey's weight psi(r)/r of residuals (N,)."""
    z2 = residual * (1.0 / (TUKEY_K * sigma_m))
    z2 *= z2
    np.subtract(1.0, z2, out=z2)
    np.maximum(z2, 0.0, out=z2)
    z2 *= z2
    return z2


def face_sums(
    returns: FaceReturns, normal: FloatArray, corner: FloatArray, sigma_m: float, starts: IntArray | None = None
) -> FaceSums:
    """A face at a place collapsed, from one pass over its returns.

    Parameters
    ----------
    normal, corner
        The plane: a unit normal (3,), and the target's corner (3,) on it.
    sigma_m
        The ranges' noise.
    starts : (S,)
        Where parts begin, the first at 0; without it all returns are one.
    """
    if pays(SAVED_S_PER_RETURN * len(returns), "refine.corner_kernels"):
        return _sums_compiled(returns, normal, corner, sigma_m, starts)
    residual, rows, weight = weighted_rows(returns, normal, corner, sigma_m)
    weighted = rows * weight
    if starts is None:
        used = np.array([np.count_nonzero(weight)])
        return FaceSums((weighted @ rows.T)[None], (weighted @ residual)[None], used, residual)
    products = np.add.reduceat(np.stack([weighted[a] * rows[b] for a, b in _PAIRS]), starts, axis=1)
    gradient = np.add.reduceat(weighted * residual, starts, axis=1).T
    used = np.add.reduceat((weight > 0.0).astype(np.int64), starts)
    return FaceSums(products[_PAIR_OF].transpose(2, 0, 1), gradient, used, residual)


def _sums_compiled(
    returns: FaceReturns, normal: FloatArray, corner: FloatArray, sigma_m: float, starts: IntArray | None
) -> FaceSums:
    from lidarpose.refine.corner_kernels import collapse

    axes, count = normal_and_tangents(normal), len(returns)
    ends = np.array([0, count] if starts is None else [*starts.tolist(), count])
    residual, sums = np.empty(count), np.empty((len(ends) - 1, 10))
    range_m = np.ascontiguousarray(returns.range_m, dtype=np.float64)
    collapse(returns.rays, range_m, ends, axes, axes @ corner, TUKEY_K * sigma_m, residual, sums)
    scaled = sums[:, :9] * (1.0 / sigma_m**2)
    return FaceSums(scaled.take(_PAIR_OF, axis=1), scaled[:, 6:], sums[:, 9].astype(np.int64), residual)


def loss_factor(residual: FloatArray, sigma_m: float) -> float:
    """What the loss costs: the M-estimate's variance over that of the information with weights."""
    # Of z, the residual over where weights end, and v = 1 - z^2: the weight is v^2, psi^2 is K^2 z^2 v^4, its slope
    # v (1 - 5 z^2) = 5 v^2 - 4 v. All are 0 where v is.
    first, second, fourth, fifth = _powers(residual, TUKEY_K * sigma_m)
    psi2 = TUKEY_K**2 * (fourth - fifth)
    return psi2 * second / (5.0 * second - 4.0 * first) ** 2 if first > 0.0 else float("nan")


def _powers(residual: FloatArray, reach_m: float) -> tuple[float, float, float, float]:
    """Sums of v, v^2, v^4 and v^5 for v = 1 - (residual / reach)^2, or 0 where that is less."""
    if pays(0.5 * SAVED_S_PER_RETURN * len(residual), "refine.corner_kernels"):
        from lidarpose.refine.corner_kernels import loss_powers

        first, second, fourth, fifth = loss_powers(residual, reach_m)
        return first, second, fourth, fifth
    v = residual * (1.0 / reach_m)
    v *= v
    np.subtract(1.0, v, out=v)
    np.maximum(v, 0.0, out=v)
    v2 = v * v
    sums = float(v.sum()), float(v2.sum()), float(v2 @ v2)
    v *= v2
    return *sums, float(v2 @ v)


def subset_of(returns: FaceReturns, index: IntArray) -> FaceReturns:
    """Those of a face's returns that `index` (M,), ascending, tells."""
    if pays(0.2 * SAVED_S_PER_RETURN * len(index), "refine.corner_kernels"):
        from lidarpose.refine.corner_kernels import gathered

        rays, range_m, frame = gathered(returns.rays, returns.range_m, returns.frame, index)
        return FaceReturns(rays.T, range_m, frame)
    return returns.subset(index)


def some_residuals(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> FloatArray:
    """`face_residuals` of about a thousand of the returns: enough for a first scale."""
    step = max(len(returns) // ENOUGH, 1)
    return np.asarray(returns.range_m[::step] - (normal @ corner) / (normal @ returns.rays[:, ::step]))


def wide_enough(sigma_m: float, residuals: Sequence[FloatArray]) -> float:
    """A first scale under which a poor start loses no face: the loss narrows as the fit improves."""
    return max(sigma_m, MIN_SIGMA_M, *(mad_sigma(r, centred=True) for r in residuals))


def without_first(information: FloatArray) -> FloatArray:
    """Information (2, 2) of the last two of three unknowns, the first being free."""
    cross = information[1:, 0]
    return np.asarray(information[1:, 1:] - np.outer(cross, cross) / max(float(information[0, 0]), 1e-300))


def solved(information: FloatArray, gradient: FloatArray, what: str) -> FloatArray:
    """The step (n,) of normal equations, whatever the units of its parts; refused, by name, if they determine none."""
    scale = np.sqrt(np.maximum(np.diag(information), 1e-300))
    scaled = information / np.outer(scale, scale)
    if not np.all(np.isfinite(scaled)) or np.linalg.eigvalsh(scaled)[0] < LEAST_TOLD:
        raise UndeterminedError(
            f"the returns do not determine {what}",
            remedy="Bring the target nearer, or turn it so that several scan lines cross each face.",
        )
    return np.asarray(np.linalg.solve(scaled, gradient / scale) / scale)
