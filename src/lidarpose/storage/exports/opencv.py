"""OpenCV: a FileStorage file, YAML or XML, whose rvec and tvec go into cv2.projectPoints as they are."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.se3 import log_so3
from lidarpose.model.calibration import Calibration, TurntableCalibration
from lidarpose.storage.exports.common import ExportOptions, camera_pose, degrees, number, numbers

Entries = list[tuple[str, ArrayLike | str | int | float]]


def text(calibration: Calibration, options: ExportOptions) -> str:
    """YAML in OpenCV's dialect."""
    comments, entries = _content(calibration, options)
    lines = ["%YAML:1.0", "---", *(f"# {comment}" for comment in comments)]
    for key, value in entries:
        if isinstance(value, str):
            lines.append(f'{key}: "{value}"')
        elif np.ndim(value) == 0:
            lines.append(f"{key}: {value if isinstance(value, int) else number(float(np.asarray(value)))}")
        else:
            matrix = np.atleast_2d(np.asarray(value, dtype=np.float64))
            lines += [
                f"{key}: !!opencv-matrix",
                f"   rows: {matrix.shape[0]}",
                f"   cols: {matrix.shape[1]}",
                "   dt: d",
            ]
            lines.append(f"   data: [ {numbers(matrix.ravel(), ', ')} ]")
    return "\n".join(lines) + "\n"


def xml_text(calibration: Calibration, options: ExportOptions) -> str:
    """The same as XML."""
    comments, entries = _content(calibration, options)
    lines = ['<?xml version="1.0"?>', "<opencv_storage>", *(f"<!-- {comment} -->" for comment in comments)]
    for key, value in entries:
        if isinstance(value, str):
            lines.append(f'<{key}>"{value}"</{key}>')
        elif np.ndim(value) == 0:
            shown = value if isinstance(value, int) else number(float(np.asarray(value)))
            lines.append(f"<{key}>{shown}</{key}>")
        else:
            matrix = np.atleast_2d(np.asarray(value, dtype=np.float64))
            lines.append(f'<{key} type_id="opencv-matrix">')
            lines.append(f"  <rows>{matrix.shape[0]}</rows><cols>{matrix.shape[1]}</cols><dt>d</dt>")
            lines.append(f"  <data>{numbers(matrix.ravel())}</data></{key}>")
    return "\n".join([*lines, "</opencv_storage>"]) + "\n"


def _content(calibration: Calibration, options: ExportOptions) -> tuple[list[str], Entries]:
    if isinstance(calibration, TurntableCalibration):
        angle, pose = camera_pose(calibration, options)
        comments = [
            f"R, tvec, rvec, T_camera_lidar hold while the turntable reads {degrees(angle)} degrees.",
            "Direction: p_camera = R p_lidar + tvec, metres; camera is the optical frame, as cv2.projectPoints wants.",
            "At any reading a, in radians: T_camera_lidar = T_camera_turntable Rz(a) T_turntable_lidar.",
        ]
        entries: Entries = [
            ("turntable_angle_rad", angle),
            ("T_camera_lidar", pose.matrix),
            ("T_camera_turntable", calibration.motion.T_camera_turntable.matrix),
            ("T_turntable_lidar", calibration.motion.T_turntable_lidar.matrix),
        ]
    else:
        pose, source = calibration.T_world_source, calibration.source
        comments = [f"Direction: p_world = scale R p_{source} + tvec, metres."]
        entries = [("scale", calibration.scale), (f"T_world_{source}", pose.matrix)]
    entries += [
        ("R", pose.rotation),
        ("rvec", log_so3(pose.rotation)[:, None]),
        ("tvec", np.asarray(pose.translation)[:, None]),
    ]
    if (camera := options.camera) is not None:
        comments.append("camera_matrix and distortion_coefficients in pixels, for images of the stated size.")
        entries += [
            ("image_width", camera.width),
            ("image_height", camera.height),
            ("camera_matrix", camera.K),
            ("distortion_model", camera.model),
            ("distortion_coefficients", camera.distortion if len(camera.distortion) else np.zeros(4)),
        ]
    return comments, entries
