"""Scene files: what a simulated LiDAR looks at, written by a person (docs/simulator.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from pydantic import Field

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.storage.documents import check_format, read_toml
from lidarpose.storage.schemas import Schema, parse

SCENE_FORMAT = "lidarpose/scene@1"

Number = Annotated[float, Field(strict=False)]
Length = Annotated[float, Field(gt=0.0, le=1000.0, strict=False)]
Row3 = Annotated[list[Number], Field(min_length=3, max_length=3)]


class Placed(Schema):
    """Something that stands somewhere: its centre and its turn from the camera's axes."""

    centre_m: Row3
    rotation_vector_deg: Row3 = Field(default=[0.0, 0.0, 0.0])
    reflectivity: Annotated[float, Field(gt=0.0, le=10.0, strict=False)] = 0.8

    def pose(self) -> Pose:
        """T_camera_object."""
        return Pose(exp_so3(np.deg2rad(self.rotation_vector_deg)), np.asarray(self.centre_m))


class DiskEntry(Placed):
    """A flat disk in the x-y plane of its frame."""

    diameter_m: Length


class BoxEntry(Placed):
    """A box with its edges along the axes of its frame."""

    size_m: Annotated[list[Length], Field(min_length=3, max_length=3)]


class HoleEntry(Schema):
    """A round hole in a plane, its centre in the plane's frame."""

    centre_m: Annotated[list[Number], Field(min_length=2, max_length=2)]
    diameter_m: Length


class PlaneEntry(Placed):
    """A flat sheet in the x-y plane of its frame; without a size it has no end."""

    size_m: Annotated[list[Length], Field(min_length=2, max_length=2)] | None = None
    holes: list[HoleEntry] = Field(default=[])


class SceneFile(Schema):
    """A scene in the camera's frame."""

    format: Literal["lidarpose/scene@1"]
    disks: list[DiskEntry] = Field(default=[])
    boxes: list[BoxEntry] = Field(default=[])
    planes: list[PlaneEntry] = Field(default=[])


def read_scene(path: Path) -> SceneFile:
    """Read a scene file. Raises InputError naming the key at fault, or if the scene is empty."""
    scene = parse(path, SceneFile, check_format(path, read_toml(path), SCENE_FORMAT))
    if not (scene.disks or scene.boxes or scene.planes):
        raise InputError(path, "holds nothing", expected="at least one of [[disks]], [[boxes]], [[planes]]")
    return scene
