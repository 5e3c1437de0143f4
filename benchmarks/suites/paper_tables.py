"""Both papers' tables again, in simulation: their printed figures, their methods and ours."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from benchmarks.accuracy_world import CASES, errors
from benchmarks.accuracy_world import PAPER as PRINTED
from benchmarks.report import Effort, Report, Table
from benchmarks.seed_setup import Row, measure
from benchmarks.studies import in_processes, rms
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
from lidarpose.simulate.disk_scene import DiskScene, disk_surfaces
from lidarpose.simulate.rig import draw_rig
from lidarpose.simulate.sweep_scene import BeamModel, SweepPlan, simulate_sweeps
from lidarpose.workflows.measuring import measure_disk, view_of_recording
from lidarpose.workflows.world import WORLD_METHODS, locate_target

FRAMES = 20
ARC_MIDDLE_DEG = 10.75


def run(effort: Effort) -> Report:
    turntable = in_processes(_table_1, [(seed, effort.pick(87, 30)) for seed in range(effort.pick(2, 1))])
    disks = in_processes(_disk, list(range(effort.pick(10, 2))))
    cases = [(pose, seed, effort.pick(FRAMES, 2)) for pose in CASES for seed in range(effort.pick(3, 1))]
    corners = in_processes(_corner_case, cases)
    return Report(
        {},
        [
            _turntable_table(turntable),
            _disk_table(disks),
            *(
                _corner_table(pose, [c for (p, _, _), c in zip(cases, corners, strict=True) if p == pose])
                for pose in CASES
            ),
        ],
    )


def _table_1(task: tuple[int, int]) -> dict[str, Row]:
    return measure(*task)


def _turntable_table(found: list[dict[str, Row]]) -> Table:
    rows: list[list[object]] = [["printed in the paper", 1.12, 0.203, 0.662, "-", "-"]]
    for method, name in (("paper", "its method here"), ("joint", "lidarpose, joint")):
        mine = [seed[method] for seed in found]
        rows.append(
            [
                name,
                float(np.mean([r.deviation.centre_mm.mean for r in mine])),
                float(np.mean([r.deviation.z_deg.mean for r in mine])),
                float(np.mean([r.deviation.x_deg.mean for r in mine])),
                float(np.mean([r.error.arc_centre_mm.largest for r in mine])),
                float(np.mean([r.error.arc_rotation_deg.largest for r in mine])),
            ]
        )
    columns = ["", "centre, mm", "z axis, deg", "x axis, deg", "error against the truth, mm", "deg"]
    text = (
        "Table 1 of the turntable paper: mean deviation of the function from the samples it was fitted to, "
        f"{len(found)} rendered sessions of its set-up, from images. The last columns are what it does not "
        "tell: the largest error against the truth inside the arc."
    )
    return Table("The turntable paper's Table 1", columns, rows, text)


def _disk(seed: int) -> tuple[float, float]:
    """Errors in mm of the disk's diameter: ours, and of the outermost points, which is the paper's way."""
    motion = draw_rig(7).motion
    theta = _beam_across_the_axis(motion)
    turned = Pose(motion.T_turntable_lidar.rotation @ Pose.rot_z(theta).rotation, motion.T_turntable_lidar.translation)
    before = TurntableMotion(motion.T_camera_turntable @ Pose.rot_z(np.deg2rad(ARC_MIDDLE_DEG)), turned)
    rng = np.random.default_rng(seed)
    scene = replace(
        DiskScene(beam=BeamModel(spot_m=0.003, dropout=0.003, rays=91), stand=bool(seed % 2)),
        tilt_deg=rng.uniform(0.0, 30.0),
        tilt_direction_deg=rng.uniform(0.0, 360.0),
        aside_m=tuple(rng.uniform(-0.1, 0.1, 2)),
    )
    readings = np.arange(-7.0, 7.0, 0.05) + rng.uniform(0.0, 0.05) + ARC_MIDDLE_DEG
    beams = np.arange(-7.0, 7.0, 1.0 / 12.0) + rng.uniform(0.0, 1.0 / 12.0) + np.rad2deg(theta)
    recording = simulate_sweeps(SweepPlan(motion, readings, beams, scene.beam), disk_surfaces(scene, before), seed=seed)
    disk = measure_disk(view_of_recording(recording, TurntableCalibration(motion)))[0]
    return 1e3 * (disk.diameter_m - scene.diameter_m), 1e3 * (disk.outermost_diameter_m - scene.diameter_m)


def _beam_across_the_axis(motion: TurntableMotion) -> float:
    """The beam angle whose direction is square to the axis and points away from the camera, at the arc's middle."""
    T = motion.pose(np.deg2rad(ARC_MIDDLE_DEG))
    axis = T.rotation.T @ motion.axis_direction_camera
    theta = np.arctan2(axis[1], axis[0]) + np.pi / 2.0
    forward = T.rotation @ [np.cos(theta), np.sin(theta), 0.0]
    return float(theta if forward[2] > 0.0 else theta + np.pi)


# The errors that Table 2 prints, in mm, without their signs.
PRINTED_DISK_MM = (2.88, 4.20, 5.11, 2.63, 1.52, 4.36, 1.57, 3.13, 0.19, 2.08)


def _disk_table(found: list[tuple[float, float]]) -> Table:
    ours, outermost = np.array(found).T
    rows: list[list[object]] = [["printed in the paper", float(np.mean(PRINTED_DISK_MM)), max(PRINTED_DISK_MM), "-"]]
    for name, e in (("outermost points", outermost), ("lidarpose", ours)):
        rows.append([name, float(np.abs(e).mean()), float(np.abs(e).max()), float(e.mean())])
    text = f"Table 2 of the turntable paper: a disk of 140 mm, {len(found)} simulated recordings, the true calibration."
    return Table(
        "The turntable paper's Table 2", ["", "mean error, mm", "largest, mm", "mean with its sign, mm"], rows, text
    )


def _corner_case(task: tuple[str, int, int]) -> dict[str, FloatArray]:
    """By method: rotation (deg), position (mm) and normalised squared error of one session."""
    pose, seed, frames = task
    session, truth = simulate_corner_session(CornerSceneSpec(pose=pose, frames=frames, seed=seed))
    located = locate_target(session)
    found = {method: errors(session, truth, located, method) for method in WORLD_METHODS}
    return {method: e for method, e in found.items() if e is not None}


def _corner_table(pose: str, found: list[dict[str, FloatArray]]) -> Table:
    rows: list[list[object]] = []
    for method in ("harris", "ransac", "paper-approx", "paper", "joint"):
        mine = [e[method] for e in found if method in e]
        if not mine:
            continue
        printed = PRINTED.get((pose, method))
        said = f"{printed[0]:.3g} deg, {printed[1]:.3g} mm" if printed else "-"
        e = rms(mine)
        rows.append([method, float(e[0]), float(e[1]), len(mine), said])
    text = f"{len(found)} simulated sessions; `harris` and `ransac` use one frame a place, the others all."
    columns = ["method", "deg RMS", "mm RMS", "answers", "largest that the paper prints"]
    return Table(f"The corner paper: {CASES[pose]}", columns, rows, text)
