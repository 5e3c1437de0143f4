"""The rig in 3D: camera, panels, axis, the LiDAR's circle and fans, and what it saw."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.camera import Camera
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.numbers import short
from lidarpose.report.scene import Scene
from lidarpose.report.turn_numbers import arc_deg, uncertain_pose_of

_MOST_POINTS = 1600
_SIGMA_STEP_DEG = 5.0
PANEL_COLOURS = ("--p1", "--p2")


def turntable_scene(run: TurntableRun) -> dict[str, Any]:
    """What the 3D viewer shows of a turntable run, in the camera's frame."""
    scene = Scene(up=(0.0, -1.0, 0.0))
    motion = run.calibration.motion
    size = _board_size(run)
    _add_camera(scene, run.observations.camera, 0.35 * size)
    _add_panels(scene, run)
    _add_points(scene, run)
    _add_motion(scene, run, size)
    _add_lidar(scene, run, 0.35 * size)
    turning = {
        "table": motion.T_camera_turntable.matrix[:3].tolist(),
        "scale": motion.reading_scale,
        "origin": float(np.rad2deg(motion.reading_origin_rad)),
        "step": _SIGMA_STEP_DEG,
        "sigma": _sigmas(run),
    }
    return scene.data(front=(0.0, 0.0, 1.0), motion=turning)


def _board_size(run: TurntableRun) -> float:
    panel = run.observations.panels[0]
    return float(np.hypot(panel.columns, panel.rows)) * panel.square_m


def _add_camera(scene: Scene, camera: Camera, depth: float) -> None:
    edge = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]) * [camera.width, camera.height]
    corners = camera.undistort(edge)
    if not np.all(np.isfinite(corners)):
        corners = (edge - [camera.cx, camera.cy]) / [camera.fx, camera.fy]
    rim = depth * np.concatenate([corners, np.ones((4, 1))], axis=1)
    scene.add("polygon", rim, "--ink", alpha=0.06, width=1)
    for corner in rim:
        scene.add("line", [np.zeros(3), corner], "--ink", width=1)
    scene.axes(Pose.identity(), 0.5 * depth)
    scene.label(np.zeros(3), "camera")


def _add_panels(scene: Scene, run: TurntableRun) -> None:
    if run.estimate is None:
        return
    first = next(iter(run.estimate.panel_poses), "")
    for placement, poses in run.estimate.panel_poses.items():
        for k, (panel, pose) in enumerate(zip(run.observations.panels, poses, strict=False)):
            if pose is None:
                continue
            outline = pose @ _outline(panel)
            scene.add("polygon", outline, PANEL_COLOURS[k % 2], alpha=0.14, width=1.5)
            grid = pose @ panel.corners_panel()
            scene.add("points", grid, PANEL_COLOURS[k % 2], size=1, alpha=0.55)
            if placement == first:
                scene.label(outline.mean(axis=0), f"panel {k + 1}", PANEL_COLOURS[k % 2])


def _outline(panel: Panel) -> FloatArray:
    """The squares' outer edge (4, 3): one square beyond the inner corners."""
    s = panel.square_m
    x, y = panel.columns * s, panel.rows * s
    return np.array([[-s, -s, 0.0], [x, -s, 0.0], [x, y, 0.0], [-s, y, 0.0]])


def _add_points(scene: Scene, run: TurntableRun) -> None:
    """Scan points on the panels, where the motion puts them."""
    by_panel: dict[int, list[FloatArray]] = {}
    for place in run.observations.places:
        pose = run.calibration.pose(place.turntable_angle_rad)
        for panel, line in place.scan_lines.items():
            p = line.points_lidar()
            by_panel.setdefault(panel, []).append(pose @ np.column_stack([p, np.zeros(len(p))]))
    total = sum(len(p) for parts in by_panel.values() for p in parts)
    step = max(1, total // _MOST_POINTS)
    for _, parts in sorted(by_panel.items()):
        scene.add("points", np.concatenate(parts)[::step], "--lidar", size=1.1)


def _add_motion(scene: Scene, run: TurntableRun, size: float) -> None:
    motion = run.calibration.motion
    T = motion.T_camera_turntable
    reach = max(0.5 * size, 0.6 * motion.radius_m)
    axis = T @ np.array([[0.0, 0.0, -reach], [0.0, 0.0, reach]])
    scene.add("line", axis, "--axis", width=2)
    scene.label(axis[1], "turntable's axis", "--axis")
    low, high = (float(motion.true_angle(np.deg2rad(reading))) for reading in arc_deg(run))
    scene.add("line", _circle(motion, -np.pi, np.pi), "--lidar", width=1.2, dash=[4, 5], alpha=0.8)
    scene.add("line", _circle(motion, low, high), "--lidar", width=4)


def _circle(motion: TurntableMotion, low_rad: float, high_rad: float) -> FloatArray:
    """Where the LiDAR's centre is while the table goes from one angle to another."""
    angles = np.linspace(low_rad, high_rad, 73)
    arm = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(73)]) * motion.radius_m
    return motion.T_camera_turntable @ arm


def _add_lidar(scene: Scene, run: TurntableRun, length: float) -> None:
    """The LiDAR and the fan of beams that hit the board, turned by the slider."""
    mounting = run.calibration.motion.T_turntable_lidar
    scene.axes(mounting, length, moves=True)
    scene.label(mounting.translation, "LiDAR", "--lidar", moves=True)
    lines = [line for place in run.observations.places for line in place.scan_lines.values()]
    if not lines:
        return
    beams = np.concatenate([line.angle_rad for line in lines])
    # Beam angles may straddle half a turn: measure them from their own mean direction.
    middle = float(np.angle(np.exp(1j * beams).mean()))
    off = np.angle(np.exp(1j * (beams - middle)))
    fan = middle + np.linspace(float(off.min()), float(off.max()), 13)
    far = float(np.median(np.concatenate([line.range_m for line in lines])))
    rim = far * np.column_stack([np.cos(fan), np.sin(fan), np.zeros(len(fan))])
    scene.add("polygon", mounting @ np.vstack([np.zeros((1, 3)), rim]), "--lidar", alpha=0.1, width=1, moves=True)


def _sigmas(run: TurntableRun) -> list[list[str]] | None:
    """Standard deviations of centre (mm) and orientation (degrees) for the slider's readings, -180 to 180."""
    uncertain = uncertain_pose_of(run)
    if uncertain is None:
        return None
    rows = []
    for degrees in np.arange(-180.0, 180.1, _SIGMA_STEP_DEG):
        pose = uncertain(float(np.deg2rad(degrees)))
        centre = 1e3 * np.sqrt(max(np.trace(pose.centre_covariance()), 0.0))
        turn = np.rad2deg(np.sqrt(max(np.trace(pose.rotation_covariance()), 0.0)))
        rows.append([short(float(centre)), short(float(turn))])
    return rows
