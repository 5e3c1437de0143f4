"""Flat pieces of a cloud."""

from __future__ import annotations

from dataclasses import dataclass

from lidarpose.geometry.arrays import IntArray
from lidarpose.geometry.planes import Plane


@dataclass(frozen=True, eq=False)
class PlanePatch:
    """A connected flat piece of a cloud.

    Attributes
    ----------
    plane
        Its plane in the cloud's frame; the normal points to the side of the frame's origin, where the sensor is.
    indices : (M,)
        Which points of the cloud lie on it, ascending.
    sigma_m
        Robust spread of those points across the plane.
    """

    plane: Plane
    indices: IntArray
    sigma_m: float

    def __len__(self) -> int:
        return len(self.indices)
