"""Standard deviations of the angles between measured planes, against many draws of noise and calibration."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.measure.planes import joined_planes, plane_angle_sigmas_deg, plane_angles_deg
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion
from lidarpose.simulate.surfaces import Sheet
from lidarpose.workflows.measuring import measure_planes, plane_angle_sigmas, view_of_cloud, view_of_recording
from lidarpose.workflows.scanning import assemble_scan
from lidarpose.workflows.self_calibration import axis_in_fan
from tests_support.rooms import ROOM, sweep_room

EXTRAS = ("encoder_scale", "range_offset_m", "beam_angle_scale")


def moved(motion: TurntableMotion, change: FloatArray) -> TurntableMotion:
    """By the motion's ten parameters, and a factor on readings."""
    mounting = motion.T_turntable_lidar
    return TurntableMotion(
        Pose.exp(change[:6]) @ motion.T_camera_turntable,
        Pose(exp_so3(change[7:10]) @ mounting.rotation, mounting.translation + [change[6], 0.0, 0.0]),
        reading_scale=1.0 + change[10],
    )


def wall_angles(n: FloatArray, wanted: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Which of the measured planes are the wanted ones, (k,), and the angles between these, counted from 0 to 90."""
    at = np.abs(n @ wanted.T).argmax(axis=0)
    between = np.abs(wanted @ wanted.T)
    return at, np.asarray(np.degrees(np.arccos(np.clip(between, 0.0, 1.0))))


def test_angles_scatter_by_their_standard_deviations() -> None:
    lidar = Pose(axis_in_fan(np.pi / 2.0).rotation, np.array([0.05, 0.0, 0.0]))
    truth = TurntableMotion(Pose.identity(), lidar)
    readings, beams = np.arange(0.0, 360.0, 4.0), np.arange(-90.0, 90.0, 2.0)
    sigma = np.concatenate([[1e-3] * 3, [2e-3] * 3, [4e-3], [3e-3] * 3, [1e-3, 2e-3, 2e-3]])
    wanted = np.stack([surface.T_scene_sheet.rotation[:, 2] for surface in ROOM[:4] if isinstance(surface, Sheet)])
    rng = np.random.default_rng(5)
    scores = []
    for seed in range(12):
        change = sigma * rng.standard_normal(13)
        recording = sweep_room(lidar, readings, beams, seed=seed)
        calibration = TurntableCalibration(
            moved(truth, change),
            np.diag(sigma**2),
            (*PARAMETER_NAMES, *EXTRAS),
            beams=BeamCorrection(1.0 + change[12], 1.0, change[11]),
        )
        view = view_of_recording(recording, calibration)
        planes = measure_planes(view)
        angles, stated = plane_angles_deg(planes), plane_angle_sigmas(view, planes)
        at, true = wall_angles(np.stack([p.plane.normal for p in planes]), wanted)
        assert len(set(at)) == len(wanted)
        rows, columns = np.triu_indices(len(at), 1)
        scores.append((angles[at[rows], at[columns]] - true[rows, columns]) / stated[at[rows], at[columns]])
        # The frame's own uncertainty turns all planes alike.
        assert stated.max() < 1.0
    assert np.sqrt(np.mean(np.square(scores))) == pytest.approx(1.0, abs=0.3)
    assert np.abs(scores).max() < 4.0


def test_what_turns_everything_alike_costs_no_angle() -> None:
    """Of a cloud there is noise alone, and the camera's frame is no part of an angle."""
    lidar = axis_in_fan(np.pi / 2.0)
    recording = sweep_room(lidar, np.arange(0.0, 360.0, 4.0), np.arange(-90.0, 90.0, 2.0), seed=1)
    covariance = np.zeros((10, 10))
    exact = TurntableCalibration(TurntableMotion(Pose.identity(), lidar), covariance)
    turned = TurntableCalibration(exact.motion, np.diag([0.1] * 3 + [0.05] * 3 + [0.0] * 4) ** 2)
    unknown = TurntableCalibration(exact.motion)
    views = [view_of_recording(recording, calibration) for calibration in (exact, turned, unknown)]
    sigma = [plane_angle_sigmas(view, measure_planes(view)) for view in views]
    np.testing.assert_allclose(sigma[1], sigma[0], atol=1e-6)
    np.testing.assert_allclose(sigma[2], sigma[0], atol=1e-6)
    assert any("no covariance" in remark for remark in views[2].remarks)
    (cloud,) = assemble_scan(recording, exact, points_per_part=10**9)
    of_cloud = view_of_cloud(cloud, None)
    assert plane_angle_sigmas(of_cloud, measure_planes(of_cloud)).max() < 0.5


def test_parallel_planes_are_as_uncertain_as_their_worse_direction() -> None:
    """Slats 4 m long and 0.5 m wide: a normal is known along them, and not across."""
    rng = np.random.default_rng(3)
    angles, sigmas = [], []
    for _ in range(60):
        xy = rng.uniform([-2.0, -0.25], [2.0, 0.25], (2, 400, 2))
        sheets = [
            np.column_stack([p, h + 0.004 * rng.standard_normal(400)]) for p, h in zip(xy, (1.0, 3.0), strict=True)
        ]
        points = np.concatenate(sheets)
        planes = joined_planes(points, [np.arange(400), np.arange(400, 800)], 0.004)
        angles.append(plane_angles_deg(planes)[0, 1])
        sigmas.append(plane_angle_sigmas_deg(planes, points)[0, 1])
    # The worse direction dominates: the angle is about the length of one normal value.
    assert np.sqrt(np.mean(np.square(angles))) == pytest.approx(np.mean(sigmas), rel=0.25)
