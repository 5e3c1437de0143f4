"""How well each assembled point is known: the calibration's covariance and the range noise, to first order."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray, IntArray
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
    recording, calibration
        Angles and ranges put right by the calibration, and the calibration as it is in the file. Of its further
        parameters those count that move points: `encoder_scale`, `range_offset_m`, `range_scale`, `beam_angle_scale`.
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
    extras = [name for name in _MOVING if name in calibration.parameter_names]
    if covariance is not None:
        angles = recording.turntable_angle_rad
        if recording.has_reading_per_beam:
            # The covariance changes by 1e-3 of itself over a sweep's part of the turn: one reading a sweep is enough.
            angles = angles.mean(axis=1)
        motion = calibration.motion.in_true_angles
        for row, angle in enumerate(angles):
            J = motion.pose_jacobian(float(angle))
            variance[row] += moved_variance(J @ covariance @ J.T, points_camera[row])
            if extras:
                points = np.asarray(points_camera[row], dtype=np.float64)
                variance[row] += _extra_variance(calibration, extras, recording.beam_angle_rad, float(angle), points, J)
    if world is not None:
        variance *= world.scale**2
        if world.covariance is not None:
            variance += moved_variance(world.covariance, world_points(points_camera, world))
    return np.asarray(np.sqrt(variance), dtype=np.float32)


def point_shifts(
    points: FloatArray, index: IntArray, recording: SweepRecording, calibration: TurntableCalibration
) -> FloatArray:
    """How points (n, 3) of flat indices (n,) move with the parameters of `shifting_covariance`: (n, 3, p).

    `recording` and `calibration` are as in `point_sigma`.
    """
    sweep, beam = np.divmod(index, recording.beams)
    angles = recording.turntable_angle_rad
    angle = angles[sweep, beam] if recording.has_reading_per_beam else angles[sweep]
    J = calibration.motion.in_true_angles.pose_jacobians(angle)
    out = [J[:, :3] + np.cross(J[:, 3:], points[:, :, None], axis=1)]
    for name in _MOVING:
        if name in calibration.parameter_names:
            by = np.empty((len(points), 3, 1))
            for one in np.unique(sweep):
                mine = sweep == one
                theta, mean = recording.beam_angle_rad[beam[mine]], float(angle[mine].mean())
                by[mine, :, 0] = _moved_by(name, calibration, theta, mean, points[mine])
            out.append(by)
    return np.concatenate(out, axis=2)


def shifting_covariance(calibration: TurntableCalibration) -> FloatArray | None:
    """Of `shifting_parameters`; None where there is none."""
    if calibration.parameter_covariance is None:
        return None
    at = [calibration.parameter_names.index(name) for name in shifting_parameters(calibration)]
    return calibration.parameter_covariance[np.ix_(at, at)]


def shifting_parameters(calibration: TurntableCalibration) -> tuple[str, ...]:
    """Names of the motion's ten parameters and of those further ones of the calibration that move points."""
    names = calibration.parameter_names
    return (*names[:10], *(name for name in _MOVING if name in names))


_MOVING = ("encoder_scale", "range_offset_m", "range_scale", "beam_angle_scale")


def _extra_variance(
    calibration: TurntableCalibration,
    extras: list[str],
    beam_rad: FloatArray,
    angle_rad: float,
    points: FloatArray,
    J: FloatArray,
) -> FloatArray:
    """What further parameters add to the points' variance (M,), their correlation with the motion included."""
    assert calibration.parameter_covariance is not None
    at = [calibration.parameter_names.index(name) for name in extras]
    C = calibration.parameter_covariance
    by_extra = np.stack([_moved_by(name, calibration, beam_rad, angle_rad, points) for name in extras], axis=1)
    by_motion = J[:3].T + np.cross(J[3:].T, points[:, None, :])
    own = np.einsum("mka,kl,mla->m", by_extra, C[np.ix_(at, at)], by_extra)
    return np.asarray(own + 2.0 * np.einsum("mja,jk,mka->m", by_motion, C[:10][:, at], by_extra, optimize=True))


def _moved_by(
    name: str, calibration: TurntableCalibration, beam_rad: FloatArray, angle_rad: float, points: FloatArray
) -> FloatArray:
    """Derivative (M, 3) of points by a further parameter."""
    motion = calibration.motion.in_true_angles
    if name == "encoder_scale":
        scaled = calibration.motion
        twist = scaled.T_camera_turntable.adjoint()[:, 5] * (
            (angle_rad - scaled.reading_origin_rad) / scaled.reading_scale
        )
        return np.asarray(twist[:3] + np.cross(twist[3:], points))
    pose = motion.pose(angle_rad)
    along = points - pose.translation
    if name == "range_scale":
        return np.asarray(-along / calibration.beams.range_scale)
    if name == "range_offset_m":
        with np.errstate(invalid="ignore"):
            return np.asarray(-along / np.linalg.norm(along, axis=-1, keepdims=True) / calibration.beams.range_scale)
    stated = beam_rad / calibration.beams.angle_scale
    return np.asarray(np.cross(pose.rotation[:, 2], along) * stated[:, None])


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
