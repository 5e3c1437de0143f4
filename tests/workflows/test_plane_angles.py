"""Standard deviations of the angles between measured planes, against many draws of noise and calibration."""

from __future__ import annotations

import numpy as np
import pytest

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.measure.planes import joined_planes, plane_angle_sigmas_deg, plane_angles_deg
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.cloud import Cloud
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


def test_a_cloud_in_any_frame_gives_its_planes() -> None:
    """A room seen by 64 rings; not from the frame's origin, two points may lie in one direction."""
    azimuth, elevation = np.meshgrid(np.radians(np.arange(0.0, 360.0, 0.8)), np.radians(np.linspace(-60.0, 60.0, 64)))
    flat = np.cos(elevation)
    d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    low, high = np.array([-3.0, -3.5, -1.2]), np.array([3.0, 3.0, 1.4])
    ranges = (np.where(d > 0.0, high, low) / np.where(d == 0.0, 1e-12, d)).min(axis=1)
    seen = d * (ranges + 0.004 * np.random.default_rng(1).normal(size=len(d)))[:, None]
    found = {}
    for name, origin in {"its own": np.zeros(3), "the room's": -low, "a grid's": np.array([5e5, 5.4e6, 100.0])}.items():
        planes = measure_planes(view_of_cloud(Cloud(seen + origin), None))[:6]
        found[name] = sorted(p.points for p in planes)
        for axis, side in ((k, face) for face in (low, high) for k in range(3)):
            on_face = 0.5 * (low + high)
            on_face[axis] = side[axis]
            parallel = [p.plane for p in planes if abs(p.plane.normal[axis]) > 0.9999]
            assert min(abs(float(p.distance(on_face + origin))) for p in parallel) < 0.001
    np.testing.assert_allclose(found["the room's"], found["its own"], rtol=0.02)
    np.testing.assert_allclose(found["a grid's"], found["its own"], rtol=0.02)
    with pytest.raises(UndeterminedError, match="single precision"):
        view_of_cloud(Cloud((seen + [5e5, 5.4e6, 100.0]).astype(np.float32)), None)


def test_a_ring_of_a_sparse_lidar_is_no_plane() -> None:
    """A carton's corner a metre before sixteen rings: each ring's points lie in a plane through the LiDAR, too."""
    normals = exp_so3([0.4, -0.6, 0.3]) @ np.diag([-1.0, 1.0, -1.0])
    corner = np.array([1.0, -0.05, -0.1])
    azimuth, elevation = np.meshgrid(np.radians(np.arange(-45.0, 45.0, 0.2)), np.radians(np.arange(-15.0, 16.0, 2.0)))
    flat = np.cos(elevation)
    d = np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1).reshape(-1, 3)
    # A convex corner is met where the last of its faces is.
    ranges = ((normals @ corner)[:, None] / (normals @ d.T)).max(axis=0)
    rng = np.random.default_rng(2)
    points = d * (ranges + 0.004 * rng.normal(size=len(d)))[:, None]
    near = points[np.linalg.norm(d * ranges[:, None] - corner, axis=1) < 0.35]
    planes = measure_planes(view_of_cloud(Cloud(near.astype(np.float32)), None))
    along = np.abs(np.stack([p.plane.normal for p in planes]) @ normals.T)
    assert along[:3].max(axis=0) == pytest.approx(1.0, abs=1e-3)
    assert along.max(axis=1) == pytest.approx(1.0, abs=3e-3)
