"""Eq. (28) of the turntable paper compiled by numba, which only `measure.assemble` imports, and only where it pays.

The kernels release the interpreter's lock and run in the same threads as the NumPy way. They are kept on disk by
numba, so that only the first process on a machine compiles them (about two seconds).

They write each sweep as one flat row, x, y, z side by side: into a two-dimensional array the compiler stores one number
at a time, at half the speed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.compiled import kernel
from lidarpose.geometry.se3 import rotation_z
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion


@kernel
def _per_sweep(ranges: Any, matrix: Any, shift: Any, cosine: Any, sine: Any, points: Any) -> None:
    zero, nan = ranges.dtype.type(0.0), ranges.dtype.type(np.nan)
    for i in range(ranges.shape[0]):
        a00, a01, a10, a11, a20, a21 = (
            matrix[i, 0, 0],
            matrix[i, 0, 1],
            matrix[i, 1, 0],
            matrix[i, 1, 1],
            matrix[i, 2, 0],
            matrix[i, 2, 1],
        )
        t0, t1, t2 = shift[i, 0], shift[i, 1], shift[i, 2]
        row, out = ranges[i], points[i]
        for j in range(ranges.shape[1]):
            rho = row[j] if row[j] > zero else nan
            rho = rho + (rho - rho)  # infinity becomes NaN without a branch
            x, y = rho * cosine[j], rho * sine[j]
            out[3 * j] = a00 * x + a01 * y + t0
            out[3 * j + 1] = a10 * x + a11 * y + t1
            out[3 * j + 2] = a20 * x + a21 * y + t2


@kernel
def _per_beam(ranges: Any, reading_deg: Any, beam: Any, matrix: Any, shift: Any, radius: Any, points: Any) -> None:
    zero, nan = ranges.dtype.type(0.0), ranges.dtype.type(np.nan)
    to_rad = np.pi / 180.0
    for i in range(ranges.shape[0]):
        out = points[i]
        for j in range(ranges.shape[1]):
            rho = ranges[i, j]
            rho = rho if rho > zero else nan
            rho = rho + (rho - rho)
            angle = reading_deg[i, j] * to_rad
            c, s = np.cos(angle), np.sin(angle)
            u, v, z = rho * beam[0, j] + radius, rho * beam[1, j], rho * beam[2, j]
            x, y = c * u - s * v, s * u + c * v
            out[3 * j] = matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] * z + shift[0]
            out[3 * j + 1] = matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] * z + shift[1]
            out[3 * j + 2] = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] * z + shift[2]


def block_per_sweep(
    recording: SweepRecording, motion: TurntableMotion, points: NDArray[Any]
) -> Callable[[int, int], None]:
    """The work of `assemble` on sweeps [first, last) where each sweep has one reading."""
    theta = recording.beam_angle_rad
    R_camera = motion.T_camera_turntable.rotation @ rotation_z(recording.turntable_angle_rad)
    matrix = (R_camera @ motion.T_turntable_lidar.rotation)[..., :2].astype(points.dtype)
    shift = R_camera @ motion.T_turntable_lidar.translation + motion.T_camera_turntable.translation
    shift = shift.astype(points.dtype)
    cosine, sine = np.cos(theta).astype(points.dtype), np.sin(theta).astype(points.dtype)
    flat = points.reshape(points.shape[0], 3 * points.shape[1])

    def work(first: int, last: int) -> None:
        rows = slice(first, last)
        ranges = np.ascontiguousarray(recording.range_m[rows], dtype=points.dtype)
        _per_sweep(ranges, matrix[rows], shift[rows], cosine, sine, flat[rows])

    return work


def block_per_beam(
    recording: SweepRecording, motion: TurntableMotion, points: NDArray[Any]
) -> Callable[[int, int], None]:
    """The work of `assemble` on sweeps [first, last) where each beam has its reading."""
    theta = recording.beam_angle_rad
    beam = motion.T_turntable_lidar.rotation[:, :2] @ np.stack([np.cos(theta), np.sin(theta)])
    beam = np.ascontiguousarray(beam, dtype=points.dtype)
    matrix = motion.T_camera_turntable.rotation.astype(points.dtype)
    shift = motion.T_camera_turntable.translation.astype(points.dtype)
    radius = points.dtype.type(motion.radius_m)
    flat = points.reshape(points.shape[0], 3 * points.shape[1])

    def work(first: int, last: int) -> None:
        rows = slice(first, last)
        ranges = np.ascontiguousarray(recording.range_m[rows], dtype=points.dtype)
        reading = np.ascontiguousarray(recording.turntable_angle_deg[rows], dtype=np.float64)
        _per_beam(ranges, reading, beam, matrix, shift, radius, flat[rows])

    return work
