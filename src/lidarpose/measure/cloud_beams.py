"""Beams recovered from plain clouds: what was sent, though only what came back was written down.

Three ways, from the most exact: with the turntable's calibration each point tells the reading and the beam that saw it;
a cloud seen from its origin by a LiDAR with rings is a grid of elevations and azimuths; any other cloud is sorted into
cells by direction, which knows the edge only to about a cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray, IntArray, perpendicular_pair, unit
from lidarpose.measure.beams import Beams
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion

_MOST_CELLS = 40_000_000
# A cloud's coordinates are float32: angles of one beam agree to this.
_SAME_ANGLE_RAD = 2e-5
# Sine of the angle to the axis below which the turn about it is lost in rounding.
_ON_AXIS = 5e-3


def recording_from_cloud(
    points: FloatArray, motion: TurntableMotion, light: FloatArray | None = None
) -> SweepRecording | None:
    """The sweep recording that a cloud in the camera frame was assembled from; None if it does not fit the motion.

    A point lies in the scan plane at the reading psi where ``n(psi) . (p - O(psi)) = 0``; in the turntable's frame that
    is ``a cos(psi) + b sin(psi) = c``, with two solutions of which one has the point before the LiDAR's beams.
    """
    q = motion.T_camera_turntable.inverse() @ points
    n = motion.T_turntable_lidar.rotation[:, 2]
    # n . Rz(-psi) q = n_x radius
    a = n[0] * q[:, 0] + n[1] * q[:, 1]
    b = n[0] * q[:, 1] - n[1] * q[:, 0]
    c = n[0] * motion.radius_m - n[2] * q[:, 2]
    length = np.hypot(a, b)
    with np.errstate(invalid="ignore", divide="ignore"):
        opening = np.arccos(np.clip(c / length, -1.0, 1.0))
    best: SweepRecording | None = None
    for sign in (1.0, -1.0):
        psi = np.arctan2(b, a) + sign * opening
        recording = _gridded(q, psi, motion, light)
        if recording is not None and (best is None or recording.range_m.size < best.range_m.size):
            best = recording
    return best


def recording_of_ideal_cloud(
    points: FloatArray, motion: TurntableMotion, light: FloatArray | None = None, *, half_turn: bool = False
) -> SweepRecording | None:
    """The recording of a cloud that was put together with a LiDAR on the axis, whose fan holds it; None if it was not.

    A point behind the axis may be one of a beam before the LiDAR half a turn on. With `half_turn` the table is taken to
    have turned from 0 to 180 degrees, with beams to both sides; without, beams go to the side of the table's x alone.
    Points of one beam at one reading become sweeps of their own, and copies of a point are dropped.
    """
    q = motion.T_camera_turntable.inverse() @ points
    # On the axis a point tells no reading.
    told = np.hypot(q[:, 0], q[:, 1]) > _ON_AXIS * np.linalg.norm(q, axis=1)
    q, light = q[told], None if light is None else light[told]
    psi = np.arctan2(q[:, 1], q[:, 0])
    if half_turn:
        psi = np.where(psi < -_SAME_ANGLE_RAD, psi + np.pi, psi)
        psi = np.where(psi > np.pi - _SAME_ANGLE_RAD, psi - np.pi, psi)
    return _gridded(q, psi, motion, light, repeated=True)


def _gridded(
    q: FloatArray, psi: FloatArray, motion: TurntableMotion, light: FloatArray | None, *, repeated: bool = False
) -> SweepRecording | None:
    c, s = np.cos(psi), np.sin(psi)
    at_zero = np.column_stack([c * q[:, 0] + s * q[:, 1], -s * q[:, 0] + c * q[:, 1], q[:, 2]])
    p = motion.T_turntable_lidar.inverse() @ at_zero
    theta, r = np.arctan2(p[:, 1], p[:, 0]), np.hypot(p[:, 0], p[:, 1])
    psi_levels, i = _levels(psi)
    theta_levels, j = _levels(theta)
    if repeated:
        keep, i, readings = _told_apart(i, j, r.astype(np.float32))
        psi_levels, j, r, light = psi_levels[readings], j[keep], r[keep], None if light is None else light[keep]
    cells = len(psi_levels) * len(theta_levels)
    if cells > _MOST_CELLS or cells > 50 * len(r) or min(len(psi_levels), len(theta_levels)) < 8:
        return None
    ranges = np.full((len(psi_levels), len(theta_levels)), np.nan, dtype=np.float32)
    ranges[i, j] = r
    # Two points of one beam: this is not how the cloud came about.
    if np.count_nonzero(np.isfinite(ranges)) < 0.99 * len(r):
        return None
    intensity = None
    if light is not None:
        intensity = np.zeros(ranges.shape, dtype=np.float32)
        intensity[i, j] = light
    return SweepRecording("cloud", np.rad2deg(psi_levels), np.rad2deg(theta_levels), ranges, intensity)


def _told_apart(i: IntArray, j: IntArray, r: NDArray[np.float32]) -> tuple[IntArray, IntArray, IntArray]:
    """Which points to keep (k,), the sweep (k,) of each, and each sweep's reading, where beams were sent repeatedly."""
    # Copies of a point hold nothing new.
    keep = np.sort(np.unique(np.stack([i, j, r.view(np.int32)], axis=1), axis=0, return_index=True)[1])
    i, j = i[keep], j[keep]
    order = np.lexsort((keep, j, i))
    new = np.concatenate([[True], (np.diff(i[order]) != 0) | (np.diff(j[order]) != 0)])
    since = np.arange(len(order)) - np.maximum.accumulate(np.where(new, np.arange(len(order)), 0))
    turn = np.empty(len(order), dtype=np.int64)
    turn[order] = since
    sweeps, sweep = np.unique(np.stack([i, turn], axis=1), axis=0, return_inverse=True)
    return keep, np.asarray(sweep, dtype=np.int64).reshape(-1), sweeps[:, 0]


def _levels(angle: FloatArray) -> tuple[FloatArray, IntArray]:
    """The distinct angles of noisy copies, and which one each is."""
    order = np.argsort(angle, kind="stable")
    jump = np.diff(angle[order]) > _SAME_ANGLE_RAD
    label = np.concatenate([[0], np.cumsum(jump)])
    index = np.empty(len(angle), dtype=np.int64)
    index[order] = label
    levels = np.bincount(index, weights=angle) / np.bincount(index)
    return levels, index


def beams_of_rings(points: FloatArray, ring: NDArray[np.integer] | None, light: FloatArray | None) -> Beams | None:
    """The grid of rings and azimuths of a cloud seen from its origin; None if it has no rings.

    Missing azimuths of a ring are beams without return.
    """
    r = np.linalg.norm(points, axis=1)
    elevation = np.arcsin(np.clip(points[:, 2] / r, -1.0, 1.0))
    azimuth = np.arctan2(points[:, 1], points[:, 0])
    index = _ring_index(elevation) if ring is None else np.unique(ring, return_inverse=True)[1]
    if index is None:
        return None
    count = np.bincount(index)
    level = np.bincount(index, weights=elevation) / count
    scatter = np.sqrt(np.bincount(index, weights=(elevation - level[index]) ** 2) / count)
    if len(count) < 8 or np.median(scatter) > 2e-3:
        return None
    row = np.argsort(np.argsort(level))[index]
    level = np.sort(level)
    order = np.lexsort((azimuth, row))
    gap = np.diff(azimuth[order])[np.diff(row[order]) == 0]
    step = float(np.median(gap[gap > 1e-5])) if np.any(gap > 1e-5) else 0.0
    if not step > 1e-4:
        return None
    # Rings may be fired at azimuths of their own; their phase is the circular mean.
    turn = np.exp(2j * np.pi * azimuth / step)
    phase = np.angle(np.bincount(row, turn.real) + 1j * np.bincount(row, turn.imag)) * step / (2.0 * np.pi)
    column = np.round((azimuth - phase[row] + np.pi) / step).astype(np.int64)
    column -= column.min()
    shape = (len(level), int(column.max()) + 1)
    if shape[0] * shape[1] > _MOST_CELLS:
        return None
    middle = phase[:, None] - np.pi + step * (np.arange(shape[1]) + np.round((azimuth.min() + np.pi) / step))
    return _filled(shape, row, column, points, r, middle, np.broadcast_to(level[:, None], shape), light)


def beams_of_cells(points: FloatArray, light: FloatArray | None = None) -> Beams | None:
    """A cloud as seen from its origin, sorted into cells of direction about as far apart as its points."""
    from scipy.spatial import cKDTree

    r = np.linalg.norm(points, axis=1)
    # Angles about the mean direction: nothing is singular where the cloud is.
    forward = unit(points.mean(axis=0))
    u, v = perpendicular_pair(forward)
    local = np.column_stack([points @ forward, points @ u, points @ v]) / r[:, None]
    azimuth, elevation = np.arctan2(local[:, 1], local[:, 0]), np.arcsin(np.clip(local[:, 2], -1.0, 1.0))
    sample = np.random.default_rng(0).permutation(len(points))[:4000]
    angles = np.column_stack([azimuth, elevation])
    distance = np.asarray(cKDTree(angles).query(angles[sample], k=5)[0])
    # The fourth neighbour of a lattice is one step away along its coarser axis.
    step = float(np.median(distance[:, 4]))
    if not step > 1e-6:
        return None
    row, column = (np.floor((x - x.min()) / step).astype(np.int64) for x in (elevation, azimuth))
    shape = (int(row.max()) + 1, int(column.max()) + 1)
    if shape[0] * shape[1] > _MOST_CELLS or min(shape) < 8:
        return None
    az = azimuth.min() + step * (np.arange(shape[1]) + 0.5)
    el = elevation.min() + step * (np.arange(shape[0]) + 0.5)
    # The nearest point of a cell hides the others.
    order = np.argsort(-r, kind="stable")
    axes = np.stack([forward, u, v])
    beams = _filled(
        shape,
        row[order],
        column[order],
        local[order] * r[order, None],
        r[order],
        np.broadcast_to(az, shape),
        np.broadcast_to(el[:, None], shape),
        None if light is None else light[order],
    )
    return Beams(beams.origin @ axes, beams.direction @ axes, beams.range_m, beams.light)


def _ring_index(elevation: FloatArray) -> IntArray | None:
    """Which ring each point is on, if elevations come in few levels."""
    levels, index = _levels(np.round(elevation, 5))
    if len(levels) > 512 or len(elevation) < 40 * len(levels):
        return None
    return index


def _filled(
    shape: tuple[int, int],
    row: IntArray,
    column: IntArray,
    points: FloatArray,
    r: FloatArray,
    azimuth: FloatArray,
    elevation: FloatArray,
    light: FloatArray | None,
) -> Beams:
    """A grid of beams: the points' own directions where there are points, the cell's else."""
    cosine = np.cos(elevation)
    direction = np.stack([cosine * np.cos(azimuth), cosine * np.sin(azimuth), np.sin(elevation)], -1)
    ranges = np.full(shape, np.nan)
    direction[row, column] = points / r[:, None]
    ranges[row, column] = r
    lights = None
    if light is not None:
        lights = np.zeros(shape)
        lights[row, column] = light
    return Beams(np.zeros((*shape, 3)), direction, ranges, lights)
