"""What lies on a face of the target but is not of it: ground at its foot, a shelf behind it, a strap, a hand.

The corner paper screens by neighbours' normals (its second screening). A spot's mean residual over all frames says the
same, and sooner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.robust import median
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.corner_model import direction_grid, face_residuals, face_rows

SPOT_RAD = np.radians(1.2)
# Beams of a multi-beam LiDAR are off by about one sigma each, all frames alike: that is no reason to drop them.
ODD_SPOT_SIGMAS = 1.75
ODD_MEAN_SIGMAS, ODD_RIM_SIGMAS = 4.5, 3.0
ODD_SPREADS, ODD_RIM_SPREADS = 3.5, 1.0
MEDIAN_OF_HALF_NORMAL = 0.6745
MIN_SPOTS = 5
# Of the eight around each; a face of four by four cells has 5.3.
DENSE_NEIGHBOURS = 5.0
# The share of a face's returns, those next to the corner, that are surely its own.
SURE_SHARE = 0.25


def without_foreign_spots(
    returns: FaceReturns, rim: BoolArray, normal: FloatArray, corner: FloatArray, sigma_m: float
) -> FaceReturns:
    """The returns of a face without spots that are plainly something else, and without what is next to them.

    Parameters
    ----------
    returns, normal, corner
        What seems to be of the face: its unit normal (3,) and the target's corner (3,), both nearly right.
    rim : (N,)
        Which returns lie outside the outline in which the face was first seen; together they are one spot.
    sigma_m
        The ranges' noise.

    Returns
    -------
    All returns where nothing is foreign, or where the face as a whole is turned: that is for the estimate to say.
    """
    spots = _spots(returns, normal, corner)
    # Where scan lines lie so close, none is needed outside of the outline to tell where the face ends.
    if spots.dense or _is_rim_odd(spots.residual[rim], sigma_m, spots.spread_m):
        returns = returns.subset(np.flatnonzero(~rim))
        if len(returns) == 0:
            return returns
        spots = _spots(returns, normal, corner)
    odd = _odd(spots, sigma_m)
    if not odd.any() or _is_turned(returns, spots, normal, corner, sigma_m):
        return returns
    if spots.dense:
        # What is something else does not end where a spot does.
        odd |= _sum_around(odd, spots.width) > 0
    return returns.subset(np.flatnonzero(~odd[spots.cell]))


@dataclass(frozen=True, eq=False)
class _Spots:
    """A face's returns in a grid of directions with a rim of empty cells, its rows of `width` one after the other.

    Attributes
    ----------
    cell, residual : (N,)
        Of each return; residuals against the level of what is next to the corner.
    count, mean : (M,)
        Of each cell: returns, and their mean residual.
    spread_m
        How far spots next to the corner are off, as a standard deviation.
    """

    cell: IntArray
    residual: FloatArray
    count: IntArray
    mean: FloatArray
    width: int
    spread_m: float

    @property
    def dense(self) -> bool:
        return _is_dense(self.count, self.width)


def _spots(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> _Spots:
    residual = face_residuals(returns, normal, corner)
    cell, width = _cells(returns)
    count = np.bincount(cell)
    sure = _next_to_corner(returns, corner)
    residual -= median(residual[sure])
    mean = _means(cell, count, residual)
    spread_m = _spread(mean, count, np.bincount(cell[sure], minlength=len(count)))
    return _Spots(cell, residual, count, mean, width, spread_m)


def _is_dense(count: IntArray, width: int) -> bool:
    """Whether scan lines lie closer than spots, so that most neighbours of a spot hold returns too."""
    there = count > 0
    return float(_sum_around(there, width)[there].mean()) > DENSE_NEIGHBOURS


def _is_rim_odd(residual: FloatArray, sigma_m: float, spread_m: float) -> bool:
    """Whether what lies around a face's outline is something else, at some of its sides at least."""
    if len(residual) == 0:
        return False
    off = abs(float(residual.mean()))
    return off > ODD_RIM_SPREADS * spread_m and off * np.sqrt(len(residual)) > ODD_RIM_SIGMAS * sigma_m


def _is_turned(returns: FaceReturns, spots: _Spots, normal: FloatArray, corner: FloatArray, sigma_m: float) -> bool:
    """Whether a plane of its own explains a face to the noise: then nothing on it is foreign."""
    _, rows = face_rows(returns.rays, normal, corner)
    own = spots.residual - rows.T @ np.linalg.lstsq(rows.T, spots.residual, rcond=None)[0]
    return _only_noise(_means(spots.cell, spots.count, own), spots.count, sigma_m)


def _cells(returns: FaceReturns) -> tuple[IntArray, int]:
    """The cell (N,) of each return in a grid with a rim of empty cells, and the length of the grid's rows."""
    row, column = direction_grid(returns.rays, SPOT_RAD)
    width = int(column.max()) + 3
    return np.asarray((row + 1) * width + column + 1), width


def _means(cell: IntArray, count: IntArray, residual: FloatArray) -> FloatArray:
    return np.asarray(np.bincount(cell, residual) / np.maximum(count, 1))


def _next_to_corner(returns: FaceReturns, corner: FloatArray) -> IntArray:
    """Which returns are next to the corner: that they are of the face is surer than where the face is."""
    nearness = corner @ returns.rays
    rest = int((1.0 - SURE_SHARE) * len(nearness))
    return np.argpartition(nearness, rest)[rest:]


def _spread(mean: FloatArray, count: IntArray, sure: IntArray) -> float:
    """How far spots next to the corner are off, as a standard deviation.

    Lines of single beams are off by several times what their returns scatter.
    """
    spots = np.flatnonzero(2 * sure > np.maximum(count, 1))
    return median(np.abs(mean[spots])) / MEDIAN_OF_HALF_NORMAL if len(spots) >= MIN_SPOTS else 0.0


def _odd(spots: _Spots, sigma_m: float) -> BoolArray:
    off = np.abs(spots.mean)
    far = off > max(ODD_SPOT_SIGMAS * sigma_m, ODD_SPREADS * spots.spread_m)
    return np.asarray(far & (off * np.sqrt(spots.count) > ODD_MEAN_SIGMAS * sigma_m))


def _only_noise(mean: FloatArray, count: IntArray, sigma_m: float) -> bool:
    """Whether a face's own plane leaves no more than noise in its cells, by a chi-square."""
    dof = int(np.count_nonzero(count)) - 3
    return dof > 0 and float((mean**2 * count).sum()) < sigma_m**2 * (dof + 4.0 * np.sqrt(2.0 * dof))


def _sum_around(odd: BoolArray, width: int) -> IntArray:
    """How many of the eight cells around each are odd."""
    total = np.zeros(len(odd), dtype=np.int64)
    for step in (1, width - 1, width, width + 1):
        total[step:] += odd[:-step]
        total[:-step] += odd[step:]
    return total
