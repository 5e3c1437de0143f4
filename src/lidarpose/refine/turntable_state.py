"""Where the estimate of a turntable session stands: the LiDAR's motion, the panels' poses and the extra parameters.

Inside, the motion is ``T_camera_lidar(reading) = G Rz(reading - reference) G^-1 T_reference``: the LiDAR's pose at a
reading amid the data (6 numbers) and the axis as a line (2 shifts, 2 tilts of the frame G that has it as its z).
Nothing in it is singular where the LiDAR's centre lies on the axis, and on a short arc the first six are well
determined whatever the axis is. `JointState.to_motion` and `motion_map` lead to the fixed frames.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, nearest_rotation, skew
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine.turntable_layout import JointData
from lidarpose.refine.turntable_parameters import EXTRAS, N_GLOBAL, N_MOTION


@dataclass(frozen=True, eq=False)
class JointState:
    """Where the estimate stands."""

    T_camera_lidar: Pose
    T_camera_axis: Pose
    panels: tuple[Pose, ...]
    extras: FloatArray

    def turned(self, angles_rad: FloatArray, reference_rad: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations (M, 3, 3) and centres (M, 3) of the LiDAR at readings (M,), and derivatives (M, 6, 11).

        The derivatives are of the left perturbation in the camera frame, by the ten numbers and the encoder's scale.
        """
        delta = (1.0 + self.extras[0]) * (angles_rad - reference_rad)
        G, T = self.T_camera_axis, self.T_camera_lidar
        c, s = np.cos(delta), np.sin(delta)
        turn = np.zeros((len(delta), 3, 3))
        turn[:, 0, 0] = turn[:, 1, 1] = c
        turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = -s, s, 1.0
        R_move = G.rotation @ turn @ G.rotation.T
        t_move = G.translation - R_move @ G.translation
        moved = np.zeros((len(delta), 6, 6))
        moved[:, :3, :3] = moved[:, 3:, 3:] = R_move
        moved[:, :3, 3:] = skew(t_move) @ R_move
        axis = G.adjoint()
        J = np.empty((len(delta), 6, 11))
        J[:, :, :6] = moved
        J[:, :, 6:10] = (np.eye(6) - moved) @ axis[:, [0, 1, 3, 4]]
        J[:, :, 10] = (angles_rad - reference_rad)[:, None] * axis[:, 5]
        return R_move @ T.rotation, R_move @ T.translation + t_move, J

    def moved(self, step: FloatArray, centres: FloatArray) -> JointState:
        """The state after a step (N_GLOBAL + 6 * panels,)."""
        axis_step = np.zeros(6)
        axis_step[[0, 1, 3, 4]] = step[6:10]
        panels = []
        for k, pose in enumerate(self.panels):
            to_centre = Pose(np.eye(3), centres[k])
            at = step[N_GLOBAL + 6 * k : N_GLOBAL + 6 * k + 6]
            panels.append(_tidy(pose @ to_centre @ Pose.exp(at) @ to_centre.inverse()))
        return JointState(
            _tidy(Pose.exp(step[:6]) @ self.T_camera_lidar),
            _tidy(self.T_camera_axis @ Pose.exp(axis_step)),
            tuple(panels),
            self.extras + step[N_MOTION:N_GLOBAL],
        )

    def to_motion(self, reference_rad: float) -> TurntableMotion:
        """The motion in the fixed frames, with the encoder's scale about the reference reading."""
        G = self.T_camera_axis
        motion = regular_motion(G, Pose.rot_z(-reference_rad) @ G.inverse() @ self.T_camera_lidar)
        if self.extras[0] == 0.0:
            return motion
        return replace(motion, reading_scale=1.0 + float(self.extras[0]), reading_origin_rad=reference_rad)


def _tidy(pose: Pose) -> Pose:
    """The same pose with its rotation orthogonal to rounding, so that many steps do not add up."""
    return Pose(nearest_rotation(pose.rotation), pose.translation)


SMALLEST_RADIUS_M = 1e-5


def regular_motion(T_camera_table: Pose, T_table_lidar: Pose) -> TurntableMotion:
    """`TurntableMotion.from_any_frame`, with the radius kept from vanishing.

    In the fixed frame a centre that lies on the axis cannot move sideways, so that the covariance of its position
    would be lost. A centre closer to the axis than 0.01 mm is therefore put at 0.01 mm, on the side of its own
    x axis (of its y axis where x is along the turntable's axis): far below what anybody can measure.
    """
    x, y, z = T_table_lidar.translation
    if np.hypot(x, y) < SMALLEST_RADIUS_M:
        candidates = T_table_lidar.rotation[:2, :2].T
        side = candidates[0] if np.linalg.norm(candidates[0]) > 0.1 else candidates[1]
        x, y = SMALLEST_RADIUS_M * side / np.linalg.norm(side)
        T_table_lidar = Pose(T_table_lidar.rotation, np.array([x, y, z]))
    return TurntableMotion.from_any_frame(T_camera_table, T_table_lidar)


def start_state(data: JointData, motion: TurntableMotion, panels: Mapping[str, tuple[Pose | None, ...]]) -> JointState:
    """The state of a start in the fixed frames. Raises ValueError where a needed panel has no pose."""
    poses = []
    for slot in data.slots:
        of_placement = panels.get(slot.placement, ())
        pose = of_placement[slot.panel] if slot.panel < len(of_placement) else None
        if pose is None:
            raise ValueError(f"no start pose for panel {slot.panel} of placement {slot.placement!r}")
        poses.append(pose)
    at = motion.T_camera_turntable @ Pose.rot_z(data.reference_rad)
    return JointState(motion.pose(data.reference_rad), at, tuple(poses), np.zeros(len(EXTRAS)))


def motion_map(state: JointState, motion: TurntableMotion, reference_rad: float) -> FloatArray:
    """Derivative (10, 10) of `PARAMETER_NAMES` by the internal ten numbers; the encoder's scale is the same in both.

    Both describe the same poses, so it follows from the poses' derivatives at three readings.
    """
    readings = reference_rad + np.array([-2.1, 0.0, 2.1]) / (1.0 + state.extras[0])
    _, _, J_inside = state.turned(readings, reference_rad)
    J_outside = np.concatenate([motion.pose_jacobian(float(reading)) for reading in readings])
    return np.asarray(np.linalg.lstsq(J_outside, np.concatenate(list(J_inside[:, :, :10])), rcond=None)[0])
