"""From poses at single readings to the turntable's motion, and one point-on-plane estimate of the whole motion."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from benchmarks.peers.plane_views import Constraints, PlaneView, pose_jacobian_columns
from lidarpose.geometry.arrays import FloatArray, perpendicular_pair, unit
from lidarpose.geometry.se3 import Pose, exp_so3, log_so3, nearest_rotation
from lidarpose.model.turntable import TurntableMotion


def circle_of_poses(angles: Sequence[float], poses: Sequence[Pose]) -> TurntableMotion:
    """A circle through the centres and averaged rotations.

    The axis is the mean of the rotation vectors between all pairs, each as long as its turn; the LiDAR's orientation
    the chordal mean (Hartley, Trumpf, Dai and Li, "Rotation averaging", IJCV 2013); the circle of the centres, in the
    plane across the axis, Kasa's algebraic fit (1976).
    """
    reading = np.asarray(angles, dtype=np.float64)
    R = np.stack([p.rotation for p in poses])
    i, j = np.triu_indices(len(R), 1)
    vectors = log_so3(R[j] @ np.swapaxes(R[i], -1, -2))
    axis = unit((np.sign(reading[j] - reading[i])[:, None] * vectors).sum(axis=0))
    back = exp_so3(-reading[:, None] * axis)
    first = nearest_rotation((back @ R).sum(axis=0))
    u, v = perpendicular_pair(axis)
    frame = np.column_stack([u, v, axis])
    centres = np.stack([p.translation for p in poses]) @ frame
    x, y = centres[:, 0], centres[:, 1]
    a, b, _ = np.linalg.lstsq(np.column_stack([2 * x, 2 * y, np.ones_like(x)]), x**2 + y**2, rcond=None)[0]
    radius = float(np.sqrt(((x - a) ** 2 + (y - b) ** 2).mean()))
    origin = frame @ [a, b, centres[:, 2].mean()]
    arms = np.einsum("nij,nj->ni", back, np.stack([p.translation for p in poses]) - origin)
    arm = radius * unit(arms.mean(axis=0))
    T_camera_table = Pose(frame, origin)
    return TurntableMotion.from_any_frame(T_camera_table, T_camera_table.inverse() @ Pose(first, origin + arm))


def points_on_planes(views: Mapping[float, Sequence[PlaneView]], start: TurntableMotion) -> TurntableMotion:
    """Zhang and Pless's cost over the ten numbers of the motion, all readings at once, by Gauss-Newton."""
    stacked = {reading: Constraints.of(v) for reading, v in views.items()}
    motion = start
    for _ in range(20):
        H: FloatArray = np.zeros((10, 10))
        g: FloatArray = np.zeros(10)
        for reading, constraints in stacked.items():
            pose = motion.pose(reading)
            J = constraints.jacobian(pose.rotation, pose.translation) @ pose_jacobian_columns(pose.translation)
            J = J @ motion.pose_jacobian(reading)
            H += J.T @ J
            g += J.T @ constraints.residuals(pose.rotation, pose.translation)
        step = -np.linalg.solve(H + 1e-12 * np.diag(np.diag(H)), g)
        motion = stepped(motion, step)
        if np.abs(step).max() < 1e-10:
            break
    return motion


def stepped(motion: TurntableMotion, step: FloatArray) -> TurntableMotion:
    """The motion after a small change of its ten numbers (`lidarpose.model.turntable.PARAMETER_NAMES`)."""
    table = Pose.exp(step[:6]) @ motion.T_camera_turntable
    mount = motion.T_turntable_lidar
    turned = nearest_rotation(exp_so3(step[7:]) @ mount.rotation)
    lidar = Pose(turned, mount.translation + np.array([step[6], 0.0, 0.0]))
    return TurntableMotion.from_any_frame(Pose(nearest_rotation(table.rotation), table.translation), lidar)
