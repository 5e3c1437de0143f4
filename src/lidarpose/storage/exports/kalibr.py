"""Kalibr: a camchain file. The LiDAR (or the world) stands where Kalibr has the IMU, the body's frame."""

from __future__ import annotations

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Calibration, TurntableCalibration
from lidarpose.model.camera import Camera
from lidarpose.storage.exports.common import ExportOptions, camera_pose, degrees, numbers, require_rigid

_MODELS = {"plumb_bob": "radtan", "equidistant": "equidistant"}


def text(calibration: Calibration, options: ExportOptions) -> str:
    """``cam0`` with T_cam_imu, and intrinsics where the camera is given."""
    lines = []
    if isinstance(calibration, TurntableCalibration):
        angle, pose = camera_pose(calibration, options)
        lines += [
            f"# T_cam_imu: the LiDAR's frame stands for the imu, while the turntable reads {degrees(angle)} degrees.",
            "# Direction: p_cam = T_cam_imu p_lidar; cam0 is the camera's optical frame. Metres.",
            "# At any reading a, in radians: T_cam_imu = T_cam_turntable Rz(a) T_turntable_lidar.",
            "cam0:",
            *_matrix("T_cam_imu", pose),
            *_matrix("T_cam_turntable", calibration.motion.T_camera_turntable),
            *_matrix("T_turntable_lidar", calibration.motion.T_turntable_lidar),
        ]
    else:
        require_rigid(calibration, "kalibr")
        if calibration.source != "camera":
            raise InputError(
                "--to kalibr",
                "a camchain describes cameras, and this calibration places a LiDAR in the world",
                expected="a turntable calibration, or a world calibration of a camera",
                remedy="Export to ros2, urdf, opencv or csv.",
            )
        lines += [
            "# T_cam_imu: the world's frame stands for Kalibr's imu.",
            "# Direction: p_cam = T_cam_imu p_world; cam0 is the camera's optical frame. Metres.",
            "cam0:",
            *_matrix("T_cam_imu", calibration.T_world_source.inverse()),
        ]
    if options.camera is not None:
        lines += _intrinsics(options.camera)
    return "\n".join(lines) + "\n"


def _matrix(key: str, pose: Pose) -> list[str]:
    return [f"  {key}:", *(f"  - [{numbers(row, ', ')}]" for row in pose.matrix)]


def _intrinsics(camera: Camera) -> list[str]:
    if camera.model not in _MODELS or (len(camera.distortion) == 5 and camera.distortion[4] != 0.0):
        raise InputError(
            "--camera",
            f"Kalibr has no distortion model for {camera.model} with {len(camera.distortion)} coefficients",
            expected="plumb_bob with k3 = 0, or equidistant",
        )
    coefficients = [*camera.distortion[:4]] or [0.0] * 4
    return [
        "  camera_model: pinhole",
        f"  intrinsics: [{numbers((camera.fx, camera.fy, camera.cx, camera.cy), ', ')}]",
        f"  distortion_model: {_MODELS[camera.model]}",
        f"  distortion_coeffs: [{numbers(coefficients, ', ')}]",
        f"  resolution: [{camera.width}, {camera.height}]",
    ]
