"""Turntable calibrations with factors on readings and beams, and others drawn from their whole covariance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion

NAMES = (*PARAMETER_NAMES, "encoder_scale", "range_offset_m", "range_scale", "beam_angle_scale")
SIGMA = np.array([1e-3] * 3 + [2e-3] * 3 + [1e-3] + [2e-3] * 3 + [2e-3, 1e-3, 5e-4, 2e-3])


def full_calibration(motion: TurntableMotion, seed: int = 0) -> TurntableCalibration:
    """With every factor that is known of, and all of the parameters correlated."""
    root = np.random.default_rng(seed).normal(size=(len(NAMES), len(NAMES))) + 2.0 * np.eye(len(NAMES))
    C = root @ root.T
    scale = SIGMA / np.sqrt(np.diag(C))
    own = TurntableMotion(motion.T_camera_turntable, motion.T_turntable_lidar, 1.01, 0.05)
    return TurntableCalibration(own, C * np.outer(scale, scale), NAMES, beams=BeamCorrection(1.004, 0.998, 0.01))


def stated(recording: SweepRecording, calibration: TurntableCalibration) -> SweepRecording:
    """What is read where the turntable and the beams are off as a calibration says, from what is true."""
    beams, motion = calibration.beams, calibration.motion
    true = np.deg2rad(recording.turntable_angle_deg)
    read = motion.reading_origin_rad + (true - motion.reading_origin_rad) / motion.reading_scale
    ranges = np.asarray(recording.range_m * beams.range_scale + beams.range_offset_m, dtype=np.float32)
    angles = recording.beam_angle_deg / beams.angle_scale
    return replace(recording, turntable_angle_deg=np.rad2deg(read), beam_angle_deg=angles, range_m=ranges)


def moved(calibration: TurntableCalibration, change: FloatArray) -> TurntableCalibration:
    """A calibration that is off by a change (14,) of `NAMES`."""
    motion, beams = calibration.motion, calibration.beams
    mounting = motion.T_turntable_lidar
    off = TurntableMotion(
        Pose.exp(change[:6]) @ motion.T_camera_turntable,
        Pose(exp_so3(change[7:10]) @ mounting.rotation, mounting.translation + [change[6], 0.0, 0.0]),
        motion.reading_scale + change[10],
        motion.reading_origin_rad,
    )
    factors = BeamCorrection(
        beams.angle_scale + change[13], beams.range_scale + change[12], beams.range_offset_m + change[11]
    )
    return replace(calibration, motion=off, beams=factors)


def drawn(calibration: TurntableCalibration, count: int, seed: int) -> Iterator[TurntableCalibration]:
    """Calibrations whose scatter about this one is exactly its covariance."""
    assert calibration.parameter_covariance is not None
    draws = np.random.default_rng(seed).normal(size=(count, len(NAMES)))
    draws -= draws.mean(axis=0)
    white = draws @ np.linalg.inv(np.linalg.cholesky(np.cov(draws.T))).T
    for change in white @ np.linalg.cholesky(calibration.parameter_covariance).T:
        yield moved(calibration, change)
