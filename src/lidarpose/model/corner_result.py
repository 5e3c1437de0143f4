"""What is found of a target with three faces, and the estimate's inputs and results on the way to a calibration."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.planes import Plane


@dataclass(frozen=True, eq=False)
class CornerCandidate:
    """Three flat patches of a cloud that meet in a corner.

    Attributes
    ----------
    corner : (3,)
        Metres, in the cloud's frame.
    normals : (3, 3)
        Unit normals of the faces, one a row, pointing to the sensor's side.
    convex
        Whether the corner points at the sensor (a carton's) or away from it (a room's).
    outlines
        By face: the convex outline (K, 3) of its points, in order, within `reach` of the corner.
    obstacles
        Other planes that border the faces, with the outline of each: the ground that the target stands on.
    support
        Points on the face that has fewest, near the corner.
    sigma_m
        Spread of the points across the faces.
    """

    corner: FloatArray
    normals: FloatArray
    convex: bool
    outlines: tuple[FloatArray, FloatArray, FloatArray]
    obstacles: tuple[Plane, ...]
    support: int
    sigma_m: float


@dataclass(frozen=True, eq=False)
class FaceReturns:
    """Returns from one face at one place, over all frames.

    Attributes
    ----------
    directions : (N, 3)
        Unit beam directions in the cloud's frame.
    range_m : (N,)
    frame : (N,)
        Which frame each return is of, ascending.
    """

    directions: FloatArray
    range_m: FloatArray
    frame: IntArray

    def __len__(self) -> int:
        return len(self.range_m)

    @cached_property
    def rays(self) -> FloatArray:
        """The directions as contiguous rows (3, N), over which arithmetic runs fastest."""
        return np.ascontiguousarray(self.directions.T)

    def subset(self, index: IntArray) -> FaceReturns:
        """Those of the returns that `index` (M,), ascending, tells."""
        return FaceReturns(self.rays.take(index, axis=1).T, self.range_m.take(index), self.frame.take(index))


@dataclass(frozen=True, eq=False)
class CornerPlaceFaces:
    """The faces seen at one place: key 0, 1 or 2, the same face at every place. A face that was not seen is missing."""

    position: str
    corner_world: FloatArray
    faces: Mapping[int, FaceReturns]
    frames: int
