"""What `lidarpose measure` reads: a sweep recording with its calibration, or a cloud with or without one."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from lidarpose.workflows.measuring import MeasuringView


def measurement_view(source: Path, calibration: Path | None, never_stops: bool) -> MeasuringView:
    """The beams to measure from. Raises InputError where a file is missing or unreadable."""
    from lidarpose.errors import InputError
    from lidarpose.storage.calibration import read_turntable_calibration
    from lidarpose.storage.clouds import read_cloud
    from lidarpose.storage.recording import read_recording
    from lidarpose.workflows.measuring import view_of_cloud, view_of_recording, with_readings_between

    turntable = None if calibration is None else read_turntable_calibration(calibration)
    if not source.is_dir():
        return view_of_cloud(read_cloud(source), turntable)
    recording = read_recording(source)
    if turntable is None:
        raise InputError(
            "CALIBRATION",
            "is missing",
            expected="the turntable's calibration file after the recording",
            remedy=f"For example: lidarpose measure ... {source} calibration.json",
        )
    if never_stops and not recording.has_reading_per_beam:
        recording = with_readings_between(recording)
    return view_of_recording(recording, turntable)
