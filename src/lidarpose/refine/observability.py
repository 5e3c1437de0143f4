"""What the data determine well, what only weakly, and what to record to mend it; in mm and degrees."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import skew
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_result import Direction

_TURN = np.linspace(-np.pi, np.pi, 73)[:-1]


@dataclass(frozen=True, eq=False)
class PoseSpread:
    """Standard deviations of the LiDAR's pose at readings (M,): of its centre (m) and orientation (rad), all axes."""

    angles_rad: FloatArray
    position_m: FloatArray
    rotation_rad: FloatArray


def pose_spread(motion: TurntableMotion, covariance: FloatArray, angles_rad: FloatArray) -> PoseSpread:
    """The pose's standard deviations (root of the summed variances) from the covariance (10, 10) of the motion.

    An eleventh row and column are of the readings' scale.
    """
    J_centre, J_turn = _effects(motion, angles_rad, with_scale=len(covariance) > 10)
    position = np.einsum("mij,jk,mik->m", J_centre, covariance, J_centre)
    rotation = np.einsum("mij,jk,mik->m", J_turn, covariance, J_turn)
    return PoseSpread(angles_rad, np.sqrt(np.maximum(position, 0.0)), np.sqrt(np.maximum(rotation, 0.0)))


def whole_turn(middle_rad: float) -> FloatArray:
    """Readings (72,) all around, the first and the middle one being half a turn from, and at, `middle_rad`."""
    return np.asarray(middle_rad + _TURN)


def _effects(
    motion: TurntableMotion, angles_rad: FloatArray, *, with_scale: bool = False
) -> tuple[FloatArray, FloatArray]:
    """Derivatives (M, 3, 10) of the LiDAR's centre and of its orientation, in the camera frame.

    With the readings' scale as an eleventh number, (M, 3, 11).
    """
    J = motion.pose_jacobians(angles_rad)
    if with_scale:
        by_scale = np.array([motion.pose_by_scale(float(a)) for a in angles_rad])
        J = np.concatenate([J, by_scale[:, :, None]], axis=2)
    return J[:, :3] - skew(motion.centres(angles_rad)) @ J[:, 3:], J[:, 3:]


def weak_directions(
    motion: TurntableMotion, covariance: FloatArray, angles_rad: FloatArray, count: int = 4
) -> tuple[Direction, ...]:
    """The independent combinations of the ten numbers that spoil the pose most, worst first.

    Principal axes of the motion's covariance in the metric of the pose's error over a whole turn, where 1 mm weighs as
    much as 0.1 degrees. `angles_rad` are the recorded readings.
    """
    middle = 0.5 * float(angles_rad.min() + angles_rad.max())
    turn = whole_turn(middle)
    J_centre, J_turn = _effects(motion, turn)
    metric = np.einsum("mij,mik->jk", J_centre, J_centre) / 1e-3**2
    metric += np.einsum("mij,mik->jk", J_turn, J_turn) / np.deg2rad(0.1) ** 2
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    _, principal = np.linalg.eigh(root.T @ metric @ root)
    moves = (root @ principal)[:, ::-1][:, :count]
    return tuple(
        _describe(motion, moves[:, k], turn, J_centre, J_turn, middle, angles_rad) for k in range(moves.shape[1])
    )


def _describe(
    motion: TurntableMotion,
    move: FloatArray,
    turn: FloatArray,
    J_centre: FloatArray,
    J_turn: FloatArray,
    middle: float,
    angles_rad: FloatArray,
) -> Direction:
    millimetres = 1e3 * np.linalg.norm(J_centre @ move, axis=1)
    degrees = np.rad2deg(np.linalg.norm(J_turn @ move, axis=1))
    worst = int(np.argmax(millimetres + 10.0 * degrees))
    here = int(np.argmin(np.abs(turn - middle)))
    size = millimetres + 10.0 * degrees
    if size[here] < 0.5 * size[worst]:
        name, remedy = _axis_direction(millimetres[worst], degrees[worst], angles_rad)
    else:
        R = motion.pose(middle).rotation
        name, remedy = _lidar_direction(R.T @ (J_centre[here] @ move) * 1e3, np.rad2deg(R.T @ (J_turn[here] @ move)))
    return Direction(
        name,
        float(millimetres[worst]),
        float(degrees[worst]),
        float(np.rad2deg(turn[worst])),
        tuple(float(v) for v in move),
        remedy,
    )


def _axis_direction(millimetres: float, degrees: float, angles_rad: FloatArray) -> tuple[str, str]:
    arc = float(np.rad2deg(np.ptp(angles_rad)))
    remedy = f"Record a longer arc than {arc:.1f} degrees, if need be with further placements of the board."
    if millimetres > 10.0 * degrees:
        return "the place of the turntable's axis (radius)", remedy
    return "the tilt of the turntable's axis", remedy


def _lidar_direction(shift_mm: FloatArray, turn_deg: FloatArray) -> tuple[str, str]:
    """Of the LiDAR at the middle of the arc: which of its own axes is concerned most."""
    axes = ("x", "y", "z")
    if np.linalg.norm(shift_mm) > 10.0 * np.linalg.norm(turn_deg):
        which = axes[int(np.argmax(np.abs(shift_mm)))]
        name = f"the LiDAR's position along its own {which}"
    else:
        which = axes[int(np.argmax(np.abs(turn_deg)))]
        name = f"the LiDAR's turn about its own {which}"
    if which == "z":
        remedy = "Record more ranges: more places, several sweeps a place, or another placement of the board."
    else:
        remedy = (
            "Let the scan cross more of the board: another placement, the board nearer or more strongly folded, "
            "or the LiDAR off the plane that halves the board's angle."
        )
    return name, remedy
