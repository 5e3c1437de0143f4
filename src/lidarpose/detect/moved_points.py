"""What does not stand still: the points of a frame where no frame of another place has any.

The sensor stays where it is while the target is moved about, so that walls, ground and clutter return from the same
places in all frames. What is left of a frame is the target, a few per cent of all points, and what else was moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays

CELL_M = 0.15
# A surface that stands still returns within this of where it did: some times the range noise.
SLACK_M = 0.04
# Beyond this no target has enough returns to be found.
REACH_M = 16.0
# Fewer moved points in a cell are mixed pixels and noise.
FEWEST_IN_A_CELL = 3
# By how much kernels are done sooner, on one core.
SAVED_S_PER_POINT = 2e-8


def moved_points(frames: Sequence[NDArray[np.floating[Any]]]) -> tuple[IntArray, ...]:
    """For each frame (N, 3), the indices (M,) of points that stand where no other frame has points.

    Parameters
    ----------
    frames
        One frame of each of a few places, metres, finite, the sensor unmoved.
    """
    rows = [np.ascontiguousarray(frame.T) for frame in frames]
    low = np.min([f.min(axis=1) for f in rows], axis=0).clip(-REACH_M, REACH_M) - 2.0 * CELL_M
    high = np.max([f.max(axis=1) for f in rows], axis=0).clip(-REACH_M, REACH_M) + 2.0 * CELL_M
    shape = np.ceil((high - low) / CELL_M).astype(np.int64) + 1
    grids = [_Cells(columns, low, shape) for columns in rows]
    return tuple(grid.left_by([other.taken for other in grids if other is not grid]) for grid in grids)


class _Cells:
    """A frame's points (3, N) within reach, the cell of each, and all cells that hold any of them or nearly do."""

    def __init__(self, columns: NDArray[np.floating[Any]], low: FloatArray, shape: IntArray) -> None:
        strides = np.array([shape[1] * shape[2], shape[2], 1], dtype=np.int32)
        columns = columns.astype(np.float32, copy=False)
        near = np.abs(columns) < REACH_M
        self.index = np.flatnonzero(near[0] & near[1] & near[2])
        scaled = columns.take(self.index, axis=1)
        scaled -= low[:, None].astype(np.float32)
        scaled /= np.float32(CELL_M)
        self.cell = strides @ scaled.astype(np.int32)
        self.taken: BoolArray = np.zeros(int(np.prod(shape)), dtype=bool)
        slack = np.float32(SLACK_M / CELL_M)
        if pays(SAVED_S_PER_POINT * len(self.index), "detect.target_kernels"):
            from lidarpose.detect.target_kernels import mark_cells

            mark_cells(scaled, slack, strides, self.taken)
            return
        ends = [(scaled + step).astype(np.int32) * strides[:, None] for step in (-slack, slack)]
        for x in ends:
            for y in ends:
                plane = x[0] + y[1]
                for z in ends:
                    self.taken[plane + z[2]] = True

    def left_by(self, others: Sequence[BoolArray]) -> IntArray:
        """The points in cells that no other frame has taken, but for lone ones."""
        free = np.ones(len(self.cell), dtype=bool)
        for taken in others:
            free &= ~taken[self.cell]
        alone = np.flatnonzero(free)
        _, number, count = np.unique(self.cell[alone], return_inverse=True, return_counts=True)
        return np.asarray(self.index[alone[count[number] >= FEWEST_IN_A_CELL]])
