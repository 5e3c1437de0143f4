"""Where every point of a chessboard is in the image: a homography and a smooth bend for lens and board.

Grid coordinates count squares: the first inner corner is (0, 0), x runs along the columns, y along the rows. The map
needs no camera: a homography carries the perspective, a cubic polynomial the rest (distortion of the lens, a board
that is not quite flat). It smooths the detected corners, and its residuals tell how well they were detected.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.robust import mad_sigma


@dataclass(frozen=True, eq=False)
class GridMap:
    """Map from grid coordinates (squares) to pixels.

    Attributes
    ----------
    columns, rows
        Inner corners.
    homography : (3, 3)
        Grid coordinates to pixels, without the bend.
    bend : (n, 2)
        Coefficients, pixels, of the polynomial in grid coordinates scaled to [-1, 1] over the inner corners.
    """

    columns: int
    rows: int
    homography: FloatArray
    bend: FloatArray

    def pixels(self, grid: ArrayLike) -> FloatArray:
        """Pixels (..., 2) of grid coordinates (..., 2)."""
        g = np.asarray(grid, dtype=np.float64)
        found = _apply_homography(self.homography, g)
        found += np.moveaxis(self._bent(*self._scaled(g)), 0, -1)
        return found

    def jacobian(self, grid: ArrayLike) -> FloatArray:
        """Derivative (..., 2, 2) of the pixels by the grid coordinates, by central differences of 0.01 squares."""
        g = np.asarray(grid, dtype=np.float64)
        steps = np.eye(2) * 0.01
        columns = [(self.pixels(g + h) - self.pixels(g - h)) / 0.02 for h in steps]
        return np.stack(columns, axis=-1)

    def grid(self, pixels: ArrayLike) -> FloatArray:
        """Grid coordinates (..., 2) of pixels (..., 2): from the homography, then corrected for the bend.

        The slope stays that of the start (the bend is small); each of the steps gains two digits or more.
        """
        p = np.asarray(pixels, dtype=np.float64)
        g = _apply_homography(np.linalg.inv(self.homography), p)
        J = self.jacobian(g)
        det = J[..., 0, 0] * J[..., 1, 1] - J[..., 0, 1] * J[..., 1, 0]
        for _ in range(3):
            error = self.pixels(g) - p
            step_x = (J[..., 1, 1] * error[..., 0] - J[..., 0, 1] * error[..., 1]) / det
            step_y = (J[..., 0, 0] * error[..., 1] - J[..., 1, 0] * error[..., 0]) / det
            g = g - np.stack([step_x, step_y], axis=-1)
        return g

    def outline(self, margin: float = 1.0, per_side: int = 9) -> FloatArray:
        """Polygon (4 * (per_side - 1), 2) in pixels around the inner corners, wider by `margin` squares."""
        left, right = -margin, self.columns - 1 + margin
        top, bottom = -margin, self.rows - 1 + margin
        s = np.linspace(0.0, 1.0, per_side)[:-1]
        corners = np.array([[left, top], [right, top], [right, bottom], [left, bottom]])
        sides = [a + s[:, None] * (b - a) for a, b in zip(corners, np.roll(corners, -1, axis=0), strict=True)]
        return self.pixels(np.concatenate(sides))

    def _scaled(self, grid: FloatArray) -> FloatArray:
        """Grid coordinates (2, ...) from -1 to 1 over the inner corners."""
        half = np.array([max(self.columns - 1, 1), max(self.rows - 1, 1)]) / 2.0
        # Well beyond the outer squares the bend stays as it is at their edge: a polynomial knows nothing out there.
        reach = 1.0 + 1.7 / half
        half, reach = (x.reshape(2, *[1] * (grid.ndim - 1)) for x in (half, reach))
        return np.clip(np.moveaxis(grid, -1, 0) / half - 1.0, -reach, reach)

    def _bent(self, s: FloatArray, t: FloatArray) -> FloatArray:
        """The polynomial (2, ...) by Horner's scheme in both variables, in place: a fifth of the terms' time."""
        degree = _DEGREES[len(self.bend)]
        found = np.empty((2, *s.shape))
        inner = np.empty((1, *s.shape))
        for k in (0, 1):
            last = len(self.bend)
            total = found[k : k + 1]
            total[...] = self.bend[last - 1, k]
            for i in range(degree - 1, -1, -1):
                # The coefficients of s^i times 1, t, t^2, ... stand together.
                last -= degree - i
                of_t = self.bend[last - (degree - i) - 1 : last, k]
                inner[...] = of_t[-1]
                for value in of_t[-2::-1]:
                    inner *= t
                    inner += value
                total *= s
                total += inner
        return found

    def _terms(self, grid: FloatArray) -> FloatArray:
        s, t = self._scaled(grid)
        degree = _DEGREES[len(self.bend)]
        powers_s, powers_t = [np.ones_like(s)], [np.ones_like(t)]
        for _ in range(degree):
            powers_s.append(powers_s[-1] * s)
            powers_t.append(powers_t[-1] * t)
        terms = [powers_s[i] * powers_t[j] for i in range(degree + 1) for j in range(degree + 1 - i)]
        return np.stack(terms, axis=-1)


# Number of terms of a polynomial in two variables, and its degree.
_DEGREES = {3: 1, 6: 2, 10: 3, 15: 4, 21: 5}


def grid_points(columns: int, rows: int) -> FloatArray:
    """Grid coordinates (columns * rows, 2) of the inner corners, row after row."""
    x, y = np.meshgrid(np.arange(columns), np.arange(rows))
    return np.column_stack([x.ravel(), y.ravel()]).astype(np.float64)


@dataclass(frozen=True, eq=False)
class GridFit:
    """A map with what the corners say of it.

    Attributes
    ----------
    inliers : (N,)
        Corners that agree with their neighbours.
    sigma_px
        Standard deviation of one coordinate of one corner about the true smooth map, from the residuals of all.
    """

    map: GridMap
    residuals_px: FloatArray
    inliers: BoolArray
    sigma_px: float


def fit_grid_map(columns: int, rows: int, grid: FloatArray, pixels: FloatArray) -> GridFit:
    """Robust least squares of a `GridMap` on corners `grid` (N, 2) seen at `pixels` (N, 2), N >= 4.

    The polynomial's degree follows from the number of corners, so that some are left to judge the fit by.
    """
    terms = max(count for count in _DEGREES if count == 3 or len(grid) >= 3 * count)
    inliers = np.ones(len(grid), dtype=bool)
    for _ in range(4):
        homography = _fit_homography(grid[inliers], pixels[inliers])
        flat = GridMap(columns, rows, homography, np.zeros((terms, 2)))
        design = flat._terms(grid)
        rest = pixels - flat.pixels(grid)
        bend = np.linalg.lstsq(design[inliers], rest[inliers], rcond=None)[0]
        residuals = rest - design @ bend
        freedom = max(1.0 - terms / inliers.sum(), 0.1)
        scale = mad_sigma(residuals[inliers], centred=True) / np.sqrt(freedom)
        again = np.abs(residuals).max(axis=1) <= max(5.0 * scale, 1e-6)
        if again.sum() < max(terms, 4) or np.array_equal(again, inliers):
            break
        inliers = again
    sigma = float(np.sqrt((residuals[inliers] ** 2).mean() / freedom))
    return GridFit(GridMap(columns, rows, homography, bend), residuals, inliers, sigma)


def _fit_homography(grid: FloatArray, pixels: FloatArray) -> FloatArray:
    homography, _ = cv2.findHomography(grid.astype(np.float64), pixels.astype(np.float64), 0)
    if homography is None:
        raise ValueError("the corners determine no homography")
    return np.asarray(homography, dtype=np.float64)


def _apply_homography(homography: FloatArray, points: FloatArray) -> FloatArray:
    mapped = points @ homography[:, :2].T + homography[:, 2]
    return np.asarray(mapped[..., :2] / mapped[..., 2:])
