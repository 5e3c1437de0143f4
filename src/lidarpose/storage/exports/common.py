"""What the exports share: frames' names, options, and numbers that lose nothing."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field, fields

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.camera import Camera

_FRAME_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_/.-]*")


@dataclass(frozen=True)
class FrameNames:
    """What frames are called in the other program.

    The camera's frame is the optical one (x right, y down, z forward), which REP-103 marks by the suffix
    ``_optical_frame``; a body frame ``camera_link`` (x forward) is another one, and is not written.
    """

    camera: str = "camera_optical_frame"
    turntable: str = "turntable"
    lidar: str = "lidar"
    world: str = "world"

    def __post_init__(self) -> None:
        names = [getattr(self, item.name) for item in fields(self)]
        for name in names:
            if not _FRAME_NAME.fullmatch(name):
                raise InputError("frame", f"is {name!r}", expected="letters, digits, _ / . -")
        if len(set(names)) != len(names):
            raise InputError("frame", "has the same name as another frame", expected="four different names")


@dataclass(frozen=True)
class ExportOptions:
    """What a person may choose.

    Attributes
    ----------
    angle_rad
        The turntable's reading for formats that hold one pose. None: 0 for these, and the moving joint for ROS 2.
    angles_rad
        The readings of a table of poses.
    camera
        Intrinsics to write beside the pose, for formats that hold them.
    """

    angle_rad: float | None = None
    angles_rad: tuple[float, ...] = tuple(np.deg2rad(np.arange(0.0, 360.0, 1.0)).tolist())
    camera: Camera | None = None
    names: FrameNames = field(default_factory=FrameNames)


def source_name(calibration: WorldCalibration, names: FrameNames) -> str:
    """The name of the frame that a world calibration places in the world."""
    return names.lidar if calibration.source == "lidar" else names.camera


def require_rigid(calibration: WorldCalibration, to: str) -> None:
    """InputError if a scale would be lost."""
    if calibration.scale != 1.0:
        raise InputError(
            f"--to {to}",
            f"cannot hold the scale {calibration.scale:.9g} of this calibration",
            expected="a rigid transform",
            remedy="Calibrate with metric clouds and no estimate of scale, or export to csv, opencv or matrix.",
        )


def camera_pose(calibration: TurntableCalibration, options: ExportOptions) -> tuple[float, Pose]:
    """The reading, and T_camera_lidar there, for formats that hold one pose."""
    angle = options.angle_rad or 0.0
    return angle, calibration.pose(angle)


def degrees(angle_rad: float) -> str:
    """An angle for a comment."""
    return f"{np.rad2deg(angle_rad):.9g}"


def number(value: float) -> str:
    """The shortest decimal that reads back as the same double; -0 as 0."""
    return repr(float(value) + 0.0)


def numbers(values: Iterable[float], separator: str = " ") -> str:
    return separator.join(number(value) for value in values)


def roll_pitch_yaw(R: FloatArray) -> tuple[float, float, float]:
    """URDF's angles: R = Rz(yaw) Ry(pitch) Rx(roll); accurate to rounding also where the pitch is +-90 degrees.

    There roll and yaw alone are undetermined; taking the roll from Rz(-yaw) R makes both fit together.
    """
    yaw = np.arctan2(R[1, 0], R[0, 0])
    c, s = np.cos(yaw), np.sin(yaw)
    pitch = np.arctan2(-R[2, 0], c * R[0, 0] + s * R[1, 0])
    roll = np.arctan2(s * R[0, 2] - c * R[1, 2], c * R[1, 1] - s * R[0, 1])
    return float(roll), float(pitch), float(yaw)
