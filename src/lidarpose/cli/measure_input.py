"""What `lidarpose measure` reads: a sweep recording with its calibration, or a cloud."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidarpose.model.calibration import TurntableCalibration
    from lidarpose.model.recording import SweepRecording


def measurement_input(
    source: Path, calibration: Path | None, never_stops: bool
) -> tuple[SweepRecording, TurntableCalibration]:
    """The recording and its calibration. Raises InputError where one is missing or unreadable."""
    from lidarpose.errors import InputError
    from lidarpose.storage.calibration import read_turntable_calibration
    from lidarpose.storage.recording import read_recording
    from lidarpose.workflows.measuring import with_readings_between

    recording = read_recording(source)
    if calibration is None:
        raise InputError(
            "CALIBRATION",
            "is missing",
            expected="the turntable's calibration file after the recording",
            remedy=f"For example: lidarpose measure disk {source} calibration.json",
        )
    turntable = read_turntable_calibration(calibration)
    if never_stops and not recording.has_reading_per_beam:
        recording = with_readings_between(recording)
    return recording, turntable
