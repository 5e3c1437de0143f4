"""Corner sessions as recorded: a target with three faces, moved from place to place without turning it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol, TypeGuard, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray, as_float_array
from lidarpose.geometry.rings import crossing_of_points, with_beams_crossing
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec

Result = TypeVar("Result")

CloudFrame = Literal["lidar", "camera"]
"""The frame of a session's clouds: "camera" for clouds assembled from a spun 2D LiDAR."""


class CloudSource(Protocol):
    """A cloud somewhere, read only when it is needed."""

    @property
    def name(self) -> str:
        """What a person calls it: the path as the session's files write it."""
        ...

    def load(self) -> Cloud:
        """Read it. Raises InputError if it is missing or unreadable."""
        ...


def look_at_points(source: CloudSource, look: Callable[[NDArray[np.floating[Any]]], Result]) -> Result:
    """What `look` makes of a cloud's points (N, 3), of which it keeps nothing but copies.

    A source that has a method `look` may show it points in memory that is used again. Raises InputError if the cloud is
    missing or unreadable.
    """
    own: Callable[[Callable[[NDArray[np.floating[Any]]], Result]], Result] | None = getattr(source, "look", None)
    return look(source.load().points) if own is None else own(look)


class RecordingSource(Protocol):
    """A sweep recording somewhere in place of a cloud: it becomes one by its turntable's calibration."""

    @property
    def name(self) -> str: ...

    def recording(self) -> SweepRecording:
        """Open it. Raises InputError if it is missing or unreadable."""
        ...


def is_recording(source: CloudSource | RecordingSource) -> TypeGuard[RecordingSource]:
    """Whether a source is a recording, not yet a cloud."""
    return hasattr(source, "recording")


@dataclass(frozen=True, eq=False)
class CornerPlace:
    """One place of the target.

    Attributes
    ----------
    position
        Its name in the session.
    corner_world : (3,)
        The measured corner in the world frame, metres.
    clouds
        The frames recorded there.
    near : (3,) or None
        The corner's rough place in the clouds' frame, within `NEAR_RADIUS_M`, where the user gave it.
    """

    position: str
    corner_world: FloatArray
    clouds: tuple[CloudSource, ...]
    near: FloatArray | None = None

    def __post_init__(self) -> None:
        object.__setattr__(self, "corner_world", as_float_array(self.corner_world, (3,), "corner_world"))
        if self.near is not None:
            object.__setattr__(self, "near", as_float_array(self.near, (3,), "near"))


NEAR_RADIUS_M = 0.3
"""How far a `near` hint may be from the corner."""


@dataclass(frozen=True)
class CornerSession:
    """A corner session: places with known world coordinates, and the frames recorded at each.

    Attributes
    ----------
    world_sigma_m
        How well each world coordinate was measured; None where the user does not say.
    estimate_scale
        Whether the user asks for the factor of eq. (2) of the corner paper as well.
    turntable
        The calibration of the turntable by which recordings among the places' clouds become clouds.
    """

    name: str
    places: tuple[CornerPlace, ...]
    world_sigma_m: float | None = None
    estimate_scale: bool = False
    cloud_frame: CloudFrame = "lidar"
    lidar: LidarSpec = field(default_factory=LidarSpec)
    turntable: TurntableCalibration | None = None

    @property
    def has_recordings(self) -> bool:
        """Whether any place holds a sweep recording."""
        return any(is_recording(source) for place in self.places for source in place.clouds)


@dataclass(frozen=True, eq=False)
class MemoryCloud:
    """A cloud source that is already in memory."""

    name: str
    cloud: Cloud

    def load(self) -> Cloud:
        return self.cloud


@dataclass(frozen=True, eq=False)
class CrossingBeams:
    """Clouds of a multi-beam LiDAR with its beams put to where they start (see `lidarpose.geometry.rings`).

    Whether that was done already, is seen in the points themselves; it is not done twice.
    """

    source: CloudSource
    crossing_m: float

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> Cloud:
        cloud = self.source.load()
        seen = crossing_of_points(cloud.finite().points)
        if seen is not None and abs(seen[0]) > 0.1 * abs(self.crossing_m) + 5.0 * seen[1]:
            raise InputError(
                self.name,
                f"has beams that cross {1e3 * seen[0]:.1f} mm before the axis already",
                field="lidar.beam_crossing_m",
                expected="clouds whose beams all start at one point",
                remedy="Leave the key out: the driver has put the beams where they start.",
            )
        return replace(cloud, points=with_beams_crossing(cloud.points, self.crossing_m))
