"""URDF: the camera, a joint about the turntable's axis with its zero, the LiDAR."""

from __future__ import annotations

from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Calibration, TurntableCalibration, WorldCalibration
from lidarpose.storage.exports.common import (
    ExportOptions,
    FrameNames,
    numbers,
    require_rigid,
    roll_pitch_yaw,
    source_name,
)

JOINT = "turntable_joint"
"""The name under which JointState messages carry the turntable's reading."""


def text(calibration: Calibration, options: ExportOptions) -> str:
    """A robot description that robot_state_publisher and any URDF library reads."""
    if isinstance(calibration, TurntableCalibration):
        return _turntable(calibration, options.names)
    return _world(calibration, options.names)


def _turntable(calibration: TurntableCalibration, names: FrameNames) -> str:
    motion = calibration.motion
    comment = f"""
  Where the LiDAR is, seen from the camera, as the turntable turns. Metres and radians.
  Direction: each joint's origin maps points of the child to the parent, so that
    p_{names.camera} = T({JOINT}) p_{names.lidar}.
  {names.camera} is the optical frame: x right, y down, z forward.
  {JOINT} is the turntable's reading itself: position 0 where it reads 0; a growing reading turns right-handed about z.
"""
    parts = [
        _link(names.camera),
        _link(names.turntable),
        _link(names.lidar),
        _joint(JOINT, "continuous", names.camera, names.turntable, motion.T_camera_turntable, axis="0 0 1"),
        _joint("lidar_mount", "fixed", names.turntable, names.lidar, motion.T_turntable_lidar),
    ]
    return _robot(comment, parts)


def _world(calibration: WorldCalibration, names: FrameNames) -> str:
    require_rigid(calibration, "urdf")
    child = source_name(calibration, names)
    comment = f"""
  Where the sensor is in the world. Metres and radians.
  Direction: p_{names.world} = T p_{child}.
"""
    joint = _joint(f"{child.replace('/', '_')}_mount", "fixed", names.world, child, calibration.T_world_source)
    return _robot(comment, [_link(names.world), _link(child), joint])


def _robot(comment: str, parts: list[str]) -> str:
    # XML allows no double hyphen inside a comment; names may have one.
    safe = comment.replace("--", "- -")
    return '<?xml version="1.0"?>\n<!--' + safe + '-->\n<robot name="lidarpose">\n' + "".join(parts) + "</robot>\n"


def _link(name: str) -> str:
    return f'  <link name="{name}"/>\n'


def _joint(name: str, kind: str, parent: str, child: str, pose: Pose, axis: str | None = None) -> str:
    lines = [
        f'  <joint name="{name}" type="{kind}">',
        f'    <parent link="{parent}"/>',
        f'    <child link="{child}"/>',
        f'    <origin xyz="{numbers(pose.translation)}" rpy="{numbers(roll_pitch_yaw(pose.rotation))}"/>',
        *([f'    <axis xyz="{axis}"/>'] if axis else []),
        "  </joint>",
    ]
    return "\n".join(lines) + "\n"
