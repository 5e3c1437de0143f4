"""Sweep recordings as the clouds of a corner session: assembled in the camera's frame each time they are asked for.

What assembles is imported when it is asked for first: most sessions have no recordings.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CloudSource, CornerSession, RecordingSource, is_recording


@dataclass(frozen=True, eq=False)
class ScannedCloud:
    """A recording with its turntable's calibration: a cloud in the camera's frame."""

    source: RecordingSource
    calibration: TurntableCalibration
    never_stops: bool = False

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> Cloud:
        from lidarpose.workflows.scanning import ScanOptions, assemble_scan

        options = ScanOptions(never_stops=self.never_stops, intensity=False)
        parts = [part.points for part in assemble_scan(self.source.recording(), self.calibration, options)]
        points = np.concatenate(parts) if parts else np.zeros((0, 3), dtype=np.float32)
        return Cloud(points, frame="camera")

    @property
    def parameter_covariance(self) -> FloatArray | None:
        """Of those parameters of the calibration that move points; None where it is not known."""
        from lidarpose.measure.point_sigma import shifting_covariance

        return shifting_covariance(self.calibration)

    def shifts(self) -> Callable[[FloatArray], FloatArray]:
        """How points (n, 3) of the cloud move with the parameters of `parameter_covariance`: (n, 3, p)."""
        from scipy.spatial import cKDTree

        from lidarpose.measure.assemble import readings_between
        from lidarpose.measure.point_sigma import point_shifts
        from lidarpose.workflows.scanning import ScanOptions, assemble_scan, in_true_angles

        recording = self.source.recording()
        options = ScanOptions(never_stops=self.never_stops, intensity=False, indices=True)
        parts = list(assemble_scan(recording, self.calibration, options))
        tree = cKDTree(np.concatenate([part.points for part in parts]))
        index = np.concatenate([p.fields["sweep"].astype(np.int64) * recording.beams + p.fields["beam"] for p in parts])
        if self.never_stops and not recording.has_reading_per_beam:
            recording = replace(recording, turntable_angle_deg=readings_between(recording))
        recording = in_true_angles(recording, self.calibration)

        def moved(points: FloatArray) -> FloatArray:
            return point_shifts(points, index[tree.query(points)[1]], recording, self.calibration)

        return moved


def with_scans(session: CornerSession, *, never_stops: bool = False) -> CornerSession:
    """The session with clouds in place of recordings.

    Parameters
    ----------
    never_stops
        The turntable turned on during the sweeps: its readings are interpolated by time.

    Raises
    ------
    InputError
        If there are recordings and no calibration of their turntable, or their clouds are said to be in another frame.
    """
    if not session.has_recordings:
        return session
    turntable = session.turntable
    if turntable is None or session.cloud_frame != "camera":
        raise InputError(
            session.name,
            "has sweep recordings in place of clouds, and the turntable's calibration is not given"
            if turntable is None
            else "has sweep recordings, but its clouds are said to be in the LiDAR's frame",
            expected='turntable_calibration = "calibration.json" in session.toml, or --turntable'
            if turntable is None
            else 'cloud_frame = "camera"',
        )

    def scanned(source: CloudSource) -> CloudSource:
        return ScannedCloud(source, turntable, never_stops) if is_recording(source) else source

    places = tuple(replace(place, clouds=tuple(map(scanned, place.clouds))) for place in session.places)
    return replace(session, places=places)


def holds_scans(session: CornerSession) -> bool:
    """Whether clouds are assembled by a turntable's calibration, so that they have its errors."""
    return any(isinstance(cloud, ScannedCloud) for place in session.places for cloud in place.clouds)
