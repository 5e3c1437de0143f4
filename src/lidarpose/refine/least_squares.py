"""Normal equations: moments of lines, random effects taken out, and damped steps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, inverse_2x2

SQRT3 = float(np.sqrt(3.0))
# OpenBLAS shares products of more multiplications than 2^18 among threads.
_MOST_PRODUCTS = 200_000


@dataclass(frozen=True, eq=False)
class NormalEquations:
    """``information @ step = gradient``, and the weighted sum of squares at step 0."""

    information: FloatArray
    gradient: FloatArray
    sum_of_squares: float

    def solve(self, damping: float) -> FloatArray:
        """The step of Levenberg and Marquardt, with the diagonal's scale (More, 1978)."""
        diagonal = np.diag(self.information).copy()
        scale = np.where(diagonal > 0.0, 1.0 / np.sqrt(np.maximum(diagonal, 1e-300)), 0.0)
        scaled = self.information * scale[:, None] * scale[None, :]
        scaled[np.diag_indices_from(scaled)] += damping + (diagonal <= 0.0)
        return np.asarray(scale * np.linalg.lstsq(scaled, scale * self.gradient, rcond=1e-14)[0])


def line_columns(basis: Sequence[FloatArray], along: FloatArray, residual: FloatArray) -> FloatArray:
    """Columns (N, b + 3): the b of the basis (N,), 1, sqrt(3) along (N,), residual (N,).

    The two before the residual are what a line may be off by as a whole: a shift and a slope, both of mean square 1.
    """
    b = len(basis)
    columns = np.empty((len(residual), b + 3))
    for k, column in enumerate(basis):
        columns[:, k] = column
    columns[:, b] = 1.0
    columns[:, b + 1] = SQRT3 * along
    columns[:, b + 2] = residual
    return columns


def line_moments(columns: FloatArray, weight: FloatArray, start: IntArray) -> FloatArray:
    """Weighted second moments (S, b + 3, b + 3) of `line_columns`, one matrix a line.

    `weight` (N,); `start` (S + 1,) tells where lines begin.
    """
    rows = np.sqrt(weight)[:, None] * columns
    count = np.diff(start)
    if len(count) and np.all(count == count[0]):
        blocks = rows.reshape(len(count), int(count[0]), rows.shape[1])
        return np.asarray(np.matmul(blocks.swapaxes(1, 2), blocks))
    out = np.empty((len(start) - 1, rows.shape[1], rows.shape[1]))
    begin = start.tolist()
    for j in range(len(out)):
        block = rows[begin[j] : begin[j + 1]]
        np.dot(block.T, block, out=out[j])
    return out


def moved_moments(moments: FloatArray, shift: FloatArray) -> FloatArray:
    """`line_moments` (S, b + 3, b + 3) after the residuals grew by the basis times `shift` (S, b), weights held."""
    b = shift.shape[1]
    out = moments.copy()
    with_residual = (moments[:, :, :b] @ shift[:, :, None])[:, :, 0]
    out[:, :, -1] += with_residual
    out[:, -1, :] += with_residual
    out[:, -1, -1] += (with_residual[:, :b] * shift).sum(axis=1)
    return out


def own_effects(moments: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Least-squares shift and slope (S, 2) of each line by itself, and where there is one."""
    size = moments.shape[1]
    inner = moments[:, size - 3 : size - 1, size - 3 : size - 1]
    good = determined_effects(inner)
    inverse = inverse_2x2(np.where(good[:, None, None], inner, np.eye(2)))
    return (inverse @ moments[:, size - 3 : size - 1, -1:])[:, :, 0], good


def determined_effects(inner: FloatArray) -> BoolArray:
    """Where the moments (S, 2, 2) of shift and slope tell both."""
    det = inner[:, 0, 0] * inner[:, 1, 1] - inner[:, 0, 1] * inner[:, 1, 0]
    return np.asarray(det > 1e-12 * np.maximum(inner[:, 0, 0], 1e-300) ** 2)


@dataclass(frozen=True, eq=False)
class LineEffects:
    """What lines are off by as a whole, best linear prediction.

    Attributes
    ----------
    shrink : (S, 2, 2)
        Posterior covariance Q of a line's shift and slope, the parameters held.
    predicted : (S, 2)
        Shift and slope.
    coupling : (S, 2, b)
        Moments of the two with the basis.
    """

    shrink: FloatArray
    predicted: FloatArray
    coupling: FloatArray


def take_out_effects(moments: FloatArray, variance: float) -> tuple[FloatArray, LineEffects]:
    """Moments (S, b + 1, b + 1) of basis and residual with each line's shift and slope integrated out.

    Both are normal with mean 0 and the given variance (zero: there are none). This is the Schur complement of the
    mixed model's equations (Henderson, 1950), the same as weighting with the full covariance of the line's rows.
    """
    S, size, _ = moments.shape
    keep = [*range(size - 3), size - 1]
    inner = moments[:, size - 3 : size - 1, size - 3 : size - 1]
    coupling = moments[:, size - 3 : size - 1, :][:, :, keep]
    reduced = moments[:, keep, :][:, :, keep]
    if variance <= 0.0:
        return reduced, LineEffects(np.zeros((S, 2, 2)), np.zeros((S, 2)), coupling[:, :, :-1])
    shrink = inverse_2x2(inner + np.eye(2) / variance)
    reduced = reduced - np.swapaxes(coupling, 1, 2) @ shrink @ coupling
    predicted = (shrink @ coupling[:, :, -1:])[:, :, 0]
    return reduced, LineEffects(shrink, predicted, coupling[:, :, :-1])


def add_lines(
    reduced: FloatArray,
    to_parameters: FloatArray,
    slot: IntArray,
    n_global: int,
    into: tuple[FloatArray, FloatArray],
) -> float:
    """Add lines' normal equations to (information, gradient); return their weighted sum of squares.

    `to_parameters` (S, b, n_global + 6): the last six columns are of the panel `slot` (S,).
    """
    information, gradient = into
    if not len(reduced):
        return 0.0
    weighted = reduced[:, :-1, :-1] @ to_parameters
    for k in np.unique(slot).tolist():
        mine = slot == k
        to = to_parameters[mine].reshape(-1, to_parameters.shape[2])
        block = _product(to, weighted[mine].reshape(to.shape))
        slope = -np.einsum("n,nj->j", reduced[mine][:, :-1, -1].ravel(), to)
        at = slice(n_global + 6 * k, n_global + 6 * k + 6)
        information[:n_global, :n_global] += block[:n_global, :n_global]
        information[:n_global, at] += block[:n_global, n_global:]
        information[at, :n_global] += block[:n_global, n_global:].T
        information[at, at] += block[n_global:, n_global:]
        gradient[:n_global] += slope[:n_global]
        gradient[at] += slope[n_global:]
    return float(reduced[:, -1, -1].sum())


def _product(a: FloatArray, b: FloatArray) -> FloatArray:
    """a^T b of two tall matrices (N, n), in parts so small that BLAS starts no threads, which would cost more."""
    part = max(_MOST_PRODUCTS // a.shape[1] ** 2, 1)
    found = np.zeros((a.shape[1], b.shape[1]))
    for first in range(0, len(a), part):
        found += a[first : first + part].T @ b[first : first + part]
    return found


def covariance_and_condition(information: FloatArray) -> tuple[FloatArray, float, FloatArray]:
    """Inverse, condition number of the matrix scaled to a unit diagonal, and the least determined direction.

    A direction without information gets the (huge, finite) variance of the smallest eigenvalue that rounding allows.
    """
    diagonal = np.diag(information)
    scale = 1.0 / np.sqrt(np.where(diagonal > 0.0, diagonal, 1.0))
    values, vectors = np.linalg.eigh(information * scale[:, None] * scale[None, :])
    floor = 1e-15 * max(float(values[-1]), 1e-300)
    safe = np.maximum(values, floor)
    root = scale[:, None] * vectors / np.sqrt(safe)
    return root @ root.T, float(safe[-1] / safe[0]), np.asarray(scale * vectors[:, 0])
