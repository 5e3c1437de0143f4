"""The LiDAR on its turntable: pose as a function of the reading.

``T_camera_lidar(angle) = T_camera_turntable @ Rz(angle) @ T_turntable_lidar``. The turntable's frame has z along the
axis, its origin at the foot of the LiDAR's centre, its x towards the LiDAR at reading 0; so ``T_turntable_lidar`` has
the translation (r, 0, 0), with r the radius of the centre's circle.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, rotation_z, skew

PARAMETER_NAMES = (
    "T_camera_turntable.tx_m",
    "T_camera_turntable.ty_m",
    "T_camera_turntable.tz_m",
    "T_camera_turntable.rx_rad",
    "T_camera_turntable.ry_rad",
    "T_camera_turntable.rz_rad",
    "radius_m",
    "T_turntable_lidar.rx_rad",
    "T_turntable_lidar.ry_rad",
    "T_turntable_lidar.rz_rad",
)
"""The ten numbers of a turntable motion, as small changes: the left perturbation of ``T_camera_turntable``, the
radius, and the left rotation of ``T_turntable_lidar`` with its translation held."""

Angles = TypeVar("Angles", float, FloatArray)

RADIUS_TO_TWIST = np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0])


@dataclass(frozen=True, eq=False)
class TurntableMotion:
    """The two constant transforms of a LiDAR on a turntable, in the fixed choice of frame.

    Raises
    ------
    ValueError
        If `T_turntable_lidar` has a translation other than (r, 0, 0) with r >= 0 (to a micrometre).

    Attributes
    ----------
    reading_scale, reading_origin_rad
        Of a turntable whose readings are off by a factor: it stands at origin + scale * (reading - origin). 1 and 0
        otherwise.
    """

    T_camera_turntable: Pose
    T_turntable_lidar: Pose
    reading_scale: float = 1.0
    reading_origin_rad: float = 0.0

    def __post_init__(self) -> None:
        x, y, z = self.T_turntable_lidar.translation
        if abs(y) > 1e-6 or abs(z) > 1e-6 or x < -1e-6:
            raise ValueError(
                f"T_turntable_lidar has the translation ({x:.6f}, {y:.6f}, {z:.6f}) m; "
                "the turntable's frame is chosen so that it is (r, 0, 0) with r >= 0"
            )

    @staticmethod
    def from_any_frame(T_camera_table: Pose, T_table_lidar: Pose) -> TurntableMotion:
        """The same motion in the fixed frame, from any turntable frame with z along the axis.

        Where the LiDAR's centre lies on the axis (closer than a nanometre) there is no x "towards the LiDAR"; then
        the LiDAR's own x axis (or y, if x is along the turntable's axis) gives the direction.
        """
        t = T_table_lidar.translation
        towards = t[:2]
        if np.linalg.norm(towards) < 1e-9:
            candidates = T_table_lidar.rotation[:2, :2].T
            towards = candidates[0] if np.linalg.norm(candidates[0]) > 0.1 else candidates[1]
        turn = Pose.rot_z(float(np.arctan2(towards[1], towards[0])))
        T_table_turntable = Pose(turn.rotation, np.array([0.0, 0.0, t[2]]))
        T_turntable_lidar = T_table_turntable.inverse() @ T_table_lidar
        radius = float(np.linalg.norm(t[:2]))
        exact = Pose(T_turntable_lidar.rotation, np.array([radius, 0.0, 0.0]))
        return TurntableMotion(T_camera_table @ T_table_turntable, exact)

    @property
    def radius_m(self) -> float:
        """Radius of the circle of the LiDAR's centre."""
        return float(self.T_turntable_lidar.translation[0])

    @property
    def axis_direction_camera(self) -> FloatArray:
        """Unit direction (3,) of the axis in the camera frame; the turntable turns right-handed about it."""
        return self.T_camera_turntable.rotation[:, 2]

    def true_angle(self, reading_rad: Angles) -> Angles:
        """Where the turntable stands at a reading, or at readings (N,)."""
        return self.reading_origin_rad + self.reading_scale * (reading_rad - self.reading_origin_rad)

    @property
    def in_true_angles(self) -> TurntableMotion:
        """The same motion as a function of where the turntable stands, not of what it reads."""
        return TurntableMotion(self.T_camera_turntable, self.T_turntable_lidar)

    def pose(self, turntable_angle_rad: float) -> Pose:
        """T_camera_lidar at a reading of the turntable."""
        turn = Pose.rot_z(self.true_angle(turntable_angle_rad))
        return self.T_camera_turntable @ turn @ self.T_turntable_lidar

    def pose_jacobian(self, turntable_angle_rad: float) -> FloatArray:
        """Derivative (6, 10) of the left perturbation of ``pose(angle)`` by `PARAMETER_NAMES`."""
        return np.asarray(self.pose_jacobians(np.array([turntable_angle_rad]))[0])

    def pose_jacobians(self, turntable_angle_rad: FloatArray) -> FloatArray:
        """The same (N, 6, 10) at readings (N,)."""
        t = self.T_turntable_lidar.translation
        mounting = np.zeros((6, 4))
        mounting[:, 0] = RADIUS_TO_TWIST
        # Turning the LiDAR about its own centre, not about the turntable's origin.
        mounting[:3, 1:] = skew(t)
        mounting[3:, 1:] = np.eye(3)
        R = self.T_camera_turntable.rotation @ rotation_z(self.true_angle(turntable_angle_rad))
        to_camera = np.zeros((len(R), 6, 6))
        to_camera[:, :3, :3] = to_camera[:, 3:, 3:] = R
        to_camera[:, :3, 3:] = skew(self.T_camera_turntable.translation) @ R
        out = np.empty((len(R), 6, 10))
        out[:, :, :6] = np.eye(6)
        out[:, :, 6:] = to_camera @ mounting
        return out

    def centres(self, turntable_angle_rad: FloatArray) -> FloatArray:
        """The LiDAR's centre (N, 3) in the camera frame at readings (N,)."""
        R = self.T_camera_turntable.rotation @ rotation_z(self.true_angle(turntable_angle_rad))
        return np.asarray(R @ self.T_turntable_lidar.translation + self.T_camera_turntable.translation)

    def pose_by_scale(self, turntable_angle_rad: float) -> FloatArray:
        """Derivative (6,) of the left perturbation of ``pose(angle)`` by `reading_scale`."""
        return self.T_camera_turntable.adjoint()[:, 5] * (turntable_angle_rad - self.reading_origin_rad)
