"""A whole world calibration: the answer, and what a reader needs to see to judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_session import CornerSession


@dataclass(frozen=True, eq=False)
class WorldPlace:
    """One place of the target as it was found.

    Attributes
    ----------
    corner_world : (3,)
        As measured, in the world frame, metres.
    corner : (3,)
        Of this place alone, in the clouds' frame, metres.
    faces
        By face (0, 1, 2, the same at every place): points (N, 3) in the clouds' frame.
    frame_corners : (F, 3)
        The corner of each frame alone, NaN where a frame shows none; (0, 3) where frames were not looked at singly.
    frame_used : (F,)
        False for frames that were left out.
    """

    position: str
    corner_world: FloatArray
    corner: FloatArray
    faces: Mapping[int, FloatArray]
    frame_corners: FloatArray
    frame_used: BoolArray

    def residual_world(self, calibration: WorldCalibration) -> FloatArray:
        """Where the answer puts this place's corner, minus where it was measured (3,), metres, in the world frame."""
        answer = calibration.T_world_source @ (calibration.scale * self.corner)
        return np.asarray(answer - self.corner_world)


@dataclass(frozen=True, eq=False)
class WorldRun:
    """What `lidarpose.workflows.world` hands to whoever draws it.

    Attributes
    ----------
    places
        Those at which the target was found.
    normals : (3, 3) or None
        The faces' common unit normals in the clouds' frame, one a row, where the method knows them.
    """

    method: str
    session: CornerSession
    calibration: WorldCalibration
    places: tuple[WorldPlace, ...]
    normals: FloatArray | None = None
