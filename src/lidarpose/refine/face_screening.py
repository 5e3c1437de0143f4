"""What lies on a face of the target but is not of it: ground at its foot, a shelf behind it, a strap, a hand.

The corner paper screens by neighbours' normals (its second screening). A spot's mean residual over all frames says the
same, and sooner.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import median
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.direction_cells import DirectionGrid
from lidarpose.refine.face_systems import SAVED_S_PER_RETURN, face_residuals, face_rows, normal_and_tangents, subset_of

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
KERNELS = "refine.corner_kernels"


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
    spots = None if _is_dense(seen.count(), seen.width) else _spots(seen)
    kept = np.arange(len(rim))
    # Where scan lines lie so close, none is needed outside of the outline to tell where the face ends.
    if spots is None or _is_rim_odd(seen.residual[rim] - spots.level_m, sigma_m, spots.spread_m):
        kept = np.flatnonzero(~rim)
        if len(kept) == 0:
            return subset_of(returns, kept)
        seen = seen.subset(kept) if len(kept) < len(rim) else seen
        spots = _spots(seen)
    odd = _odd(spots, sigma_m)
    if odd.any() and not _is_turned(returns.rays, kept, seen, spots, normal, corner, sigma_m):
        if _is_dense(spots.count, seen.width):
            # What is something else does not end where a spot does.
            odd |= _sum_around(odd, seen.width) > 0
        kept = kept.take(np.flatnonzero(~odd.take(seen.cell)))
    return returns if len(kept) == len(rim) else subset_of(returns, kept)


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
        if pays(SAVED_S_PER_RETURN * len(returns), KERNELS):
            from lidarpose.refine.corner_kernels import seen_on_face

            range_m = np.ascontiguousarray(returns.range_m, dtype=np.float64)
            residual, nearness, cell, width = seen_on_face(returns.rays, range_m, normal, corner, 2.0 / SPOT_RAD)
            return _Seen(residual, nearness, cell, int(width))
        grid = DirectionGrid.of(returns.rays, SPOT_RAD)
        return _Seen(face_residuals(returns, normal, corner), corner @ returns.rays, grid.cell, grid.width)

    def subset(self, index: IntArray) -> _Seen:
        return _Seen(self.residual.take(index), self.nearness.take(index), self.cell.take(index), self.width)

    def count(self) -> IntArray:
        """How many returns each cell (M,) holds."""
        return np.bincount(self.cell)

    def sums(self, sure: IntArray) -> tuple[IntArray, FloatArray, IntArray, FloatArray]:
        """By cell (M,): how many returns it holds, the sum of what they are off by, and how many of those that `sure`
        (K,) names; and what these are off by (K,)."""
        if pays(SAVED_S_PER_RETURN * len(self.cell), KERNELS):
            from lidarpose.refine.corner_kernels import sums_by_cell

            count, total, mine, off = sums_by_cell(self.residual, self.cell, sure, int(self.cell.max()) + 1)
            return count, total, mine, off
        count = np.bincount(self.cell)
        mine = np.bincount(self.cell.take(sure), minlength=len(count))
        return count, np.asarray(np.bincount(self.cell, self.residual)), mine, self.residual.take(sure)


@dataclass(frozen=True, eq=False)
class _Spots:
    """Cell by cell (M,): the mean of what returns are off by against the level of what is next to the corner, and how
    many there are; how far spots next to the corner are off, as a standard deviation."""

    mean: FloatArray
    count: IntArray
    level_m: float
    spread_m: float


def _is_dense(count: IntArray, width: int) -> bool:
    """Whether scan lines lie closer than spots, so that most neighbours of a spot hold returns too."""
    there = count > 0
    around = float(there @ _sum_around(there, width))
    return around > DENSE_NEIGHBOURS * int(np.count_nonzero(there))


def _spots(seen: _Seen) -> _Spots:
    count, total, mine, off = seen.sums(_next_to_corner(seen.nearness))
    level_m = median(off)
    mean = np.where(count > 0, total / np.maximum(count, 1) - level_m, 0.0)
    return _Spots(mean, count, level_m, _spread(mean, count, mine))


def _is_rim_odd(residual: FloatArray, sigma_m: float, spread_m: float) -> bool:
    """Whether what lies around a face's outline is something else, at some of its sides at least."""
    if len(residual) == 0:
        return False
    off = abs(float(residual.mean()))
    return off > ODD_RIM_SPREADS * spread_m and off * np.sqrt(len(residual)) > ODD_RIM_SIGMAS * sigma_m


def _is_turned(
    rays: FloatArray,
    kept: IntArray,
    seen: _Seen,
    spots: _Spots,
    normal: FloatArray,
    corner: FloatArray,
    sigma_m: float,
) -> bool:
    """Whether a plane of its own explains a face to the noise: then nothing on it is foreign.

    `seen` is what `kept` (N,) names of rays (3, L).
    """
    residual = seen.residual - spots.level_m
    if pays(SAVED_S_PER_RETURN * len(kept), KERNELS):
        from lidarpose.refine.corner_kernels import plane_by_cell

        axes = normal_and_tangents(normal)
        information, pull, by_cell = plane_by_cell(
            rays, kept, residual, seen.cell, len(spots.count), axes, axes @ corner
        )
    else:
        _, rows = face_rows(rays.take(kept, axis=1), normal, corner)
        information, pull = rows @ rows.T, rows @ residual
        by_cell = np.stack([np.bincount(seen.cell, row) for row in rows], axis=1)
    # Rows in metres and metres by radian: all about one.
    own = by_cell @ np.linalg.lstsq(information, pull, rcond=1e-12)[0] / np.maximum(spots.count, 1)
    return _only_noise(np.where(spots.count > 0, spots.mean - own, 0.0), spots.count, sigma_m)


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
