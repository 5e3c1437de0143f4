"""Scan and measure: from a sweep recording and a calibration to clouds and sizes. No disk, no printing."""

from __future__ import annotations

from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.measure.assemble import assemble, compact, pays_to_compile, readings_between
from lidarpose.measure.point_sigma import point_sigma, world_points
from lidarpose.measure.scan_filter import mixed_pixels, within_gate
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.recording import RealArray, SweepRecording
from lidarpose.model.turntable import TurntableMotion

POINTS_PER_PART = 1 << 18
"""Points that are assembled at a time: few enough for the cache and for bounded memory."""
# Range noise where neither the recording nor the user names one, for filters only.
_USUAL_RANGE_SIGMA_M = 0.005


@dataclass(frozen=True)
class ScanOptions:
    """What to keep of a scan, and in which form.

    Attributes
    ----------
    nearest_m, farthest_m
        Range gate.
    drop_mixed
        Leave mixed pixels out.
    sigma
        Give each point the field `sigma_m`.
    indices
        Give each point the fields `sweep` and `beam`.
    keep_order
        Keep beams without return, as NaN points, so that the cloud has N * M points in the order of the recording.
    never_stops
        The turntable turned on during each sweep: interpolate between the readings by the times.
    intensity
        Give each point the field `intensity`, where the recording has it.
    """

    nearest_m: float = 0.0
    farthest_m: float = np.inf
    drop_mixed: bool = False
    sigma: bool = False
    indices: bool = False
    keep_order: bool = False
    never_stops: bool = False
    intensity: bool = True

    def fields(self, recording: SweepRecording) -> dict[str, np.dtype[Any]]:
        """Names and types of the fields that the clouds will have."""
        fields: dict[str, np.dtype[Any]] = {}
        if self.intensity and recording.intensity is not None:
            fields["intensity"] = recording.intensity.dtype
        if self.sigma:
            fields["sigma_m"] = np.dtype(np.float32)
        if self.indices:
            fields["sweep"] = fields["beam"] = np.dtype(np.int32)
        return fields


def assemble_scan(
    recording: SweepRecording,
    calibration: TurntableCalibration,
    options: ScanOptions | None = None,
    world: WorldCalibration | None = None,
    *,
    points_per_part: int = POINTS_PER_PART,
) -> Iterator[Cloud]:
    """The cloud of a recording in parts, in the order of the sweeps: turntable paper, eq. (28).

    Points are in the camera frame, or in the world's if `world` is given. Memory is bounded by the size of a part.

    Raises
    ------
    InputError
        If `world` is for another frame, or `never_stops` lacks times.
    """
    options = options or ScanOptions()
    if world is not None and world.source != "camera":
        raise InputError(
            "world calibration",
            "is for clouds in the lidar frame",
            expected="one for the camera frame, world <- camera",
            remedy='Calibrate the world with cloud_frame = "camera" in its session.',
        )
    if options.never_stops and not recording.has_reading_per_beam:
        require_times(recording)
    motion = _fold_in(calibration.motion.in_true_angles, world)
    compiled = pays_to_compile(recording)

    def cloud(first: int, part: SweepRecording) -> Cloud:
        if options.never_stops and not recording.has_reading_per_beam:
            part = replace(part, turntable_angle_deg=readings_between(recording, first, first + part.sweeps))
        part = in_true_angles(part, calibration)
        return _cloud(part, first, calibration, options, world, motion, compiled)

    # One part is assembled while the one before is written.
    with ThreadPoolExecutor(1) as ahead:
        waiting: Future[Cloud] | None = None
        for first, part in recording.parts(points_per_part):
            following = ahead.submit(cloud, first, part)
            if waiting is not None:
                yield waiting.result()
            waiting = following
        if waiting is not None:
            yield waiting.result()


def in_true_angles(recording: SweepRecording, calibration: TurntableCalibration) -> SweepRecording:
    """The recording with true angles and ranges in place of those that the calibration says are off."""
    recording = calibration.beams.apply(recording)
    if calibration.motion.reading_scale == 1.0:
        return recording
    readings = np.deg2rad(np.asarray(recording.turntable_angle_deg, dtype=np.float64))
    return replace(recording, turntable_angle_deg=np.rad2deg(calibration.motion.true_angle(readings)))


def require_times(recording: SweepRecording) -> None:
    """Raise InputError if readings cannot be interpolated by time."""
    if recording.time_s is None or recording.sweeps < 2:
        raise InputError(
            recording.name,
            "has no times to interpolate the turntable's readings by",
            expected="time_s.npy and at least two sweeps, or turntable_angle_deg.npy with a reading a beam",
        )


def _fold_in(motion: TurntableMotion, world: WorldCalibration | None) -> TurntableMotion | None:
    """The motion with the world's pose in front, where no scale stands between them."""
    if world is None:
        return motion
    if world.scale != 1.0:
        return None
    return TurntableMotion(world.T_world_source @ motion.T_camera_turntable, motion.T_turntable_lidar)


def _cloud(
    part: SweepRecording,
    first: int,
    calibration: TurntableCalibration,
    options: ScanOptions,
    world: WorldCalibration | None,
    motion: TurntableMotion | None,
    compiled: bool,
) -> Cloud:
    in_camera = motion is None or (options.sigma and world is not None)
    true_motion = calibration.motion.in_true_angles
    points = assemble(part, true_motion if motion is None or in_camera else motion, compiled=compiled)
    columns: dict[str, RealArray] = {}
    if options.intensity and part.intensity is not None:
        columns["intensity"] = np.asarray(part.intensity)
    if options.sigma:
        columns["sigma_m"] = point_sigma(points, part, calibration, part.lidar.range_sigma_m, world)
    if world is not None and in_camera:
        points = world_points(points, world)
    if options.indices:
        rows = np.arange(first, first + part.sweeps, dtype=np.int32)
        columns["sweep"] = np.broadcast_to(rows[:, None], part.range_m.shape)
        columns["beam"] = np.broadcast_to(np.arange(part.beams, dtype=np.int32), part.range_m.shape)
    keep = within_gate(part, options.nearest_m, options.farthest_m)
    if options.drop_mixed:
        keep &= ~mixed_pixels(part, part.lidar.range_sigma_m or _USUAL_RANGE_SIGMA_M)
    if options.keep_order:
        points[~keep] = np.nan
        keep = np.ones_like(keep)
    flat, fields = compact(points, keep, columns)
    return Cloud(flat, fields, "camera" if world is None else "world")
