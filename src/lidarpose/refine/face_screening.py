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
from lidarpose.refine.direction_cells import DirectionGrid
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
    seen = _Seen.of(returns, normal, corner)
    spots = None if _is_dense(seen) else _spots(seen)
    # Where scan lines lie so close, none is needed outside of the outline to tell where the face ends.
    if spots is None or _is_rim_odd(seen.residual[rim] - spots.level_m, sigma_m, spots.spread_m):
        inner = np.flatnonzero(~rim)
        if len(inner) < len(rim):
            returns, seen = returns.subset(inner), seen.subset(inner)
        if len(inner) == 0:
            return returns
        spots = _spots(seen)
    odd = _odd(spots, sigma_m)
    if not odd.any() or _is_turned(returns, seen, spots, normal, corner, sigma_m):
        return returns
    if _is_dense(seen):
        # What is something else does not end where a spot does.
        odd |= _sum_around(odd, seen.width) > 0
    return returns.subset(np.flatnonzero(~odd[seen.cell]))


@dataclass(frozen=True, eq=False)
class _Seen:
    """What a face's returns are off by (N,), and how far each lies towards the corner (N,); which cell (N,) of a grid
    of directions each is in, as of `DirectionGrid`."""

    residual: FloatArray
    nearness: FloatArray
    cell: IntArray
    width: int

    @staticmethod
    def of(returns: FaceReturns, normal: FloatArray, corner: FloatArray) -> _Seen:
        grid = DirectionGrid.of(returns.rays, SPOT_RAD)
        return _Seen(face_residuals(returns, normal, corner), corner @ returns.rays, grid.cell, grid.width)

    def subset(self, index: IntArray) -> _Seen:
        return _Seen(self.residual.take(index), self.nearness.take(index), self.cell.take(index), self.width)

    @cached_property
    def count(self) -> IntArray:
        """How many returns each cell (M,) holds."""
        return np.bincount(self.cell)

    def means(self, residual: FloatArray) -> FloatArray:
        """Of each cell (M,)."""
        return np.asarray(np.bincount(self.cell, residual) / np.maximum(self.count, 1))


@dataclass(frozen=True, eq=False)
class _Spots:
    """Cell by cell (M,): the mean of what returns are off by against the level of what is next to the corner, and how
    many there are; how far spots next to the corner are off, as a standard deviation."""

    mean: FloatArray
    count: IntArray
    level_m: float
    spread_m: float


def _is_dense(seen: _Seen) -> bool:
    """Whether scan lines lie closer than spots, so that most neighbours of a spot hold returns too."""
    there = seen.count > 0
    return float(_sum_around(there, seen.width)[there].mean()) > DENSE_NEIGHBOURS


def _spots(seen: _Seen) -> _Spots:
    sure = _next_to_corner(seen.nearness)
    level_m = median(seen.residual.take(sure))
    mean = np.where(seen.count > 0, seen.means(seen.residual) - level_m, 0.0)
    spread_m = _spread(mean, seen.count, np.bincount(seen.cell.take(sure), minlength=len(seen.count)))
    return _Spots(mean, seen.count, level_m, spread_m)


def _is_rim_odd(residual: FloatArray, sigma_m: float, spread_m: float) -> bool:
    """Whether what lies around a face's outline is something else, at some of its sides at least."""
    if len(residual) == 0:
        return False
    off = abs(float(residual.mean()))
    return off > ODD_RIM_SPREADS * spread_m and off * np.sqrt(len(residual)) > ODD_RIM_SIGMAS * sigma_m


def _is_turned(
    returns: FaceReturns, seen: _Seen, spots: _Spots, normal: FloatArray, corner: FloatArray, sigma_m: float
) -> bool:
    """Whether a plane of its own explains a face to the noise: then nothing on it is foreign."""
    _, rows = face_rows(returns.rays, normal, corner)
    residual = seen.residual - spots.level_m
    # Rows in metres and metres by radian: all about one.
    own = residual - np.linalg.lstsq(rows @ rows.T, rows @ residual, rcond=1e-12)[0] @ rows
    return _only_noise(seen.means(own), seen.count, sigma_m)


def _next_to_corner(nearness: FloatArray) -> IntArray:
    """Which returns are next to the corner: that they are of the face is surer than where the face is."""
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
