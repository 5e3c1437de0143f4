"""Rigid motions: the groups SO(3) and SE(3), and poses with covariance.

Conventions (docs/conventions.md): ``T_a_b`` maps points from frame b to frame a. Poses are perturbed on the left,
``T = Exp(xi) @ T_0`` with ``xi = (translation, rotation)`` in the parent frame; every 6x6 covariance has that order.

Formulas: Barfoot, *State Estimation for Robotics* (2nd ed.), chapter 8; Sola, Deray and Atchuthan, "A micro Lie
theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import overload

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray, as_float_array

# Below this angle the closed forms lose digits to cancellation, and a Taylor series takes their place.
_SMALL_ANGLE = 1e-2


_IDENTITY = np.eye(3)


def skew(v: ArrayLike) -> FloatArray:
    """Cross-product matrices: (..., 3) -> (..., 3, 3) with ``skew(v) @ w == cross(v, w)``."""
    w = np.asarray(v, dtype=np.float64)
    out = np.zeros((*w.shape, 3))
    out[..., 2, 1], out[..., 0, 2], out[..., 1, 0] = w[..., 0], w[..., 1], w[..., 2]
    out[..., 1, 2], out[..., 2, 0], out[..., 0, 1] = -w[..., 0], -w[..., 1], -w[..., 2]
    return out


def _sine_terms(angle: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """sin(t)/t, (1 - cos t)/t^2 and (t - sin t)/t^3, each smooth through t = 0."""
    small = np.abs(angle) < _SMALL_ANGLE
    t = np.where(small, 1.0, angle)
    t2 = angle * angle
    a = np.where(small, 1 - t2 / 6 * (1 - t2 / 20 * (1 - t2 / 42)), np.sin(t) / t)
    b = np.where(small, 0.5 - t2 / 24 * (1 - t2 / 30 * (1 - t2 / 56)), 2.0 * (np.sin(t / 2) / t) ** 2)
    c = np.where(small, 1 / 6 - t2 / 120 * (1 - t2 / 42 * (1 - t2 / 72)), (t - np.sin(t)) / t**3)
    return a, b, c


def exp_so3(rotation_vector: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3) in radians (Rodrigues)."""
    w = np.asarray(rotation_vector, dtype=np.float64)
    a, b, _ = _sine_terms(np.linalg.norm(w, axis=-1))
    W = skew(w)
    return np.asarray(np.eye(3) + a[..., None, None] * W + b[..., None, None] * (W @ W))


def log_so3(rotation: ArrayLike) -> FloatArray:
    """Rotation vectors (..., 3), of length at most pi, of rotation matrices (..., 3, 3).

    Goes through the unit quaternion of largest component (Shepperd), accurate from no turn to half a turn.
    """
    q = quaternion_xyzw_from_matrix(rotation)
    q = np.where(q[..., 3:] < 0.0, -q, q)
    length = np.linalg.norm(q[..., :3], axis=-1)
    half = np.arctan2(length, q[..., 3])
    tiny = length < 1e-12
    scale = np.where(tiny, 2.0, 2.0 * half / np.where(tiny, 1.0, length))
    return np.asarray(q[..., :3] * scale[..., None])


def quaternion_xyzw_from_matrix(rotation: ArrayLike) -> FloatArray:
    """Unit quaternions (..., 4), order xyzw, of rotation matrices (..., 3, 3)."""
    R = np.asarray(rotation, dtype=np.float64)
    m00, m11, m22 = R[..., 0, 0], R[..., 1, 1], R[..., 2, 2]
    # Four times the outer product of the quaternion with itself; its largest row loses no digits.
    rows = np.empty((*R.shape[:-2], 4, 4))
    rows[..., 0, 0], rows[..., 1, 1] = 1 + m00 - m11 - m22, 1 - m00 + m11 - m22
    rows[..., 2, 2], rows[..., 3, 3] = 1 - m00 - m11 + m22, 1 + m00 + m11 + m22
    rows[..., 0, 1] = rows[..., 1, 0] = R[..., 0, 1] + R[..., 1, 0]
    rows[..., 0, 2] = rows[..., 2, 0] = R[..., 0, 2] + R[..., 2, 0]
    rows[..., 1, 2] = rows[..., 2, 1] = R[..., 1, 2] + R[..., 2, 1]
    rows[..., 0, 3] = rows[..., 3, 0] = R[..., 2, 1] - R[..., 1, 2]
    rows[..., 1, 3] = rows[..., 3, 1] = R[..., 0, 2] - R[..., 2, 0]
    rows[..., 2, 3] = rows[..., 3, 2] = R[..., 1, 0] - R[..., 0, 1]
    best = np.argmax(np.diagonal(rows, axis1=-2, axis2=-1), axis=-1)
    row = np.take_along_axis(rows, best[..., None, None], axis=-2)[..., 0, :]
    return np.asarray(row / np.linalg.norm(row, axis=-1, keepdims=True))


def matrix_from_quaternion_xyzw(quaternion: ArrayLike) -> FloatArray:
    """Rotation matrices (..., 3, 3) of quaternions (..., 4), order xyzw, of any length but zero."""
    q = np.asarray(quaternion, dtype=np.float64)
    length = np.linalg.norm(q, axis=-1, keepdims=True)
    if not np.all(length > 0.0):
        raise ValueError("a quaternion of length zero is no rotation")
    q = q / length
    V = skew(q[..., :3])
    return np.asarray(np.eye(3) + 2.0 * q[..., 3, None, None] * V + 2.0 * (V @ V))


def nearest_rotation(matrix: ArrayLike) -> FloatArray:
    """The rotation matrix nearest to a 3x3 matrix in the Frobenius norm (SVD, guarded against reflection)."""
    U, _, Vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64))
    flip = np.ones((*U.shape[:-2], 3))
    flip[..., 2] = np.sign(np.linalg.det(U) * np.linalg.det(Vt))
    return np.asarray((U * flip[..., None, :]) @ Vt)


def rotation_z(angle_rad: ArrayLike) -> FloatArray:
    """Rz(angle): right-handed rotations (..., 3, 3) about z by angles (...)."""
    angle = np.asarray(angle_rad, dtype=np.float64)
    out = np.zeros((*angle.shape, 3, 3))
    out[..., 0, 0] = out[..., 1, 1] = np.cos(angle)
    out[..., 1, 0] = np.sin(angle)
    out[..., 0, 1] = -out[..., 1, 0]
    out[..., 2, 2] = 1.0
    return out


def _left_jacobian(w: FloatArray) -> FloatArray:
    _, b, c = _sine_terms(np.linalg.norm(w, axis=-1))
    W = skew(w)
    return np.asarray(np.eye(3) + b[..., None, None] * W + c[..., None, None] * (W @ W))


def exp_se3(twists: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Rotations (..., 3, 3) and translations (..., 3) of twists (..., 6) = (translation, rotation)."""
    xi = np.asarray(twists, dtype=np.float64)
    return exp_so3(xi[..., 3:]), (_left_jacobian(xi[..., 3:]) @ xi[..., :3, None])[..., 0]


def log_se3(rotation: FloatArray, translation: FloatArray) -> FloatArray:
    """The twists (..., 6) of motions given as rotations (..., 3, 3) and translations (..., 3)."""
    w = log_so3(rotation)
    return np.concatenate([np.linalg.solve(_left_jacobian(w), translation[..., None])[..., 0], w], axis=-1)


def _determinant(R: FloatArray) -> float:
    """Of a 3x3 matrix, without the detour through LAPACK."""
    (a, b, c), (d, e, f), (g, h, i) = R.tolist()
    return float(a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g))


@dataclass(frozen=True, eq=False)
class Pose:
    """A rigid motion ``T_parent_child``: ``p_parent = T @ p_child = R p + t``.

    Attributes
    ----------
    rotation : (3, 3)
        R, a proper rotation (checked to 1e-6, kept as given).
    translation : (3,)
        t in metres: the child's origin in the parent frame.

    Raises
    ------
    ValueError
        If shapes are wrong, a number is not finite, or R is not a proper rotation.
    """

    rotation: FloatArray
    translation: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "rotation", as_float_array(self.rotation, (3, 3), "rotation"))
        object.__setattr__(self, "translation", as_float_array(self.translation, (3,), "translation"))
        if not (np.isfinite(self.rotation).all() and np.isfinite(self.translation).all()):
            raise ValueError("a pose must be finite")
        error = np.abs(self.rotation @ self.rotation.T - _IDENTITY).max()
        if error > 1e-6 or _determinant(self.rotation) < 0.0:
            raise ValueError(f"not a proper rotation: R R^T differs from the identity by {error:.1e}")

    @staticmethod
    def _of_proper(rotation: FloatArray, translation: FloatArray) -> Pose:
        """A pose made of proper rotations, or of a finite turn: nothing to check, nothing to copy."""
        pose = object.__new__(Pose)
        rotation.setflags(write=False)
        translation.setflags(write=False)
        object.__setattr__(pose, "rotation", rotation)
        object.__setattr__(pose, "translation", translation)
        return pose

    @staticmethod
    def identity() -> Pose:
        return Pose(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> Pose:
        """A pose from a 4x4 matrix whose last row is 0 0 0 1."""
        m = as_float_array(matrix, (4, 4), "matrix")
        if np.abs(m[3] - [0, 0, 0, 1]).max() > 1e-9:
            raise ValueError("the last row of a 4x4 pose must be 0 0 0 1")
        return Pose(m[:3, :3], m[:3, 3])

    @staticmethod
    def from_quaternion_xyzw(quaternion: ArrayLike, translation: ArrayLike) -> Pose:
        return Pose(matrix_from_quaternion_xyzw(quaternion), np.asarray(translation))

    @staticmethod
    def exp(xi: ArrayLike) -> Pose:
        """The motion of a twist (6,) = (translation, rotation)."""
        twist = as_float_array(xi, (6,), "twist")
        if not np.isfinite(twist).all():
            raise ValueError("a pose must be finite")
        return Pose._of_proper(exp_so3(twist[3:]), _left_jacobian(twist[3:]) @ twist[:3])

    @staticmethod
    def rot_z(angle_rad: float) -> Pose:
        """A turn about z, as a turntable makes it."""
        if not math.isfinite(angle_rad):
            raise ValueError("a pose must be finite")
        return Pose._of_proper(rotation_z(angle_rad), np.zeros(3))

    def log(self) -> FloatArray:
        """The twist (6,) = (translation, rotation) whose ``exp`` this is; rotation at most half a turn."""
        w = log_so3(self.rotation)
        return np.concatenate([np.linalg.solve(_left_jacobian(w), self.translation), w])

    @property
    def matrix(self) -> FloatArray:
        m = np.eye(4)
        m[:3, :3], m[:3, 3] = self.rotation, self.translation
        return m

    @property
    def quaternion_xyzw(self) -> FloatArray:
        """Unit quaternion (4,) with w >= 0."""
        q = quaternion_xyzw_from_matrix(self.rotation)
        return -q if q[3] < 0.0 else q

    def inverse(self) -> Pose:
        back = np.ascontiguousarray(self.rotation.T)
        return Pose._of_proper(back, -(back @ self.translation))

    def adjoint(self) -> FloatArray:
        """Ad (6, 6): ``T @ Exp(xi) == Exp(Ad xi) @ T``."""
        Ad = np.zeros((6, 6))
        Ad[:3, :3] = Ad[3:, 3:] = self.rotation
        Ad[:3, 3:] = skew(self.translation) @ self.rotation
        return Ad

    def rotate(self, vectors: ArrayLike) -> FloatArray:
        """Directions (..., 3) from the child to the parent frame."""
        return np.asarray(np.asarray(vectors) @ self.rotation.T)

    @overload
    def __matmul__(self, other: Pose) -> Pose: ...
    @overload
    def __matmul__(self, other: ArrayLike) -> FloatArray: ...
    def __matmul__(self, other: Pose | ArrayLike) -> Pose | FloatArray:
        """``T_a_b @ T_b_c`` composes; ``T_a_b @ points_b`` maps points (..., 3)."""
        if isinstance(other, Pose):
            turned = self.rotation @ other.translation
            return Pose._of_proper(self.rotation @ other.rotation, turned + self.translation)
        return self.rotate(other) + self.translation

    def minus(self, reference: Pose) -> FloatArray:
        """The left perturbation (6,) xi with ``self = Exp(xi) @ reference``."""
        return (self @ reference.inverse()).log()

    def distance(self, other: Pose) -> tuple[float, float]:
        """Distance of the child's origins in metres, and the angle in radians between the orientations."""
        metres = float(np.linalg.norm(self.translation - other.translation))
        return metres, float(np.linalg.norm(log_so3(self.rotation @ other.rotation.T)))


@dataclass(frozen=True, eq=False)
class UncertainPose:
    """A pose with the covariance (6, 6) of its left perturbation, order (translation, rotation), m and rad."""

    pose: Pose
    covariance: FloatArray = field(default_factory=lambda: np.zeros((6, 6)))

    def __post_init__(self) -> None:
        covariance = as_float_array(self.covariance, (6, 6), "covariance")
        object.__setattr__(self, "covariance", covariance)

    def inverse(self) -> UncertainPose:
        inverse = self.pose.inverse()
        Ad = inverse.adjoint()
        return UncertainPose(inverse, Ad @ self.covariance @ Ad.T)

    def __matmul__(self, other: UncertainPose) -> UncertainPose:
        """Composition of two independent estimates (first order)."""
        Ad = self.pose.adjoint()
        return UncertainPose(self.pose @ other.pose, self.covariance + Ad @ other.covariance @ Ad.T)

    def centre_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the child's origin in the parent frame, m^2.

        The left perturbation moves the origin t by ``v + w x t``: not the upper left block alone.
        """
        J = np.hstack([np.eye(3), -skew(self.pose.translation)])
        return np.asarray(J @ self.covariance @ J.T)

    def rotation_covariance(self) -> FloatArray:
        """Covariance (3, 3) of the orientation, as a rotation vector in the parent frame, rad^2."""
        return self.covariance[3:, 3:]
