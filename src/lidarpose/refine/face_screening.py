"""What lies on a face of the target but is not of it: ground at its foot, a shelf behind it, a strap, a hand.

The corner paper screens by neighbours' normals (its second screening). A spot's mean residual over all frames says the
same, and sooner.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.robust import median
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.direction_cells import direction_grid
from lidarpose.refine.face_systems import face_residuals, face_rows

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
    grid = _Grid.of(returns)
    spots = None if grid.dense else _spots(returns, grid, normal, corner)
    # Where scan lines lie so close, none is needed outside of the outline to tell where the face ends.
    if spots is None or _is_rim_odd(spots.residual[rim], sigma_m, spots.spread_m):
        inner = np.flatnonzero(~rim)
        if len(inner) == 0:
            return returns.subset(inner)
        if len(inner) < len(rim):
            returns, grid = returns.subset(inner), grid.subset(inner)
        spots = _spots(returns, grid, normal, corner)
    odd = _odd(spots, sigma_m)
    if not odd.any() or _is_turned(returns, spots, normal, corner, sigma_m):
        return returns
    if spots.grid.dense:
        # What is something else does not end where a spot does.
        odd |= _sum_around(odd, spots.grid.width) > 0
    return returns.subset(np.flatnonzero(~odd[spots.grid.cell]))


@dataclass(frozen=True, eq=False)
class _Grid:
    """Which cell (N,) of a grid of directions each return is in, and how many each cell (M,) holds. The grid has a rim
    of empty cells, its rows of `width` one after the other."""

    cell: IntArray
    count: IntArray
    width: int

    @staticmethod
    def of(returns: FaceReturns) -> _Grid:
        row, column = direction_grid(returns.rays, SPOT_RAD)
        width = int(column.max()) + 3
        cell = np.asarray((row + 1) * width + column + 1)
        return _Grid(cell, np.bincount(cell), width)

    def subset(self, index: IntArray) -> _Grid:
        cell = self.cell[index]
        return _Grid(cell, np.bincount(cell), self.width)

    @cached_property
    def dense(self) -> bool:
        """Whether scan lines lie closer than spots, so that most neighbours of a spot hold returns too."""
        there = self.count > 0
        return float(_sum_around(there, self.width)[there].mean()) > DENSE_NEIGHBOURS


@dataclass(frozen=True, eq=False)
class _Spots:
    """What a face's returns are off by, by themselves and cell by cell.

    Attributes
    ----------
    residual : (N,)
        Against the level of what is next to the corner.
    mean : (M,)
        Of each cell.
    spread_m
        How far spots next to the corner are off, as a standard deviation.
    """

    grid: _Grid
    residual: FloatArray
    mean: FloatArray
    spread_m: float


def _spots(returns: FaceReturns, grid: _Grid, normal: FloatArray, corner: FloatArray) -> _Spots:
    residual = face_residuals(returns, normal, corner)
    sure = _next_to_corner(returns, corner)
    residual -= median(residual.take(sure))
    mean = _means(grid, residual)
    spread_m = _spread(mean, grid.count, np.bincount(grid.cell.take(sure), minlength=len(grid.count)))
    return _Spots(grid, residual, mean, spread_m)


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
    return _only_noise(_means(spots.grid, own), spots.grid.count, sigma_m)


def _means(grid: _Grid, residual: FloatArray) -> FloatArray:
    return np.asarray(np.bincount(grid.cell, residual) / np.maximum(grid.count, 1))


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
    return np.asarray(far & (off * np.sqrt(spots.grid.count) > ODD_MEAN_SIGMAS * sigma_m))


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
