"""Finding chessboards in an image to a pixel or so, quickest detector first (refinement is in `chessboard`)."""

from __future__ import annotations

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.grid_map import fit_grid_map, grid_points
from lidarpose.geometry.arrays import FloatArray

Image8 = NDArray[np.uint8]
Detector = Callable[[Image8, int, int], FloatArray | None]

_CLASSIC = cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_FAST_CHECK
# Pixels of the longer side of the image on which the quick detectors work.
_QUICK_SIDE = 900


def find_grid(image: Image8, columns: int, rows: int) -> FloatArray | None:
    """Inner corners (columns * rows, 2) of a board, row after row, to about a pixel; None if there is none.

    The order is that of a grid seen from its front: columns to rows turns as x to y does in the image.
    """
    for detector in (_classic_reduced, _classic, _sector_reduced, _sector):
        corners = detector(image, columns, rows)
        if corners is not None and _is_a_grid(corners, columns, rows):
            return seen_from_front(corners, columns, rows)
    return None


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


def _is_a_grid(corners: FloatArray, columns: int, rows: int) -> bool:
    """False where a detector has mixed up two boards or the background: then no smooth map fits."""
    try:
        fit = fit_grid_map(columns, rows, grid_points(columns, rows), corners)
    except ValueError:
        return False
    pitch = np.linalg.norm(np.diff(corners.reshape(rows, columns, 2), axis=1), axis=-1).min()
    return bool(fit.inliers.mean() > 0.9 and np.abs(fit.residuals_px).max() < 0.3 * pitch)


def _reduced(image: Image8) -> tuple[Image8, float]:
    factor = _QUICK_SIDE / max(image.shape)
    if factor >= 0.8:
        return image, 1.0
    small = cv2.resize(image, None, fx=factor, fy=factor, interpolation=cv2.INTER_AREA)
    return np.asarray(small, dtype=np.uint8), factor


def _classic_reduced(image: Image8, columns: int, rows: int) -> FloatArray | None:
    small, factor = _reduced(image)
    return _from_reduced(_classic(small, columns, rows), factor) if factor < 1.0 else None


def _sector_reduced(image: Image8, columns: int, rows: int) -> FloatArray | None:
    small, factor = _reduced(image)
    return _from_reduced(_sector(small, columns, rows), factor) if factor < 1.0 else None


def _classic(image: Image8, columns: int, rows: int) -> FloatArray | None:
    found, corners = cv2.findChessboardCorners(image, (columns, rows), flags=_CLASSIC)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def _sector(image: Image8, columns: int, rows: int) -> FloatArray | None:
    """Duda and Frese, "Accurate detection and localization of checkerboard corners" (2018)."""
    found, corners = cv2.findChessboardCornersSB(image, (columns, rows), flags=cv2.CALIB_CB_NORMALIZE_IMAGE)
    return np.asarray(corners, dtype=np.float64).reshape(-1, 2) if found else None


def _from_reduced(corners: FloatArray | None, factor: float) -> FloatArray | None:
    """Pixel centres of a reduced image in the full one's pixels."""
    return None if corners is None else (corners + 0.5) / factor - 0.5
