"""What is printed on a panel: black and white squares inside a white margin, cut at the plate's edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.targets import Panel


@dataclass(frozen=True)
class Plate:
    """The outline of a panel in its own frame: ``x_min <= x <= x_max``, ``y_min <= y <= y_max``, metres."""

    x_min: float
    x_max: float
    y_min: float
    y_max: float

    @staticmethod
    def of(panel: Panel, margin_m: float) -> Plate:
        """The squares (one more than the inner corners each way) with a white margin around them."""
        reach = panel.square_m + margin_m
        return Plate(
            -reach,
            (panel.columns - 1) * panel.square_m + reach,
            -reach,
            (panel.rows - 1) * panel.square_m + reach,
        )

    def outline(self) -> FloatArray:
        """The four corners (4, 3), one after the other around the plate, z = 0."""
        x, y = (self.x_min, self.x_max), (self.y_min, self.y_max)
        return np.array([[x[0], y[0], 0.0], [x[1], y[0], 0.0], [x[1], y[1], 0.0], [x[0], y[1], 0.0]])

    def contains(self, points_panel: ArrayLike, inset_m: float = 0.0) -> BoolArray:
        """Which points (..., >= 2) lie on the plate, at least `inset_m` from its edges."""
        p = np.asarray(points_panel, dtype=np.float64)
        x, y = p[..., 0], p[..., 1]
        inside_x = (x >= self.x_min + inset_m) & (x <= self.x_max - inset_m)
        return np.asarray(inside_x & (y >= self.y_min + inset_m) & (y <= self.y_max - inset_m))


def is_black(panel: Panel, points_panel: ArrayLike) -> BoolArray:
    """Which points (..., >= 2) of a panel lie on a black square. The square before the first corner is black."""
    p = np.asarray(points_panel, dtype=np.float64)
    column = np.floor(p[..., 0] / panel.square_m).astype(np.int64)
    row = np.floor(p[..., 1] / panel.square_m).astype(np.int64)
    on_squares = (column >= -1) & (column < panel.columns) & (row >= -1) & (row < panel.rows)
    return np.asarray(on_squares & ((column + row) % 2 == 0))
