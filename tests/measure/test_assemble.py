"""Assembling against poses beam by beam, and what each point's sigma says against sampling."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.compiled import installed
from lidarpose.geometry.se3 import Pose
from lidarpose.measure.assemble import assemble, beam_origins_and_directions, readings_between
from lidarpose.measure.point_sigma import moved_variance, point_sigma
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion
from lidarpose.workflows.scanning import in_true_angles


def some_motion(rng: np.random.Generator) -> TurntableMotion:
    mounting = Pose(Pose.exp(rng.normal(size=6)).rotation, np.array([0.05, 0.0, 0.0]))
    return TurntableMotion(Pose.exp(rng.normal(size=6)), mounting)


def some_recording(rng: np.random.Generator, *, per_beam: bool, sweeps: int = 7, beams: int = 11) -> SweepRecording:
    r = rng.uniform(0.5, 3.0, (sweeps, beams)).astype(np.float32)
    r[0, 0], r[1, 2], r[2, 3], r[3, 4] = np.nan, 0.0, np.inf, -1.0
    reading = np.arange(sweeps) * 0.3 - 20.0
    if per_beam:
        reading = reading[:, None] + np.linspace(0.0, 0.3, beams)
    return SweepRecording("test", reading, np.linspace(-45.0, 225.0, beams), r)


def beam_by_beam(recording: SweepRecording, motion: TurntableMotion) -> np.ndarray:
    points = np.full((recording.sweeps, recording.beams, 3), np.nan)
    reading = np.broadcast_to(
        recording.turntable_angle_rad if recording.has_reading_per_beam else recording.turntable_angle_rad[:, None],
        recording.range_m.shape,
    )
    for i, j in np.argwhere(recording.has_return()):
        theta, r = recording.beam_angle_rad[j], float(recording.range_m[i, j])
        points[i, j] = motion.pose(reading[i, j]) @ np.array([r * np.cos(theta), r * np.sin(theta), 0.0])
    return points


@pytest.mark.parametrize("per_beam", [False, True])
@pytest.mark.parametrize("compiled", [False, True])
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_assembles_each_beam_by_equation_28(per_beam: bool, compiled: bool, dtype: type) -> None:
    if compiled and not installed():
        pytest.skip("numba is not installed")
    rng = np.random.default_rng(1)
    motion, recording = some_motion(rng), some_recording(rng, per_beam=per_beam)
    points = assemble(recording, motion, dtype=dtype, compiled=compiled)
    assert points.dtype == dtype
    expected = beam_by_beam(recording, motion)
    np.testing.assert_allclose(points, expected, atol=2e-6 if dtype is np.float32 else 1e-12)
    assert np.isnan(points[~recording.has_return()]).all()


@pytest.mark.parametrize("per_beam", [False, True])
def test_origins_and_directions_give_the_same_points(per_beam: bool) -> None:
    rng = np.random.default_rng(2)
    motion, recording = some_motion(rng), some_recording(rng, per_beam=per_beam)
    origins, directions = beam_origins_and_directions(motion, recording)
    if not per_beam:
        origins = origins[:, None]
    points = origins + recording.range_m[..., None] * directions
    ok = recording.has_return()
    np.testing.assert_allclose(points[ok], beam_by_beam(recording, motion)[ok], atol=1e-6)


def test_a_turntable_that_turns_evenly_is_interpolated_exactly() -> None:
    beam = np.linspace(0.0, 270.0, 541)
    time = np.arange(20) * 0.05
    recording = SweepRecording("test", time * 12.0, beam, np.ones((20, 541), np.float32), time_s=time)
    expected = 12.0 * (time[:, None] + beam / 360.0 * 0.05)
    np.testing.assert_allclose(readings_between(recording), expected, atol=1e-12)
    np.testing.assert_allclose(readings_between(recording, 5, 8), expected[5:8], atol=1e-12)


def test_moved_variance_is_that_of_sampled_poses() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6)) * 1e-3
    xi = rng.normal(size=(20000, 6)) @ root.T
    p = np.array([0.3, -1.2, 2.0])
    moved = xi[:, :3] + np.cross(xi[:, 3:], p)
    sampled = (moved**2).sum(axis=1).mean()
    assert moved_variance(root @ root.T, p) == pytest.approx(sampled, rel=0.03)


def test_point_sigma_joins_calibration_and_range_noise() -> None:
    rng = np.random.default_rng(4)
    motion, recording = some_motion(rng), some_recording(rng, per_beam=False)
    root = rng.normal(size=(10, 10)) * 3e-4
    calibration = TurntableCalibration(motion, root @ root.T)
    sigma = point_sigma(assemble(recording, motion), recording, calibration, 0.002)
    i, j = 4, 6
    samples = []
    for _ in range(4000):
        step = root @ rng.normal(size=10)
        turned = Pose(Pose.exp(np.r_[np.zeros(3), step[7:]]).rotation @ motion.T_turntable_lidar.rotation, np.zeros(3))
        moved = TurntableMotion(
            Pose.exp(step[:6]) @ motion.T_camera_turntable,
            Pose(turned.rotation, np.array([motion.radius_m + step[6], 0.0, 0.0])),
        )
        noisy = replace(recording, range_m=recording.range_m + np.float64(0.002) * rng.normal())
        samples.append(assemble(noisy.part(i, i + 1), moved, dtype=np.float64)[0, j])
    expected = np.sqrt(np.var(samples, axis=0).sum())
    assert sigma[i, j] == pytest.approx(expected, rel=0.05)
    assert np.isnan(sigma[0, 0])


def test_point_sigma_holds_further_parameters() -> None:
    """Against points drawn with the motion and four further parameters all at once, correlated."""
    rng = np.random.default_rng(8)
    motion, recording = some_motion(rng), some_recording(rng, per_beam=False)
    motion = replace(motion, reading_scale=1.03, reading_origin_rad=0.4)
    beams = BeamCorrection(angle_scale=0.98, range_scale=1.01, range_offset_m=0.02)
    names = (*PARAMETER_NAMES, "encoder_scale", "range_offset_m", "range_scale", "beam_angle_scale")
    root = rng.normal(size=(14, 14)) * 3e-4
    calibration = TurntableCalibration(motion, root @ root.T, names, beams=beams)
    true = in_true_angles(recording, calibration)
    sigma = point_sigma(assemble(true, motion.in_true_angles), true, calibration, None)
    i, j = 4, 6
    samples = []
    for _ in range(4000):
        step = root @ rng.normal(size=14)
        turned = Pose.exp(np.r_[np.zeros(3), step[7:10]]).rotation @ motion.T_turntable_lidar.rotation
        moved = TurntableMotion(
            Pose.exp(step[:6]) @ motion.T_camera_turntable,
            Pose(turned, np.array([motion.radius_m + step[6], 0.0, 0.0])),
            motion.reading_scale + step[10],
            motion.reading_origin_rad,
        )
        off = BeamCorrection(0.98 + step[13], 1.01 + step[12], 0.02 + step[11])
        again = in_true_angles(recording.part(i, i + 1), TurntableCalibration(moved, beams=off))
        samples.append(assemble(again, moved.in_true_angles, dtype=np.float64)[0, j])
    expected = np.sqrt(np.var(samples, axis=0).sum())
    assert sigma[i, j] == pytest.approx(expected, rel=0.05)
