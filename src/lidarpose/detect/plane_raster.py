"""Where on its plane a patch lies: a raster of occupied cells, and the size of cells across which a patch hangs
together."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, perpendicular_pair
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.robust import median

# A patch is connected across gaps of this share of its range, which spans the lines of a 16-beam LiDAR on a slope.
GAP_PER_RANGE = 0.06
MIN_GAP_M = 0.04
# Of a raster, each way; what lies beyond is no part of it.
MOST_CELLS = 4000
# Pieces of rasters of more cells are found by SciPy, whose import takes a tenth of a second.
FEW_CELLS = 2000


@dataclass(frozen=True, eq=False)
class PlaneRaster:
    """A grid on a plane: cells of side `cell_m` along the axes (2, 3), counted from `origin` (2,)."""

    axes: FloatArray
    cell_m: float
    origin: IntArray
    shape: tuple[int, int]

    def cells(self, points: NDArray[np.floating]) -> IntArray:
        """Cells (M,) of points (M, 3) as flat numbers; -1 outside."""
        return self._numbers(_along(points, self.axes, self.cell_m))

    def _numbers(self, along: IntArray) -> IntArray:
        u, v = along - self.origin[:, None]
        inside = (u >= 0) & (u < self.shape[0]) & (v >= 0) & (v < self.shape[1])
        return np.where(inside, u * self.shape[1] + v, -1)


def _along(points: NDArray[np.floating], axes: FloatArray, cell_m: float) -> IntArray:
    """Coordinates (2, M) of points (M, 3) in whole cells."""
    rows = (axes / cell_m).astype(points.dtype)
    along = np.empty((2, len(points)), dtype=points.dtype)
    # Rounded as the kernels round it, which a library's product is not.
    for k, (a, b, c) in enumerate(rows):
        along[k] = points[:, 0] * a
        along[k] += points[:, 1] * b
        along[k] += points[:, 2] * c
    return np.asarray(np.floor(along, out=along).astype(np.int64))


def raster_of(points: NDArray[np.floating], plane: Plane, cell_m: float, border: int) -> tuple[PlaneRaster, IntArray]:
    """A raster around points (M, 3) with so many cells of border, and the points' cells (M,)."""
    axes = np.stack(perpendicular_pair(plane.normal))
    along = _along(points, axes, cell_m)
    low, high = along.min(axis=1) - border, along.max(axis=1) + border + 1
    shape = np.minimum(high - low, MOST_CELLS)
    raster = PlaneRaster(axes, cell_m, low, (int(shape[0]), int(shape[1])))
    return raster, raster._numbers(along)


def mean_and_covariance(points: NDArray[np.floating]) -> tuple[FloatArray, FloatArray]:
    """Of points (M, 3), by sums of products in double precision: far quicker than NumPy's, and good to a nanometre."""
    x = points.astype(np.float64)
    mean = np.ones(len(x)) @ x / len(x)
    return mean, (x.T @ x - len(x) * np.outer(mean, mean)) / (len(x) - 1)


def gap_m(points: NDArray[np.floating]) -> float:
    """The gap across which points (M, 3) of one surface still count as connected."""
    ranges = np.sqrt(np.einsum("ij,ij->i", points, points))
    return max(MIN_GAP_M, GAP_PER_RANGE * median(ranges))


def cell_size_m(points: NDArray[np.floating]) -> float:
    """Side of cells in which points (M, 3) of one surface hang together: a thinned cloud has gaps of its own."""
    return max(gap_m(points), spacing_m(points))


def spacing_m(points: NDArray[np.floating]) -> float:
    """Twice the distance between neighbours that the number of points (M, 3) on a plane and their extents give."""
    if len(points) < 4:
        return 0.0
    variance = np.maximum(np.linalg.eigvalsh(mean_and_covariance(points)[1]), 0.0)
    return 2.0 * float((12.0**2 * variance[1] * variance[2]) ** 0.25 / np.sqrt(len(points)))


def grown(occupied: BoolArray) -> BoolArray:
    """Cells (n, m) and their eight neighbours."""
    wide = occupied.copy()
    wide[1:] |= occupied[:-1]
    wide[:-1] |= occupied[1:]
    grown = wide.copy()
    grown[:, 1:] |= wide[:, :-1]
    grown[:, :-1] |= wide[:, 1:]
    return grown


def largest_piece(counts: IntArray) -> BoolArray:
    """Of cells (n, m) with so many points each, those of the piece, joined over sides and corners, that holds most."""
    occupied = counts > 0
    if occupied.size > FEW_CELLS:
        from scipy import ndimage

        labels = ndimage.label(occupied, structure=np.ones((3, 3)))[0]
        sizes = np.bincount(labels.ravel(), weights=counts.ravel())
        sizes[0] = 0
        return np.asarray(occupied & (labels == np.argmax(sizes)))
    # All cells in the bits of one number, each row with an empty cell behind it: shifts reach all neighbours at once.
    width = counts.shape[1] + 1
    packed = np.packbits(np.pad(occupied, ((0, 0), (0, 1))), bitorder="little").tobytes()
    left = int.from_bytes(packed, "little")
    best, most, unseen = occupied, 0, int(counts.sum())
    while most < unseen:
        piece = _grown_from(left & -left, left, width)
        if piece == left and not most:
            return occupied
        left ^= piece
        bits = np.frombuffer(piece.to_bytes(len(packed), "little"), dtype=np.uint8)
        cells = np.unpackbits(bits, bitorder="little", count=width * len(counts)).reshape(len(counts), width)[:, :-1]
        held = int(counts[cells > 0].sum())
        unseen -= held
        if held > most:
            best, most = cells > 0, held
    return best


def _grown_from(piece: int, occupied: int, width: int) -> int:
    """All cells that hang together with some, in the bits of rows of a width."""
    while True:
        wide = piece | piece << 1 | piece >> 1
        grown = (wide | wide << width | wide >> width) & occupied
        if grown == piece:
            return piece
        piece = grown
