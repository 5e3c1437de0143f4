"""Surfaces that beams meet: sheets with round holes, disks and boxes, each with a reflectivity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose


class Surface(Protocol):
    """Something that reflects light."""

    @property
    def reflectivity(self) -> float:
        """Relative to a white wall."""
        ...

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Where rays (n, 3) meet the surface first: (n,) metres along the unit directions, inf where they miss it."""
        ...


@dataclass(frozen=True, eq=False)
class Sheet:
    """A flat sheet of no thickness in the x-y plane of its frame, centred there.

    Attributes
    ----------
    T_scene_sheet
        Its pose.
    half_size
        Half its extents along x and y, metres; inf for an unbounded plane.
    round_holes
        Centre x, y and radius of each hole, in the sheet's frame.
    """

    T_scene_sheet: Pose
    half_size: tuple[float, float] = (np.inf, np.inf)
    round_holes: tuple[tuple[float, float, float], ...] = ()
    reflectivity: float = 1.0

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        distance, x, y = _meet_plane(self.T_scene_sheet, origins, directions)
        inside = (np.abs(x) <= self.half_size[0]) & (np.abs(y) <= self.half_size[1])
        for cx, cy, radius in self.round_holes:
            inside &= (x - cx) ** 2 + (y - cy) ** 2 > radius**2
        return np.where(inside, distance, np.inf)


@dataclass(frozen=True, eq=False)
class Disk:
    """A flat round disk of no thickness in the x-y plane of its frame, centred there."""

    T_scene_disk: Pose
    radius: float
    reflectivity: float = 1.0

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        distance, x, y = _meet_plane(self.T_scene_disk, origins, directions)
        return np.where(x * x + y * y <= self.radius**2, distance, np.inf)


@dataclass(frozen=True, eq=False)
class Box:
    """A closed box, centred in its frame, with edges of `size` (3,) along the axes, metres."""

    T_scene_box: Pose
    size: tuple[float, float, float]
    reflectivity: float = 1.0

    def ranges(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        inverse = self.T_scene_box.inverse()
        o, d = inverse @ origins, inverse.rotate(directions)
        half = 0.5 * np.asarray(self.size)
        with np.errstate(divide="ignore", invalid="ignore"):
            one, two = (-half - o) / d, (half - o) / d
        near = np.fmax.reduce(np.minimum(one, two), axis=-1)
        far = np.fmin.reduce(np.maximum(one, two), axis=-1)
        return np.where((near <= far) & (near > 0.0), near, np.inf)


def _meet_plane(T_scene_plane: Pose, origins: FloatArray, directions: FloatArray) -> tuple[FloatArray, ...]:
    """Ranges (n,) to the x-y plane of a frame, inf behind the ray's start, and where in the plane (n,), (n,)."""
    inverse = T_scene_plane.inverse()
    o, d = inverse @ origins, inverse.rotate(directions)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = -o[..., 2] / d[..., 2]
        distance = np.where(distance > 0.0, distance, np.inf)
        x, y = o[..., 0] + distance * d[..., 0], o[..., 1] + distance * d[..., 1]
    return distance, x, y
