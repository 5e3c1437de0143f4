"""What does not stand still: the points of a frame where no frame of another place has any.

The sensor stays where it is while the target is moved about, so that walls, ground and clutter return from the same
places in all frames. What is left of a frame is the target, a few per cent of all points, and what else was moved.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import IntArray
from lidarpose.geometry.compiled import pays

CELL_M = 0.15
# A surface that stands still returns within this of where it did: some times the range noise.
SLACK_M = 0.04
# Beyond this no target has enough returns to be found.
REACH_M = 16.0
# Fewer moved points in a cell are mixed pixels and noise.
FEWEST_IN_A_CELL = 3
# By how much kernels are done sooner.
SAVED_S_PER_POINT = 1.5e-8

Float32Array = NDArray[np.float32]


def moved_points(frames: Sequence[NDArray[np.floating[Any]]]) -> tuple[IntArray, ...]:
    """For each frame (N, 3), the indices (M,) of points that stand where no other frame has points.

    Parameters
    ----------
    frames
        One frame of each of a few places, eight at most, metres, finite, the sensor unmoved.
    """
    quick = pays(SAVED_S_PER_POINT * sum(map(len, frames)), "detect.target_kernels")
    rows = [np.ascontiguousarray(frame.T, dtype=np.float32) for frame in frames]
    low = np.min([f.min(axis=1) for f in rows], axis=0).clip(-REACH_M, REACH_M) - 2.0 * CELL_M
    high = np.max([f.max(axis=1) for f in rows], axis=0).clip(-REACH_M, REACH_M) + 2.0 * CELL_M
    shape = np.ceil((high - low) / CELL_M).astype(np.int64) + 1
    # One map of all frames, a bit each.
    taken = np.zeros(int(np.prod(shape)), dtype=np.uint8)
    others = [np.uint8((1 << len(frames)) - 1 - (1 << k)) for k in range(len(frames))]
    if quick:
        return _moved_compiled(frames, low.astype(np.float32), shape, taken, others)
    grids = [_Cells(columns, low, shape) for columns in rows]
    for k, grid in enumerate(grids):
        taken[grid.cell] |= np.uint8(1 << k)
    return tuple(grid.left_by(taken, mine) for grid, mine in zip(grids, others, strict=True))


def _moved_compiled(
    frames: Sequence[NDArray[np.floating[Any]]],
    low: Float32Array,
    shape: IntArray,
    taken: NDArray[np.uint8],
    others: Sequence[np.uint8],
) -> tuple[IntArray, ...]:
    """`moved_points` by kernels."""
    from lidarpose.detect.target_kernels import left_alone, mark_cells

    scale, reach, slack = np.float32(1.0 / CELL_M), np.float32(REACH_M), np.float32(SLACK_M / CELL_M)
    strides = _strides(shape).astype(np.int64)
    flat = [np.ascontiguousarray(points).reshape(-1) for points in frames]
    cells = [mark_cells(p, low, scale, reach, strides, np.uint8(1 << k), taken) for k, p in enumerate(flat)]
    return tuple(
        left_alone(p, c, low, scale, strides, mine, taken, slack, FEWEST_IN_A_CELL)
        for p, c, mine in zip(flat, cells, others, strict=True)
    )


def _strides(shape: IntArray) -> NDArray[np.int32]:
    """How far apart cells are in the map along x, y and z: the ground, most of all, lies in few layers of it."""
    return np.array([1, shape[0], shape[0] * shape[1]], dtype=np.int32)


class _Cells:
    """A frame's points (3, N) within reach in units of cells, and the cell (N,) of each."""

    def __init__(self, columns: Float32Array, low: Float32Array, shape: IntArray) -> None:
        near = np.abs(columns) < np.float32(REACH_M)
        self.index = np.flatnonzero(near[0] & near[1] & near[2])
        self.scaled = columns.take(self.index, axis=1)
        self.scaled -= low[:, None]
        self.scaled *= np.float32(1.0 / CELL_M)
        self.strides = _strides(shape)
        x, y, z = self.scaled.astype(np.int32) * self.strides[:, None]
        self.cell = x + y + z

    def left_by(self, taken: NDArray[np.uint8], others: np.uint8) -> IntArray:
        """The points that no other frame's cells hold or nearly do, but for lone ones."""
        # Most stand where others do to the cell; of the rest it is asked more closely.
        alone = np.flatnonzero((taken.take(self.cell) & others) == 0)
        alone = alone[((taken.take(self._cells_around(alone)) & others) == 0).all(axis=0)]
        cell = self.cell.take(alone)
        ordered = np.sort(cell)
        count = ordered.searchsorted(cell, "right") - ordered.searchsorted(cell, "left")
        return np.asarray(self.index[alone[count >= FEWEST_IN_A_CELL]])

    def _cells_around(self, chosen: IntArray) -> NDArray[np.int32]:
        """The cells (8, M) in which a point stands that is moved by the slack along each axis, to and fro."""
        scaled, slack = self.scaled.take(chosen, axis=1), np.float32(SLACK_M / CELL_M)
        ends = np.stack([(scaled + step).astype(np.int32) * self.strides[:, None] for step in (-slack, slack)])
        x, y, z = ends.swapaxes(0, 1)
        return np.asarray((x[:, None, None] + y[:, None] + z).reshape(8, -1))
