"""Which returns lie in one spot: directions sorted into a grid of angles."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray, perpendicular_pair, unit
from lidarpose.geometry.compiled import pays

# By how much kernels are done sooner, on one core.
SAVED_S_PER_RAY = 1e-8


@dataclass(frozen=True, eq=False)
class DirectionGrid:
    """Which cell (N,) of a grid of angles each ray is in.

    The grid has a rim of empty cells; its rows of `width` come one after the other.
    """

    cell: IntArray
    width: int

    @staticmethod
    def of(rays: FloatArray, cell_rad: float) -> DirectionGrid:
        """Of unit rays (3, N), about the bundle's middle.

        Angles from the middle are stereographic, twice the tangent of half the angle: a sixth too large at 70 degrees.
        """
        scale = 2.0 / cell_rad
        if pays(SAVED_S_PER_RAY * rays.shape[1], "refine.corner_kernels"):
            from lidarpose.refine.corner_kernels import grid_cells

            cell, width = grid_cells(rays, scale)
            return DirectionGrid(cell, int(width))
        middle = unit(rays.sum(axis=1))
        local = np.vstack([middle, *perpendicular_pair(middle)]) @ rays
        angles = local[1:]
        angles *= scale / np.maximum(1.0 + local[0], 1e-12)
        angles -= np.floor(angles.min(axis=1, keepdims=True))
        # Counted from 0 on: what is cut off is the fraction.
        row, column = angles.astype(np.int64)
        width = int(column.max()) + 3
        return DirectionGrid((row + 1) * width + column + 1, width)
