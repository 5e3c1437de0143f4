"""Calibration targets."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray


@dataclass(frozen=True)
class Panel:
    """One chessboard of the V board.

    Its frame has the origin at the first inner corner, x along the columns, y along the rows, z by the right hand.
    """

    columns: int
    rows: int
    square_m: float

    def corners_panel(self) -> FloatArray:
        """Inner corners (columns * rows, 3) in the panel's frame, metres, row after row; z = 0."""
        x, y = np.meshgrid(np.arange(self.columns), np.arange(self.rows))
        flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
        return np.asarray(flat * self.square_m)
