"""The part of a report that says what was found, in numbers, and how other programs take it."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, log_so3
from lidarpose.model.calibration import Calibration, TurntableCalibration, WorldCalibration
from lidarpose.report.markup import Markup, el
from lidarpose.report.page import card, folded, section, table


def answer_section(calibration: Calibration, angle_deg: float = 0.0, *, has_camera: bool = True) -> Markup:
    """The pose, at a reading of the turntable where there is one, and what to give to which program.

    Without a camera the frame that files call `camera` is the table's at reading 0.
    """
    rejected = calibration.quality is not None and calibration.quality.verdict == "rejected"
    lead = (
        "To look into only: this calibration is rejected, and no program should be given it."
        if rejected
        else "Six decimals: a micrometre, and a micrometre at a metre's distance. calibration.json has all digits."
    )
    if isinstance(calibration, TurntableCalibration):
        cards = _turntable_cards(calibration, angle_deg, has_camera)
    else:
        cards = _world_cards(calibration)
    return section("The pose, and how to use it", lead, *cards)


def _turntable_cards(calibration: TurntableCalibration, angle_deg: float, has_camera: bool) -> tuple[Markup, Markup]:
    motion, pose = calibration.motion, calibration.pose(float(np.deg2rad(angle_deg)))
    angle = f"{angle_deg:.2f}"
    frame = (
        "the camera's (x right, y down, z forward)"
        if has_camera
        else "the table's at reading 0 (z along its axis), which files call camera"
    )
    words = (
        "p_camera = T_camera_lidar p_lidar: it takes points from the LiDAR's frame (x along the beam at 0, y along the "
        f"beam at +90 degrees) to {frame}, in metres. Its columns are the LiDAR's x, y and z axes and its centre, seen "
        "from there."
    )
    at = "a, the turntable's reading in radians"
    if motion.reading_scale != 1.0:
        origin, scale = motion.reading_origin_rad, motion.reading_scale
        at = f"a = {origin:.9f} + {scale:.9f} (reading - {origin:.9f}), in radians, as readings are off by a factor"
    always = folded(
        "At any other reading",
        el("p", f"T_camera_lidar = T_camera_turntable Rz(a) T_turntable_lidar, with {at}."),
        el("p", el("code", "T_camera_turntable")),
        _matrix(motion.T_camera_turntable.matrix),
        el("p", el("code", "T_turntable_lidar")),
        _matrix(motion.T_turntable_lidar.matrix),
        el("p", "Or: ", el("code", "lidarpose pose calibration.json --angle-deg DEGREES")),
    )
    opencv = (
        "OpenCV",
        "cv2.projectPoints(points_lidar, rvec, tvec, camera_matrix, distortion).",
        "--to opencv -o rig.yaml",
    )
    rows = [
        (
            "ROS 2",
            "Parent camera_optical_frame, child lidar, translation and quaternion as they stand (w last, in ROS too). "
            "With the joint that moves it:",
            "--to ros2 -o rig.launch.py",
        ),
        *([opencv] if has_camera else []),
        *_cloud_rows(f"--to matrix --angle-deg {angle} -o T.txt", "camera's" if has_camera else "table's"),
    ]
    title = f"T_camera_lidar while the turntable reads {angle}°"
    return card(title, el("p", words), *_numbers(pose, pose.matrix), always), _programs(rows)


def _world_cards(calibration: WorldCalibration) -> tuple[Markup, Markup]:
    source, pose, scale = calibration.source, calibration.T_world_source, calibration.scale
    matrix = pose.matrix.copy()
    matrix[:3, :3] *= scale
    whose = "LiDAR's" if source == "lidar" else "camera's"
    words = (
        f"p_world = T_world_{source} p_{source}: it takes points from the {whose} frame to the world's, in metres. Its "
        f"columns are the {whose} x, y and z axes and its centre, seen in the world."
    )
    if scale != 1.0:
        words += f" The first three columns hold the scale {scale:.9f} too; the quaternion is the rotation alone."
    frame = "lidar" if source == "lidar" else "camera_optical_frame"
    ros = (
        "ROS 2",
        f"Parent world, child {frame}, translation and quaternion as they stand (ROS, too, has w last):",
        "--to ros2 -o world.launch.py",
    )
    rows = [*([ros] if scale == 1.0 else []), *_cloud_rows("--to matrix -o T.txt", "world's")]
    return card(f"T_world_{source}", el("p", words), *_numbers(pose, matrix)), _programs(rows)


def _cloud_rows(export: str, whose: str) -> list[tuple[str, str, str]]:
    """Programs that put a cloud into another frame by a matrix."""
    return [
        ("Open3D, NumPy", f"cloud.transform(T) brings a cloud of the LiDAR into the {whose} frame.", export),
        (
            "CloudCompare",
            "Edit, Apply transformation: paste the matrix, or open the file (or -APPLY_TRANS on its command line).",
            export,
        ),
        ("Eigen", "Quaterniond(w, x, y, z): its constructor takes w first.", ""),
    ]


def _programs(rows: list[tuple[str, str, str]]) -> Markup:
    cells = [
        (program, el("span", words, *([el("br"), el("code", f"lidarpose export calibration.json {to}")] if to else [])))
        for program, words, to in rows
    ]
    return card("In other programs", table(("program", "what it takes"), cells))


def _numbers(pose: Pose, matrix: FloatArray) -> tuple[Markup, Markup]:
    rows = [
        ("translation (tvec), m", _row(pose.translation)),
        ("quaternion x y z w", _row(pose.quaternion_xyzw)),
        ("rotation vector (rvec), rad", _row(log_so3(pose.rotation))),
    ]
    return _matrix(matrix), table(("", ""), [(words, el("code", text)) for words, text in rows])


def _matrix(matrix: FloatArray) -> Markup:
    """Four lines to copy: plain minus signs, and no unit between the numbers."""
    cells = [[f"{value:.6f}" for value in row] for row in matrix[:3]] + [["0", "0", "0", "1"]]
    widths = [max(len(row[k]) for row in cells) for k in range(4)]
    lines = (" ".join(cell.rjust(width) for cell, width in zip(row, widths, strict=True)) for row in cells)
    return el("div", el("pre", "\n".join(lines)), class_="scroll")


def _row(values: FloatArray) -> str:
    return " ".join(f"{value + 0.0:.6f}" for value in np.asarray(values))
