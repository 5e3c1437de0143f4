"""Finding the asked-for chessboards in an image, to about a pixel (refinement is in `chessboard`).

Grids of any size are sought first (`lattice`), in the reduced image, in the full one, and smoothed against noise; then
OpenCV's detectors, which know the size that they look for, with the boards that were found already painted over.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from lidarpose.detect.grid_map import GridMap, fit_grid_map, grid_points
from lidarpose.detect.lattice import Image8, Lattice, find_lattices
from lidarpose.geometry.arrays import FloatArray

Size = tuple[int, int]
"""Inner corners: columns, rows."""

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
# Pixels of the longer side of the reduced image.
_QUICK_SIDE = 900

# Fewer corners than this in line may be anything.
_LEAST_NAMED = 16


@dataclass(frozen=True, eq=False)
class GridSearch:
    """What was found.

    Attributes
    ----------
    grids
        For each size asked for: corners (columns * rows, 2), row after row as seen from the front; None if not found.
    other_sizes
        Sizes of grids in the image that nobody asked for, the largest first.
    """

    grids: tuple[FloatArray | None, ...]
    other_sizes: tuple[Size, ...]


def find_grids(image: Image8, sizes: Sequence[Size], *, thorough: bool = True) -> GridSearch:
    """Find a grid for each of `sizes` (several may be equal: different grids), wherever they are in the image.

    The slow detectors, seconds an image without a board, are tried only if the search is to be `thorough`.
    """
    found: list[FloatArray | None] = [None] * len(sizes)
    others: list[Lattice] = []
    for lattices in _lattice_attempts(image):
        fresh = [lattice for lattice in lattices if not _is_known(lattice, found)]
        others = _assign(fresh, sizes, found, others)
        if all(corners is not None for corners in found):
            break
    else:
        if thorough:
            _try_detectors(image, sizes, found, others)
    return GridSearch(tuple(found), _sizes(others))


def seen_from_front(corners: FloatArray, columns: int, rows: int) -> FloatArray:
    """The same corners in one of the two orders that a board seen from its front allows.

    Columns to rows must turn like the image's x to y, else the board would be seen through its back. Of the two
    orders left (the pattern repeats after half a turn) the one whose first corner is nearer the upper left is taken.
    """
    grid = corners.reshape(rows, columns, 2)
    along, down = grid[0, -1] - grid[0, 0], grid[-1, 0] - grid[0, 0]
    if along[0] * down[1] - along[1] * down[0] < 0.0:
        grid = grid[:, ::-1]
    if grid[0, 0].sum() > grid[-1, -1].sum():
        grid = grid[::-1, ::-1]
    return np.ascontiguousarray(grid.reshape(-1, 2))


def _lattice_attempts(image: Image8) -> Iterator[list[Lattice]]:
    """Lattices in image pixels, from the quickest attempt to the slowest."""
    small, factor = _reduced(image)
    yield [_enlarged(lattice, factor) for lattice in find_lattices(small)]
    yield [_enlarged(lattice, factor) for lattice in find_lattices(small, blur_px=2.0, least_contrast=0.3)]
    if factor < 1.0:
        yield find_lattices(image)
    half = cv2.resize(small, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    yield [_enlarged(lattice, 0.5 * factor) for lattice in find_lattices(np.asarray(half, dtype=np.uint8))]


def _reduced(image: Image8) -> tuple[Image8, float]:
    factor = _QUICK_SIDE / max(image.shape)
    if factor >= 0.8:
        return image, 1.0
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), factor


def _enlarged(lattice: Lattice, factor: float) -> Lattice:
    return lattice if factor == 1.0 else Lattice(_from_reduced(lattice.pixels, factor), lattice.grid)


def _from_reduced(pixels: FloatArray, factor: float) -> FloatArray:
    """Pixel centres of a reduced image in the full one's pixels."""
    return np.asarray((pixels + 0.5) / factor - 0.5)


def _assign(
    lattices: list[Lattice], sizes: Sequence[Size], found: list[FloatArray | None], others: list[Lattice]
) -> list[Lattice]:
    """Give lattices of the right size to the sizes that still lack one; return those that fit none."""
    left = list(others)
    for whole in lattices:
        used = False
        for lattice in [whole, *_split(whole, sizes)]:
            for k, size in enumerate(sizes):
                if found[k] is None and sorted(lattice.size) == sorted(size):
                    corners = _all_corners(lattice, size)
                    if corners is not None:
                        found[k] = corners
                        used = True
                        break
            if used and lattice is whole:
                break
        if not used:
            left.append(whole)
    return left


def _split(lattice: Lattice, sizes: Sequence[Size]) -> list[Lattice]:
    """Two boards that meet at a fold may look like one: its two ends, if they can hold two of the sizes."""
    if len(sizes) < 2:
        return []
    parts = []
    for axis in (0, 1):
        long, short = lattice.size[axis], lattice.size[1 - axis]
        lengths = [a for size in sizes for a, b in (size, size[::-1]) if b == short]
        if len(lengths) >= 2 and long >= 2 * min(lengths):
            length = min(lengths)
            for low in (0, long - length):
                part = (lattice.grid[:, axis] >= low) & (lattice.grid[:, axis] < low + length)
                grid = lattice.grid[part]
                parts.append(Lattice(lattice.pixels[part], grid - grid.min(axis=0)))
    return parts


def _all_corners(lattice: Lattice, size: Size) -> FloatArray | None:
    """Corners row after row; the few that are missing are put where the others predict them."""
    columns, rows = size
    grid, pixels = lattice.grid, lattice.pixels
    if lattice.size != size:
        grid = grid[:, ::-1]
    if len(grid) < 0.85 * columns * rows:
        return None
    fit = fit_grid_map(columns, rows, grid.astype(np.float64), pixels)
    corners = fit.map.pixels(grid_points(columns, rows))
    corners[grid[:, 1] * columns + grid[:, 0]] = pixels
    return seen_from_front(corners, columns, rows) if is_a_grid(corners, columns, rows) else None


def is_a_grid(corners: FloatArray, columns: int, rows: int) -> bool:
    """False where a detector has mixed up two boards or the background: then no smooth map fits."""
    try:
        fit = fit_grid_map(columns, rows, grid_points(columns, rows), corners)
    except ValueError:
        return False
    grid = corners.reshape(rows, columns, 2)
    pitch = min(np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() for axis in (0, 1))
    return bool(fit.inliers.mean() > 0.85 and np.abs(fit.residuals_px).max() < 0.3 * pitch)


def _is_known(lattice: Lattice, found: Sequence[FloatArray | None]) -> bool:
    """Whether a lattice lies on a board that was found before."""
    centre = lattice.pixels.mean(axis=0).astype(np.float32)
    hulls = [cv2.convexHull(corners.astype(np.float32)) for corners in found if corners is not None]
    return any(cv2.pointPolygonTest(hull, (float(centre[0]), float(centre[1])), False) >= 0 for hull in hulls)


def _sizes(lattices: list[Lattice]) -> tuple[Size, ...]:
    """Different sizes of grids that are no accident of the background, most corners first, wider than high."""
    whole = [x for x in lattices if len(x.grid) >= max(_LEAST_NAMED, 0.7 * x.size[0] * x.size[1])]
    large = sorted(whole, key=lambda lattice: -len(lattice.grid))
    return tuple(dict.fromkeys((max(lattice.size), min(lattice.size)) for lattice in large))


def _try_detectors(image: Image8, sizes: Sequence[Size], found: list[FloatArray | None], others: list[Lattice]) -> None:
    """OpenCV's detectors for the sizes that are missing, the board with most squares first."""
    canvas = image.copy()
    for size, corners in zip(sizes, found, strict=True):
        if corners is not None:
            _hide(canvas, fit_grid_map(*size, grid_points(*size), corners).map)
    for k in sorted(range(len(sizes)), key=lambda k: -sizes[k][0] * sizes[k][1]):
        if found[k] is None:
            corners = _detect(canvas, *sizes[k])
            if corners is not None and not _is_part_of_larger(corners, others):
                found[k] = corners
                _hide(canvas, fit_grid_map(*sizes[k], grid_points(*sizes[k]), corners).map)


def _is_part_of_larger(corners: FloatArray, others: list[Lattice]) -> bool:
    """Whether these corners are some of a larger grid's: then the board is not of the size that was asked for."""
    for lattice in others:
        if len(lattice.grid) > len(corners):
            distance = np.linalg.norm(corners[:, None] - lattice.pixels[None], axis=-1).min(axis=1)
            pitch = np.linalg.norm(corners[1] - corners[0])
            if (distance < 0.2 * pitch).mean() > 0.7:
                return True
    return False


def _hide(canvas: Image8, grid_map: GridMap) -> None:
    """Paint a found board over in its mean grey, up to nearly the outer squares' edge (another may begin there)."""
    polygon = np.round(grid_map.outline(margin=0.8)).astype(np.int32)
    x, y, width, height = cv2.boundingRect(polygon)
    view = canvas[max(y, 0) : y + height, max(x, 0) : x + width]
    cv2.fillPoly(canvas, [polygon], float(view.mean()) if view.size else 0.0)


def _detect(image: Image8, columns: int, rows: int) -> FloatArray | None:
    small, factor = _reduced(image)
    attempts: list[tuple[Callable[[Image8, int, int], FloatArray | None], Image8, float]] = [
        (_classic, small, factor),
        (_sector, small, factor),
    ]
    if factor < 1.0:
        # Not the classic detector at full size: it takes many seconds on an image without a board.
        attempts.append((_sector, image, 1.0))
    for detector, scene, scale in attempts:
        corners = detector(scene, columns, rows)
        if corners is not None and is_a_grid(corners, columns, rows):
            return seen_from_front(_from_reduced(corners, scale), columns, rows)
    return None


def _classic(image: Image8, columns: int, rows: int) -> FloatArray | None:
    if min(columns, rows) < 3:
        return None
    found, corners = cv2.findChessboardCorners(image, (columns, rows), flags=_CLASSIC)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def _sector(image: Image8, columns: int, rows: int) -> FloatArray | None:
    """Duda and Frese, "Accurate detection and localization of checkerboard corners" (2018)."""
    found, corners = cv2.findChessboardCornersSB(image, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None
