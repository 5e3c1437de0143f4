"""Sessions as recorded: what there is, before anything is detected. Images and scans are read when asked for."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Protocol

from lidarpose.model.camera import Camera
from lidarpose.model.image import ImageSource
from lidarpose.model.scan import LidarSpec, Scan
from lidarpose.model.sense import StatedSense
from lidarpose.model.targets import Panel

DEFAULT_PLACEMENT = ""
"""The name of the board's placement in sessions where it never moved."""


class ScanSource(Protocol):
    """A scan somewhere, read only when it is needed."""

    @property
    def name(self) -> str:
        """What a person calls it: the path as the session's files write it."""
        ...

    def load(self) -> Scan:
        """Read it. Raises InputError if it is missing or unreadable."""
        ...


@dataclass(frozen=True)
class TurntablePlace:
    """One stop of the turntable: its reading, one stripe image (or none) and one scan.

    `placement` names the board's placement that was in view; see `TurntableSession.board_images`.
    """

    position: str
    turntable_angle_rad: float
    stripe_image: ImageSource | None
    scan: ScanSource
    placement: str = DEFAULT_PLACEMENT


@dataclass(frozen=True)
class TurntableSession:
    """A turntable session: one camera, a V board in one or several placements, and three or more places.

    Attributes
    ----------
    name
        What a person calls it: the folder.
    board_images
        By placement: images of the board in bright light.
    panels
        The chessboards of the board: two for a V board, in the order of the file (panel 0, panel 1).
    stated
        How beams and table turn, as whoever recorded it saw it on the rig.
    """

    name: str
    camera: Camera
    panels: tuple[Panel, ...]
    board_images: Mapping[str, tuple[ImageSource, ...]]
    places: tuple[TurntablePlace, ...]
    lidar: LidarSpec = field(default_factory=LidarSpec)
    stated: StatedSense = field(default_factory=StatedSense)
