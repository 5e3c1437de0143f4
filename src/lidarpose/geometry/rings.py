"""Rings of a multi-beam LiDAR: which beam of the spinning column a point is of, and where the column's beams start.

The lenses of a multi-beam LiDAR make its beams cross before the axis about which they spin, so that the beam of each
ring leaves the axis at a height of its own, ``-crossing * tan(elevation)``. Drivers that leave these heights out, as if
all beams started at one point, squeeze everything vertically by the share ``crossing / distance``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray, IntArray

# Elevations are sorted into bins of this width; rings are apart by more empty bins than a ring has inside.
BIN_RAD = np.radians(0.02)
GAP_BINS = 4
# Rings fill at most this share of the elevations that they span: else the directions are no rings.
FILLED = 0.5
FEWEST_RINGS, MOST_RINGS = 3, 256
# A ring tells the height at which its beam leaves the axis by so many points over so many metres.
RING_POINTS, RING_REACH_M = 20, 0.02


def ring_numbers(directions: NDArray[np.floating]) -> IntArray | None:
    """The ring (N,) of each direction or point (N, 3), counted from the lowest, z being the axis of the spin; None
    where elevations do not come in rings."""
    x, y, z = np.asarray(directions, dtype=np.float64).T
    bins = np.floor(np.arctan2(z, np.hypot(x, y)) / BIN_RAD).astype(np.int64)
    if len(bins) == 0:
        return None
    bins -= bins.min()
    occupied = np.flatnonzero(np.bincount(bins))
    starts = np.diff(occupied, prepend=occupied[0]) > GAP_BINS
    rings = int(np.count_nonzero(starts)) + 1
    filled = int(np.count_nonzero(np.diff(occupied) <= GAP_BINS)) + rings
    if not FEWEST_RINGS <= rings <= MOST_RINGS or filled > FILLED * (occupied[-1] + 1):
        return None
    number = np.zeros(occupied[-1] + 1, dtype=np.int64)
    number[occupied] = np.cumsum(starts)
    return np.asarray(number[bins])


def crossing_of_points(points: NDArray[np.floating]) -> tuple[float, float] | None:
    """Where the beams of a cloud (N, 3) cross, in metres before the axis, with its standard deviation; 0 where they all
    start at one point. None where too few rings tell.

    Noise along a beam moves a point on its beam, so that the height of each ring's points over their distance from the
    axis is a straight line that no noise bends; where it meets the axis, the beam leaves it.
    """
    ring = ring_numbers(points)
    if ring is None:
        return None
    x, y, z = np.asarray(points, dtype=np.float64).T
    level = np.hypot(x, y)
    count = np.bincount(ring).astype(np.float64)
    mean_level, mean_z = (np.bincount(ring, v) / count for v in (level, z))
    level, z = level - mean_level[ring], z - mean_z[ring]
    spread = np.bincount(ring, level**2)
    told = (count >= RING_POINTS) & (spread > count * RING_REACH_M**2)
    if np.count_nonzero(told) < FEWEST_RINGS:
        return None
    slopes = np.bincount(ring, level * z) / np.maximum(spread, 1e-12)
    rest = np.bincount(ring, (z - slopes[ring] * level) ** 2)[told]
    slope = slopes[told]
    start = mean_z[told] - slope * mean_level[told]
    variance = rest / (count[told] - 2.0) * (1.0 / count[told] + mean_level[told] ** 2 / spread[told])
    weight = 1.0 / np.maximum(variance, 1e-12)
    information = float(weight @ slope**2)
    crossing = -float(weight @ (slope * start)) / max(information, 1e-300)
    misfit = float(weight @ (start + crossing * slope) ** 2) / (len(slope) - 1)
    return crossing, float(np.sqrt(max(misfit, 1.0) / max(information, 1e-300)))


def with_beams_crossing(points: NDArray[np.floating], crossing_m: float) -> NDArray[np.floating]:
    """Points (N, 3) made as if all beams started at the origin, put where beams that cross `crossing_m` before the axis
    met them; of the same type."""
    moved = np.array(points)
    x, y, z = points.T
    with np.errstate(divide="ignore", invalid="ignore"):
        moved[:, 2] -= (crossing_m * z / np.hypot(x, y)).astype(moved.dtype)
    return moved


def tangent_of_elevation(directions: FloatArray) -> FloatArray:
    """(N,) of directions (N, 3)."""
    return np.asarray(directions[:, 2] / np.hypot(directions[:, 0], directions[:, 1]))
