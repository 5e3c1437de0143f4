"""From sweeps to points: turntable paper, eq. (28), for a turntable that stops at each angle or never stops.

A beam of range rho at angle theta, seen at the turntable's reading psi, is the point
``T_camera_lidar(psi) @ (rho cos(theta), rho sin(theta), 0)``. Per sweep that is one multiplication and one addition a
coordinate; for a reading a beam, a turn about z and one 3x3 map.

Two ways give the same numbers: NumPy in blocks that fit the cache, and kernels compiled by numba (the `fast` extra)
where `geometry.compiled` says that they pay. Both run on all cores.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.se3 import rotation_z
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion

# By how much kernels are done sooner, on two cores.
SAVED_S_PER_POINT = 4e-9


@dataclass(frozen=True, eq=False)
class SweepPoses:
    """T_camera_lidar of N sweeps: `rotation` (N, 3, 3) and `translation` (N, 3)."""

    rotation: FloatArray
    translation: FloatArray


def sweep_poses(motion: TurntableMotion, turntable_angle_rad: FloatArray) -> SweepPoses:
    """T_camera_lidar at readings (N,): T_camera_turntable @ Rz(reading) @ T_turntable_lidar."""
    R_ct, t_ct = motion.T_camera_turntable.rotation, motion.T_camera_turntable.translation
    R_tl, t_tl = motion.T_turntable_lidar.rotation, motion.T_turntable_lidar.translation
    R_camera = R_ct @ rotation_z(turntable_angle_rad)
    return SweepPoses(np.asarray(R_camera @ R_tl), np.asarray(R_camera @ t_tl + t_ct))


def beam_origins_and_directions(motion: TurntableMotion, recording: SweepRecording) -> tuple[FloatArray, FloatArray]:
    """Where beams start (N, 3) or (N, M, 3), and their unit directions (N, M, 3), in the camera frame."""
    theta = recording.beam_angle_rad
    d_lidar = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], -1)
    poses = sweep_poses(motion, recording.turntable_angle_rad)
    if recording.has_reading_per_beam:
        return poses.translation, np.asarray(np.einsum("nmij,mj->nmi", poses.rotation, d_lidar))
    return poses.translation, np.asarray(np.swapaxes(poses.rotation @ d_lidar.T, 1, 2))


def assemble(
    recording: SweepRecording,
    motion: TurntableMotion,
    *,
    dtype: Any = np.float32,
    out: NDArray[Any] | None = None,
    compiled: bool | None = None,
) -> NDArray[Any]:
    """Points (N, M, 3) in the camera frame, NaN where there is no return.

    Parameters
    ----------
    recording
        N sweeps of M beams.
    motion
        The calibration's two transforms; premultiply its `T_camera_turntable` for another frame.
    dtype
        float32 (for speed) or float64.
    out
        Where to put the points, C-ordered (N, M, 3) of `dtype`; made if None.
    compiled
        Force the compiled or the NumPy way; by default kernels are used where they pay.

    Source: eq. (28) of the turntable paper.
    """
    shape = (recording.sweeps, recording.beams, 3)
    points = np.empty(shape, dtype=dtype) if out is None else out
    if points.shape != shape or not points.flags.c_contiguous:
        raise ValueError(f"out has shape {points.shape}, expected C-ordered {shape}")
    if compiled is None:
        compiled = pays_to_compile(recording)
    block = _block_per_beam if recording.has_reading_per_beam else _block_per_sweep
    if compiled:
        from lidarpose.measure import kernels

        block = kernels.block_per_beam if recording.has_reading_per_beam else kernels.block_per_sweep
    work = block(recording, motion, points)
    # Blocks small enough for the cache in NumPy's way, where every operation passes over the block once more.
    step = max(1, (1 << (20 if compiled else 15)) // recording.beams)
    _in_threads(work, recording.sweeps, step)
    return points


def readings_between(recording: SweepRecording, first: int = 0, last: int | None = None) -> FloatArray:
    """Readings (last - first, M) in degrees of a turntable that turned on during the sweeps, by interpolation in time.

    `time_s` is taken as the time of each sweep's first beam, and the mirror as turning once a sweep: the beam at the
    angle a behind the first one is a / 360 degrees of a period later.
    """
    if recording.time_s is None:
        raise ValueError("the recording has no times")
    time = np.asarray(recording.time_s, dtype=np.float64)
    beam = np.asarray(recording.beam_angle_deg, dtype=np.float64)
    period = float(np.median(np.diff(time)))
    beam_time = time[first:last, None] + np.abs(beam - beam[0]) / 360.0 * period
    reading = np.asarray(recording.turntable_angle_deg, dtype=np.float64)
    # One more sweep at the end, for the beams after the last reading.
    time = np.append(time, time[-1] + period)
    reading = np.append(reading, 2.0 * reading[-1] - reading[-2])
    return np.asarray(np.interp(beam_time, time, reading))


def pays_to_compile(recording: SweepRecording) -> bool:
    """Whether to assemble the whole recording by kernels."""
    return pays(SAVED_S_PER_POINT * recording.range_m.size, "measure.kernels")


def compact(
    points: NDArray[Any], keep: BoolArray, columns: dict[str, NDArray[Any]]
) -> tuple[NDArray[Any], dict[str, Any]]:
    """Points (K, 3) and columns (K,) of the beams (N, M) to keep, in the order of the recording."""
    flat = keep.ravel()
    if flat.all():
        return points.reshape(-1, 3), {name: c.reshape(-1) for name, c in columns.items()}
    index = np.flatnonzero(flat)
    return points.reshape(-1, 3)[index], {name: c.reshape(-1)[index] for name, c in columns.items()}


def _in_threads(work: Callable[[int, int], None], count: int, step: int) -> None:
    """Run work(first, last) over [0, count) in steps, on all cores; NumPy and the kernels release the lock."""
    edges = [(first, min(first + step, count)) for first in range(0, count, step)]
    workers = min(len(edges), os.cpu_count() or 1)
    if workers <= 1:
        for first, last in edges:
            work(first, last)
        return
    with ThreadPoolExecutor(workers) as pool:
        for done in [pool.submit(_run_all, work, edges[k::workers]) for k in range(workers)]:
            done.result()


def _run_all(work: Callable[[int, int], None], edges: list[tuple[int, int]]) -> None:
    for first, last in edges:
        work(first, last)


def _usable(ranges: NDArray[Any], dtype: Any) -> NDArray[Any]:
    """Ranges as `dtype`, NaN where there is no return."""
    usable = (ranges > 0.0) & (ranges < np.inf)
    return np.where(usable, ranges, np.nan).astype(dtype, copy=False)


def _block_per_sweep(
    recording: SweepRecording, motion: TurntableMotion, points: NDArray[Any]
) -> Callable[[int, int], None]:
    dtype = points.dtype
    theta = recording.beam_angle_rad
    cos_sin = np.stack([np.cos(theta), np.sin(theta)])
    poses = sweep_poses(motion, recording.turntable_angle_rad)

    def work(first: int, last: int) -> None:
        ranges = _usable(np.asarray(recording.range_m[first:last]), dtype)
        # Directions in float64 once a sweep, whatever the precision of the points.
        directions = (poses.rotation[first:last, :, :2] @ cos_sin).astype(dtype)
        shifts = poses.translation[first:last].astype(dtype)
        for axis in range(3):
            plane = directions[:, axis]
            plane *= ranges
            np.add(plane, shifts[:, axis, None], out=points[first:last, :, axis])

    return work


def _block_per_beam(
    recording: SweepRecording, motion: TurntableMotion, points: NDArray[Any]
) -> Callable[[int, int], None]:
    dtype = points.dtype
    theta = recording.beam_angle_rad
    R_tl = motion.T_turntable_lidar.rotation
    d = (R_tl[:, :2] @ np.stack([np.cos(theta), np.sin(theta)])).astype(dtype)
    R, t = motion.T_camera_turntable.rotation.astype(dtype), motion.T_camera_turntable.translation.astype(dtype)
    radius = dtype.type(motion.radius_m)

    def work(first: int, last: int) -> None:
        ranges = _usable(np.asarray(recording.range_m[first:last]), dtype)
        angle = np.deg2rad(np.asarray(recording.turntable_angle_deg[first:last], dtype=np.float64))
        c, s = np.cos(angle).astype(dtype), np.sin(angle).astype(dtype)
        x, y, z = ranges * d[0] + radius, ranges * d[1], ranges * d[2]
        x, y = c * x - s * y, s * x + c * y
        for axis in range(3):
            points[first:last, :, axis] = R[axis, 0] * x + R[axis, 1] * y + R[axis, 2] * z + t[axis]

    return work
