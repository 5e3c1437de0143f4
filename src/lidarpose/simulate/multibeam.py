"""Ranging instruments for simulation: beams by their tables, cast against convex solids, with the usual defects.

Nothing here is shared with the estimators: ranges come from half-space arithmetic, noise from the generator.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose


@dataclass(frozen=True, eq=False)
class ConvexSolid:
    """The points x with ``normals @ x <= offsets``: outward unit normals (K, 3), offsets (K,), metres."""

    normals: FloatArray
    offsets: FloatArray

    def cast(self, origin: FloatArray, directions: FloatArray) -> FloatArray:
        """Ranges (N,) at which rays from `origin` (3,) along unit `directions` (N, 3) enter; inf where they miss."""
        height = self.offsets - self.normals @ origin
        enter = np.zeros(len(directions))
        leave = np.full(len(directions), np.inf)
        for normal, h in zip(self.normals, height, strict=True):
            slope = directions @ normal
            with np.errstate(divide="ignore", invalid="ignore"):
                t = h / slope
            np.maximum(enter, np.where(slope < 0.0, t, -np.inf), out=enter)
            np.minimum(leave, np.where(slope > 0.0, t, np.inf), out=leave)
            if h < 0.0:
                leave[slope >= 0.0] = -np.inf
        return np.where((enter < leave) & (enter > 1e-6), enter, np.inf)


@dataclass(frozen=True, eq=False)
class BeamTable:
    """A ranging instrument.

    Attributes
    ----------
    directions : (N, 3)
        Unit beam directions of one frame in the LiDAR frame, in firing order.
    divergence_rad
        Full width of a beam, for mixed pixels.
    crossing_m
        How far before the axis, which is the frame's z, the beams cross: each starts this times the tangent of its
        elevation below the origin. Recorded points leave that out, as those of some drivers do.
    """

    name: str
    directions: FloatArray
    divergence_rad: float
    max_range_m: float
    crossing_m: float = 0.0


def _ring_directions(elevation_deg: FloatArray, azimuth_deg: FloatArray) -> FloatArray:
    azimuth, elevation = np.meshgrid(np.radians(azimuth_deg), np.radians(elevation_deg), indexing="ij")
    x = np.cos(elevation) * np.cos(azimuth)
    y = np.cos(elevation) * np.sin(azimuth)
    return np.stack([x, y, np.sin(elevation)], axis=-1).reshape(-1, 3)


def hdl32() -> BeamTable:
    """Velodyne HDL-32E: 32 beams from -30.67 to +10.67 degrees, a firing every 46.08 us at 10 turns a second."""
    elevation = -30.67 + 4.0 / 3.0 * np.arange(32)
    return BeamTable("hdl32", _ring_directions(elevation, np.arange(0.0, 360.0, 0.165888)), 3e-3, 70.0)


def vlp16() -> BeamTable:
    """Velodyne VLP-16: 16 beams from -15 to +15 degrees, a firing every 55.296 us at 10 turns a second."""
    elevation = -15.0 + 2.0 * np.arange(16)
    return BeamTable("vlp16", _ring_directions(elevation, np.arange(0.0, 360.0, 0.1990656)), 3e-3, 100.0)


def turned_2d(step_deg: float = 0.5) -> BeamTable:
    """A 2D LiDAR on edge (190 degrees) on a turntable that turns 140 degrees, like the paper's LMS511.

    The clouds' frame is taken at the turntable: x forward, z up along the axis.
    """
    fan = np.radians(np.arange(-95.0, 95.0, step_deg))
    turn = np.radians(np.arange(-70.0, 70.0, step_deg))
    angle, azimuth = np.meshgrid(fan, turn, indexing="xy")
    directions = np.stack(
        [np.cos(angle) * np.cos(azimuth), np.cos(angle) * np.sin(azimuth), np.sin(angle)], axis=-1
    ).reshape(-1, 3)
    return BeamTable("turntable", directions, 5e-3, 26.0)


INSTRUMENTS = {"hdl32": hdl32, "vlp16": vlp16, "turntable": turned_2d}


@dataclass(frozen=True)
class Defects:
    """What a real instrument adds: Gaussian range noise, beams without return, and mixed pixels at depth steps."""

    range_sigma_m: float = 0.008
    dropout: float = 0.02
    mixed_pixels: bool = True


@dataclass(frozen=True, eq=False)
class CastScene:
    """Exact ranges (N,) of one frame (inf without return), those of a second ray within each beam, and what was hit."""

    table: BeamTable
    range_m: FloatArray
    neighbour_range_m: FloatArray
    solid: FloatArray

    def frame(self, defects: Defects, rng: np.random.Generator) -> FloatArray:
        """One recorded frame: points (M, 3) in the LiDAR frame."""
        ranges = self.range_m.copy()
        if defects.mixed_pixels:
            both = np.isfinite(ranges) & np.isfinite(self.neighbour_range_m)
            step = np.zeros_like(ranges)
            step[both] = self.neighbour_range_m[both] - ranges[both]
            # Only part of the footprint crosses the edge: the echo is drawn towards the other surface by that share.
            ranges = ranges + np.where(np.abs(step) > 0.02, step * rng.uniform(0.0, 1.0, len(ranges)), 0.0)
        keep = np.isfinite(ranges) & (ranges < self.table.max_range_m) & (rng.random(len(ranges)) >= defects.dropout)
        noisy = ranges[keep] + rng.normal(0.0, defects.range_sigma_m, int(keep.sum()))
        return np.asarray(noisy[:, None] * self.table.directions[keep])


def cast_scene(
    table: BeamTable, solids: Sequence[ConvexSolid], T_world_lidar: Pose, rng: np.random.Generator
) -> CastScene:
    """Cast every beam, and a second ray within its footprint, against all solids."""
    spread = rng.normal(0.0, table.divergence_rad / 4.0, table.directions.shape)
    beside = table.directions + spread
    beside /= np.linalg.norm(beside, axis=1, keepdims=True)
    first, solid = _nearest(solids, T_world_lidar, table, table.directions)
    second, _ = _nearest(solids, T_world_lidar, table, beside)
    return CastScene(table, first, second, solid)


def _nearest(
    solids: Sequence[ConvexSolid], T_world_lidar: Pose, table: BeamTable, directions: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Ranges (N,) along directions (N, 3), from where the table's beams start, and which solid is met (-1: none)."""
    world = T_world_lidar.rotate(directions)
    best = np.full(len(world), np.inf)
    which = np.full(len(world), -1.0)
    level = np.maximum(np.hypot(table.directions[:, 0], table.directions[:, 1]), 1e-9)
    heights, start = np.unique(np.round(-table.crossing_m * table.directions[:, 2] / level, 9), return_inverse=True)
    for k, height in enumerate(heights):
        mine = slice(None) if len(heights) == 1 else np.flatnonzero(start == k)
        origin = T_world_lidar @ np.array([0.0, 0.0, height])
        for index, solid in enumerate(solids):
            ranges = solid.cast(origin, world[mine])
            nearer = ranges < best[mine]
            best[mine] = np.where(nearer, ranges, best[mine])
            which[mine] = np.where(nearer, index, which[mine])
    return best, which
