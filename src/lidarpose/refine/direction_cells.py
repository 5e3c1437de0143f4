"""Which returns lie in one spot: directions sorted into a grid of angles."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray


def direction_grid(rays: FloatArray, cell_rad: float) -> IntArray:
    """Row and column (2, N), from 0, of rays (3, N) in a grid of angles about the bundle's middle."""
    local = np.linalg.svd(rays.mean(axis=1)[None])[2] @ rays
    angles = local[1:]
    angles /= np.maximum(np.abs(local[0]), 1e-12)
    np.arctan(angles, out=angles)
    angles *= 1.0 / cell_rad
    angles -= np.floor(angles.min(axis=1, keepdims=True))
    # Counted from 0 on: what is cut off is the fraction.
    return np.asarray(angles.astype(np.int64))


def direction_cells(rays: FloatArray, cell_rad: float) -> IntArray:
    """Which cell (N,) of `direction_grid` each ray (3, N) falls in, those that hold any counted from 0."""
    grid = direction_grid(rays, cell_rad)
    flat = grid[0] * (int(grid[1].max()) + 1) + grid[1]
    number = np.cumsum(np.bincount(flat) > 0) - 1
    return np.asarray(number[flat], dtype=np.int64)
