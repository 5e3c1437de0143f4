"""Sizes from what was scanned: disks and round holes, boxes, planes. No disk, no printing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.measure.assemble import readings_between
from lidarpose.measure.beams import Beams, beams_of, chosen_beams, range_noise
from lidarpose.measure.disk import RoundMeasurement, measure_round, with_calibration
from lidarpose.measure.outline import Kind, nothing_round
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.workflows.scanning import require_times


def measure_disk(
    recording: SweepRecording, calibration: TurntableCalibration, kind: Kind = "disk", *, seed: int = 0
) -> list[RoundMeasurement]:
    """Disks (or round holes) in a sweep recording, in the camera frame, the best determined first.

    Source: the turntable paper, section 3.2, with the edge estimated from where beams stop hitting it instead of the
    outermost points.

    Raises
    ------
    UndeterminedError
        If nothing round is found.
    """
    sigma = recording_noise(recording)
    found = measure_round(beams_of(recording, calibration.motion), sigma, kind, seed=seed)
    if not found:
        raise nothing_round(kind)
    if calibration.motion_covariance is None:
        return found

    def moved(change: FloatArray, index: IntArray) -> Beams:
        return chosen_beams(recording, calibration.motion, index, change)

    return [with_calibration(m, moved, calibration.motion_covariance) for m in found]


def recording_noise(recording: SweepRecording) -> float:
    """Range noise of a recording, metres: measured in it, or as its head file says where it is too small for that."""
    sigma = range_noise(np.where(recording.has_return(), np.asarray(recording.range_m, dtype=np.float64), np.nan))
    # Recordings without any noise (simulated ones) are still rounded to float32.
    smallest = 1e-5
    if np.isfinite(sigma):
        return max(sigma, smallest)
    if recording.lidar.range_sigma_m is not None:
        return recording.lidar.range_sigma_m
    raise UndeterminedError(
        "The recording holds too few returns to measure anything",
        remedy="Record at least eight sweeps with eight beams each on the object.",
    )


def with_readings_between(recording: SweepRecording) -> SweepRecording:
    """The recording with a reading a beam, for a turntable that turned on during the sweeps.

    Raises
    ------
    InputError
        If there are no times.
    """
    require_times(recording)
    return replace(recording, turntable_angle_deg=readings_between(recording))
