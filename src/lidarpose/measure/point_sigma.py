"""How well each assembled point is known: the calibration's covariance and the range noise, to first order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.recording import SweepRecording


def point_sigma(
    points_camera: NDArray[Any],
    recording: SweepRecording,
    calibration: TurntableCalibration,
    range_sigma_m: float | None,
    world: WorldCalibration | None = None,
) -> NDArray[np.float32]:
    """Standard deviation of each point's position, metres, (N, M): the root of the trace of its 3x3 covariance.

    Parameters
    ----------
    points_camera : (N, M, 3)
        The assembled points of `recording`.
    range_sigma_m
        Noise of a range; None adds none.
    world
        Its scale and covariance are added where given.

    A left perturbation (v, w) of the pose moves a point p by ``v + w x p``; the trace of the covariance of that is a
    quadratic form in p, one a sweep.
    """
    shape = points_camera.shape[:2]
    variance = np.full(shape, 0.0 if range_sigma_m is None else range_sigma_m**2)
    covariance = calibration.motion_covariance
    if covariance is not None:
        angles = recording.turntable_angle_rad
        if recording.has_reading_per_beam:
            # The covariance changes by 1e-3 of itself over a sweep's part of the turn: one reading a sweep is enough.
            angles = angles.mean(axis=1)
        for row, angle in enumerate(angles):
            J = calibration.motion.pose_jacobian(float(angle))
            variance[row] += moved_variance(J @ covariance @ J.T, points_camera[row])
    if world is not None:
        variance *= world.scale**2
        if world.covariance is not None:
            variance += moved_variance(world.covariance, world_points(points_camera, world))
    return np.asarray(np.sqrt(variance), dtype=np.float32)


def moved_variance(pose_covariance: FloatArray, points: NDArray[Any]) -> FloatArray:
    """E |v + w x p|^2 for points (..., 3) of a pose whose perturbation (v, w) has this covariance (6, 6)."""
    p = np.asarray(points, dtype=np.float64)
    Cvv, Cvw, Cww = pose_covariance[:3, :3], pose_covariance[:3, 3:], pose_covariance[3:, 3:]
    # v . (w x p) = p . (v x w), and |w x p|^2 = |w|^2 |p|^2 - (w . p)^2.
    cross = np.array([Cvw[1, 2] - Cvw[2, 1], Cvw[2, 0] - Cvw[0, 2], Cvw[0, 1] - Cvw[1, 0]])
    form = Cww.trace() * np.eye(3) - Cww
    return np.asarray(Cvv.trace() + 2.0 * (p @ cross) + ((p @ form) * p).sum(axis=-1))


def world_points(points: NDArray[Any], world: WorldCalibration) -> NDArray[Any]:
    """p_world = scale * R @ p + t, of the points' own type."""
    pose: Pose = world.T_world_source
    R = (world.scale * pose.rotation).astype(points.dtype)
    return np.asarray(points @ R.T + pose.translation.astype(points.dtype))
