"""From poses at single places to one function of the turntable's reading (turntable paper, section 2).

Two ways of the same section. `fit_by_circles` is the paper to the letter: the axis from the circle of a unit vector's
tip (16), the circle of centres (15), phases and the quadratic's solution (25). `fit_by_readings` uses what the paper
leaves aside: the readings are known, so the rotations alone give the axis, and the circle's centre and radius follow
from linear equations. It has neither the bias of a circle fit to a short arc, nor the trouble of unsigned angles past
half a turn, nor does it need a circle that is more than a point.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, angle_between, perpendicular_pair, unit, wrap_angle
from lidarpose.geometry.circles import fit_circle3
from lidarpose.geometry.planes import fit_plane
from lidarpose.geometry.robust import tukey_weights
from lidarpose.geometry.se3 import Pose, exp_se3, exp_so3, log_so3, nearest_rotation, rotation_z, skew
from lidarpose.model.turntable import TurntableMotion

# Readings closer than this are one and the same place (a thousandth of a degree).
SAME_READING_RAD = 2e-5
PAIRS = 40
# A circle on the unit sphere smaller than this shows neither its plane nor its phase.
SMALL_CIRCLE = 0.05
# What a pose is known from splits in two, nearly independent of each other: the light plane, and the two lines in it.
ACROSS_SCAN_PLANE = [2, 3, 4]
IN_SCAN_PLANE = [0, 1, 5]
# Below this (of a stated sigma, or in metres and radians) residuals are rounding.
LEAST_SCALE = 1e-7


@dataclass(frozen=True, eq=False)
class FunctionDeviations:
    """How far the function passes from the samples that it was fitted to: the paper's Table 1, not an error.

    Attributes
    ----------
    centre_m, z_rad, x_rad : (N,)
        Distance of the LiDAR's centre, angles of its z and x axes, sample by sample.
    """

    centre_m: FloatArray
    z_rad: FloatArray
    x_rad: FloatArray

    def table(self) -> dict[str, float]:
        """The six numbers of Table 1 in its units."""
        return {
            "centre_mean_mm": float(self.centre_m.mean() * 1e3),
            "centre_max_mm": float(self.centre_m.max() * 1e3),
            "z_mean_deg": float(np.rad2deg(self.z_rad.mean())),
            "z_max_deg": float(np.rad2deg(self.z_rad.max())),
            "x_mean_deg": float(np.rad2deg(self.x_rad.mean())),
            "x_max_deg": float(np.rad2deg(self.x_rad.max())),
        }


@dataclass(frozen=True, eq=False)
class TurntableFunction:
    """A turning motion fitted to samples, and which of them support it.

    Attributes
    ----------
    motion
    inliers : (N,)
    deviations
        Of all samples, inliers or not.
    """

    motion: TurntableMotion
    inliers: BoolArray
    deviations: FunctionDeviations


def deviations(
    motion: TurntableMotion, turntable_angles_rad: Sequence[float], poses: Sequence[Pose]
) -> FunctionDeviations:
    """Deviations of a motion from samples of it (Table 1)."""
    readings = np.asarray(turntable_angles_rad, dtype=np.float64)
    turned = motion.T_camera_turntable.rotation @ rotation_z(readings)
    centres = turned @ motion.T_turntable_lidar.translation + motion.T_camera_turntable.translation
    axes = turned @ motion.T_turntable_lidar.rotation
    R = np.stack([p.rotation for p in poses])
    return FunctionDeviations(
        np.linalg.norm(centres - np.stack([p.translation for p in poses]), axis=1),
        np.asarray(angle_between(axes[:, :, 2], R[:, :, 2])),
        np.asarray(angle_between(axes[:, :, 0], R[:, :, 0])),
    )


def angles_shown(motion: TurntableMotion, turntable_angles_rad: Sequence[float], poses: Sequence[Pose]) -> FloatArray:
    """The turntable's angle (N,) that each pose shows by its turn about the axis, the one nearest to its reading."""
    readings = np.asarray(turntable_angles_rad, dtype=np.float64)
    R_w, R_m = motion.T_camera_turntable.rotation, motion.T_turntable_lidar.rotation
    turned = R_w.T @ np.stack([p.rotation for p in poses]) @ R_m.T
    shown = np.arctan2(turned[:, 1, 0] - turned[:, 0, 1], turned[:, 0, 0] + turned[:, 1, 1])
    return np.asarray(readings + wrap_angle(shown - readings))


def fit_by_readings(
    turntable_angles_rad: Sequence[float],
    poses: Sequence[Pose],
    covariances: Sequence[FloatArray] | None = None,
    *,
    start: TurntableMotion | None = None,
    most_reweighed: int = 25,
) -> TurntableFunction:
    """The motion that fits the poses best, from the known readings; robust against single bad poses.

    A growing reading turns right-handed about z of the turntable's frame: that alone fixes the axis' sense.

    Parameters
    ----------
    turntable_angles_rad, poses
        N >= 3 readings with T_camera_lidar (or the pose of any body that turns with the table).
    covariances : N times (6, 6), optional
        Of the poses' left perturbations. Only their shape counts: how well the pose is known along its own z and
        in its own x-y plane is rescaled to what the residuals show. Without them translations count alike in all
        directions, and so do rotations.
    start
        A motion to start from, where one is known.
    most_reweighed
        Weights are settled after so many steps, or for ever.

    Raises
    ------
    UndeterminedError
        If there are fewer than three different readings, or the readings differ only by whole turns.
    """
    angles = np.asarray(turntable_angles_rad, dtype=np.float64)
    require_readings(angles)
    R = np.stack([p.rotation for p in poses])
    t = np.stack([p.translation for p in poses])
    if start is None:
        factors = _start_from_pairs(angles, R, t)
    else:
        T_w, T_m = start.T_camera_turntable, start.T_turntable_lidar
        factors = np.stack([T_w.rotation, T_m.rotation]), np.stack([T_w.translation, T_m.translation])
    residuals = _residuals(angles, R, t, factors)
    information = _information(poses, covariances, residuals)
    floor = LEAST_SCALE if covariances is None else 1.0
    weight: FloatArray = np.ones(len(angles))
    scaled = information
    for k in range(most_reweighed):
        previous = weight
        # Lenient at first: the start rests on two places, and the others lie off it by more than their noise.
        lenience = max(1.0, 16.0 / 2.0**k)
        scaled, weight = _reweigh(residuals, information, floor, lenience)
        factors, _ = _step(angles, residuals, scaled * weight[:, None, None], factors)
        residuals = _residuals(angles, R, t, factors)
        if lenience == 1.0 and np.abs(weight - previous).max() < 1e-3:
            break
    for _ in range(10):
        factors, length = _step(angles, residuals, scaled * weight[:, None, None], factors)
        if length < 1e-12:
            break
        residuals = _residuals(angles, R, t, factors)
    T_w, T_m = (Pose(rotation, shift) for rotation, shift in zip(nearest_rotation(factors[0]), factors[1], strict=True))
    motion = TurntableMotion.from_any_frame(T_w, T_m)
    return TurntableFunction(motion, np.asarray(weight > 0.0), deviations(motion, list(angles), poses))


def fit_by_circles(turntable_angles_rad: Sequence[float], poses: Sequence[Pose]) -> TurntableFunction:
    """The paper's section 2 to the letter, as far as it holds: for comparison, and where no reading can be trusted.

    Where the circle of n_z is too small to tell its plane (the scan plane perpendicular to the axis), the circle of
    n_x takes its place. Angles are signed and unwrapped by the readings, so that arcs beyond half a turn are right.

    Raises
    ------
    UndeterminedError
        As `fit_by_readings`.
    """
    angles = np.asarray(turntable_angles_rad, dtype=np.float64)
    require_readings(angles)
    n_x = np.stack([p.rotation[:, 0] for p in poses])
    n_z = np.stack([p.rotation[:, 2] for p in poses])
    centres = np.stack([p.translation for p in poses])
    widest = n_z if _circle_size(n_z) > SMALL_CIRCLE else max((n_z, n_x), key=_circle_size)
    axis = _turning_sense(fit_plane(widest).normal, angles, widest)  # (16): the plane of the circle
    centre, arm = _circle_function(axis, angles, centres)  # (15), (18) to (21)
    R_first = _axes_function(axis, angles, n_z, n_x)  # (22) to (26), at reading 0
    T_w = _frame_about(axis, centre)
    T_m = T_w.inverse() @ Pose(R_first, centre + arm)
    motion = TurntableMotion.from_any_frame(T_w, T_m)
    return TurntableFunction(motion, np.ones(len(angles), dtype=bool), deviations(motion, list(angles), poses))


def require_readings(angles: FloatArray) -> None:
    """Raise UndeterminedError unless there are three different readings that are not whole turns apart."""
    turned = np.sort(angles)
    different = 1 + int(np.count_nonzero(np.diff(turned) > SAME_READING_RAD)) if len(turned) else 0
    if different < 3:
        raise UndeterminedError(
            f"The turntable's motion needs places at three or more different readings; {different} can be used",
            remedy="Record more places, a few degrees apart, with the stripe on both panels",
        )
    if np.abs(np.sin((angles - angles[0]) / 2.0)).max() < SAME_READING_RAD:
        raise UndeterminedError(
            "All readings are whole turns apart, so the LiDAR has always stood in the same place",
            remedy="Record places at different angles of the turntable",
        )


# --- by the readings ---------------------------------------------------------------------------------------------


_Factors = tuple[FloatArray, FloatArray]
"""Rotations (2, 3, 3) and translations (2, 3) of T_w and T_m, in ``T_w @ Rz(reading) @ T_m``."""


def _start_from_pairs(angles: FloatArray, R: FloatArray, t: FloatArray) -> _Factors:
    """The motion of the pair of places that most places agree with (least median)."""
    pairs = np.array(wide_pairs(angles))
    motions = motions_of_pairs(angles[pairs], R[pairs], t[pairs])
    e = motions.residuals(angles, R, t)
    # A radian counts as a metre: scores are only compared among the pairs of one session.
    best = int(np.argmin(np.median((e * e).sum(axis=2), axis=1)))
    return np.stack([motions.R_w[best], motions.R_m[best]]), np.stack([motions.t_w[best], motions.t_m[best]])


@dataclass(frozen=True, eq=False)
class Motions:
    """Turning motions ``T_w @ Rz(reading) @ T_m``: rotations (M, 3, 3) and translations (M, 3) of both factors."""

    R_w: FloatArray
    t_w: FloatArray
    R_m: FloatArray
    t_m: FloatArray

    @staticmethod
    def of(motion: TurntableMotion) -> Motions:
        """A single one."""
        T_w, T_m = motion.T_camera_turntable, motion.T_turntable_lidar
        return Motions(*(array[None] for array in (T_w.rotation, T_w.translation, T_m.rotation, T_m.translation)))

    def one(self, k: int) -> tuple[Pose, Pose]:
        return Pose(self.R_w[k], self.t_w[k]), Pose(self.R_m[k], self.t_m[k])

    def residuals(self, angles: FloatArray, R: FloatArray, t: FloatArray) -> FloatArray:
        """Residuals (M, N, 6) of N poses from each motion in the LiDAR's own frame: translation, rotation."""
        turned = self.R_w[:, None] @ rotation_z(angles)
        back = np.swapaxes(turned @ self.R_m[:, None], -1, -2)
        shift = t - ((turned @ self.t_m[:, None, :, None])[..., 0] + self.t_w[:, None])
        return np.concatenate([(back @ shift[..., None])[..., 0], log_so3(back @ R)], axis=2)


def motions_of_pairs(angles: FloatArray, R: FloatArray, t: FloatArray) -> Motions:
    """The turning motions through two poses each: readings (M, 2), `R` (M, 2, 3, 3), `t` (M, 2, 3).

    The axis is that of the turn from one rotation to the other, with the sense that the readings give; at half a turn
    the sense cannot be seen from two rotations, and then it is either.
    """
    vector = log_so3(R[:, 1] @ np.swapaxes(R[:, 0], 1, 2))
    folded = (angles[:, 1] - angles[:, 0] + np.pi) % (2.0 * np.pi) - np.pi
    length = np.linalg.norm(vector, axis=1)
    signed = np.where(folded >= 0.0, 1.0, -1.0) / np.where(length > 0.0, length, 1.0)
    R_w = _frames_about(np.where(length[:, None] > 0.0, signed[:, None] * vector, [0.0, 0.0, 1.0]))
    turns = R_w[:, None] @ rotation_z(angles)
    R_m = (np.swapaxes(turns, -1, -2) @ R).sum(axis=1)
    # t_i = point + turned arm, the arm along x and y of the turntable's frame.
    rows = np.concatenate([np.broadcast_to(np.eye(3), turns.shape), turns[..., :2]], axis=-1).reshape(-1, 6, 5)
    mean = t.mean(axis=1)
    solution = (np.linalg.pinv(rows, rcond=1e-12) @ (t - mean[:, None]).reshape(-1, 6, 1))[..., 0]
    arm = np.concatenate([solution[:, 3:], np.zeros((len(solution), 1))], axis=1)
    return Motions(R_w, solution[:, :3] + mean, nearest_rotation(R_m), arm)


def _frames_about(axis: FloatArray) -> FloatArray:
    """Rotations (M, 3, 3) whose third column is the unit axis (M, 3)."""
    helper = np.eye(3)[np.argmin(np.abs(axis), axis=1)]
    u = unit(np.cross(helper, axis))
    return np.stack([u, np.cross(axis, u), axis], axis=2)


def wide_pairs(angles: FloatArray, most: int = PAIRS) -> list[tuple[int, int]]:
    """Pairs of places, those first whose turn shows the axis best, spread over all places."""
    i, j = np.triu_indices(len(angles), 1)
    # Best is a right angle; short turns and nearly whole ones show little, half a turn hides its sense.
    use = np.abs(np.sin(angles[j] - angles[i])) + 0.2 * np.abs(np.sin((angles[j] - angles[i]) / 2.0))
    order = np.argsort(-use, kind="stable")[: max(most, len(use) // 4)]
    order = order[use[order] > 0.05 * use[order[0]]]
    chosen = order[:: max(1, len(order) // most)][:most]
    return [(int(i[k]), int(j[k])) for k in chosen]


def _residuals(angles: FloatArray, R: FloatArray, t: FloatArray, factors: _Factors) -> FloatArray:
    """Residuals (N, 6) of poses in the LiDAR's own frame: translation, rotation."""
    (R_w, R_m), (t_w, t_m) = factors
    turned = R_w @ rotation_z(angles)
    back = np.swapaxes(turned @ R_m, -1, -2)
    shift = t - (turned @ t_m + t_w)
    return np.concatenate([(back @ shift[..., None])[..., 0], log_so3(back @ R)], axis=1)


def _information(poses: Sequence[Pose], covariances: Sequence[FloatArray] | None, residuals: FloatArray) -> FloatArray:
    """Information (N, 6, 6) of each pose in the LiDAR's own frame."""
    if covariances is None:
        # A length of three normal components has the median 1.538 sigma.
        sigma_t = max(float(np.median(np.linalg.norm(residuals[:, :3], axis=1))) / 1.538, LEAST_SCALE)
        sigma_r = max(float(np.median(np.linalg.norm(residuals[:, 3:], axis=1))) / 1.538, LEAST_SCALE)
        diagonal = np.diag([sigma_t**-2] * 3 + [sigma_r**-2] * 3)
        return np.broadcast_to(diagonal, (len(poses), 6, 6))
    return information_in_own_frame(poses, covariances)


def information_in_own_frame(poses: Sequence[Pose], covariances: Sequence[FloatArray]) -> FloatArray:
    """Information (N, 6, 6) of poses in their own (the child's) frame, from covariances of left perturbations."""
    R = np.stack([p.rotation for p in poses])
    t = np.stack([p.translation for p in poses])
    # The inverse of Ad(T^-1) is Ad(T), so that no matrix but the covariance is inverted.
    Ad = np.zeros((len(R), 6, 6))
    Ad[:, :3, :3] = Ad[:, 3:, 3:] = R
    Ad[:, :3, 3:] = skew(t) @ R
    return np.asarray(Ad.swapaxes(1, 2) @ np.linalg.inv(np.stack(covariances)) @ Ad)


def _reweigh(
    residuals: FloatArray, information: FloatArray, floor: float, lenience: float
) -> tuple[FloatArray, FloatArray]:
    """Information with the scales that the residuals show (`floor` at least), and Tukey's weight (N,) of each place."""
    scale = np.ones(6)
    for block in (ACROSS_SCAN_PLANE, IN_SCAN_PLANE):
        e = residuals[:, block]
        squares = np.einsum("na,nab,nb->n", e, information[:, block][:, :, block], e)
        # The median of chi-squared with three degrees of freedom is 2.366.
        scale[block] = max(np.sqrt(float(np.median(squares)) / 2.366), floor)
    scaled = information / np.outer(scale, scale)
    squares = np.einsum("na,nab,nb->n", residuals, scaled, residuals)
    return scaled, tukey_weights(np.sqrt(squares / 6.0) / lenience, 3.5)


def _step(
    angles: FloatArray, residuals: FloatArray, information: FloatArray, factors: _Factors
) -> tuple[_Factors, float]:
    """A step of weighted least squares of T_i = T_w @ Rz(angle_i) @ T_m, by Gauss and Newton on left perturbations of
    both factors; and its length."""
    J = _motion_jacobian(angles, factors)
    weighted = (information @ J).reshape(-1, 12).T
    H, g = weighted @ J.reshape(-1, 12), weighted @ residuals.ravel()
    # The turn about z and the shift along it may be put into either factor: the smallest step leaves it alone.
    root = 1.0 / np.sqrt(np.maximum(np.diag(H), 1e-300))
    step = root * np.linalg.lstsq(H * np.outer(root, root), g * root, rcond=1e-11)[0]
    R, t = exp_se3(step.reshape(2, 6))
    rotation, translation = factors
    return (R @ rotation, (R @ translation[..., None])[..., 0] + t), float(np.abs(step).max())


def _motion_jacobian(angles: FloatArray, factors: _Factors) -> FloatArray:
    """Derivative (N, 6, 12) of each modelled pose, in the LiDAR's own frame, by left perturbations of both factors."""
    (R_w, R_m), (t_w, t_m) = factors
    turned = R_w @ rotation_z(angles)
    back = np.swapaxes(turned @ R_m, -1, -2)
    places = turned @ t_m + t_w
    J = np.zeros((len(angles), 6, 12))
    J[:, :3, :3] = J[:, 3:, 3:6] = back
    J[:, :3, 3:6] = -back @ skew(places)
    J[:, :3, 6:9] = J[:, 3:, 9:] = R_m.T
    J[:, :3, 9:] = -R_m.T @ skew(t_m)
    return J


def _frame_about(axis: FloatArray, origin: FloatArray) -> Pose:
    u, v = perpendicular_pair(axis)
    return Pose(np.column_stack([u, v, unit(axis)]), origin)


# --- by circles, the paper's way ---------------------------------------------------------------------------------


def _circle_size(tips: FloatArray) -> float:
    """How far the tips (N, 3) of a unit vector move: the radius of their circle at least, rad."""
    return float(np.linalg.norm(tips - tips.mean(axis=0), axis=1).max())


def _turning_sense(axis: FloatArray, angles: FloatArray, tips: FloatArray) -> FloatArray:
    """The axis (3,) turned so that the tips move right-handed about it as the reading grows."""
    moved = tips - tips.mean(axis=0)
    best = max((axis, -axis), key=lambda w: _coherence(w, angles, moved))
    return np.asarray(best)


def _coherence(axis: FloatArray, angles: FloatArray, vectors: FloatArray) -> float:
    """How well vectors (N, 3) line up once each is turned back by its reading about the axis."""
    return float(np.linalg.norm(np.einsum("nij,nj->i", exp_so3(-angles[:, None] * axis), vectors)))


def _phase(axis: FloatArray, angles: FloatArray, vectors: FloatArray) -> FloatArray:
    """Unit direction (3,) at reading 0 of vectors (N, 3) that turn with the table.

    The mean of signed phases of (19) and (22), taken on the circle: unsigned angles would break past half a turn.
    """
    flat = vectors - (vectors @ axis)[:, None] * axis
    back = np.einsum("nij,nj->ni", exp_so3(-angles[:, None] * axis), flat)
    length = np.linalg.norm(back, axis=1, keepdims=True)
    if not np.all(length > 0.0):
        return np.zeros(3)
    total = (back / length).sum(axis=0)
    return np.asarray(unit(total)) if np.linalg.norm(total) > 0.0 else np.zeros(3)


def _circle_function(axis: FloatArray, angles: FloatArray, centres: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Centre G of the circle of centres, and the arm from it at reading 0."""
    try:
        circle = fit_circle3(centres, axis)
    except ValueError:  # the LiDAR's centre lies on the axis
        return centres.mean(axis=0), np.zeros(3)
    return circle.centre, circle.radius * _phase(axis, angles, centres - circle.centre)


def _axes_function(axis: FloatArray, angles: FloatArray, n_z: FloatArray, n_x: FloatArray) -> FloatArray:
    """Rotation (3, 3) of the LiDAR at reading 0: n_z from its circle, n_x from the conditions (25)."""
    d_z, d_x = float((n_z @ axis).mean()), float((n_x @ axis).mean())
    z_0 = d_z * axis + np.sqrt(max(0.0, 1.0 - d_z**2)) * _phase(axis, angles, n_z)
    z_0 = unit(z_0)
    mean_x = unit(np.einsum("nij,nj->i", exp_so3(-angles[:, None] * axis), n_x))
    across = np.cross(axis, z_0)
    if np.linalg.norm(across) < SMALL_CIRCLE:  # n_z along the axis: (25) is singular, n_x has a circle of its own
        x_0 = unit(mean_x - (mean_x @ z_0) * z_0)
    else:
        in_both = np.linalg.solve(np.stack([axis, z_0, across]), [d_x, 0.0, 0.0])
        along = unit(across)
        height = np.sqrt(max(0.0, 1.0 - float(in_both @ in_both)))
        # The quadratic's two solutions; the one that resembles the samples more is the true one.
        x_0 = max((unit(in_both + s * height * along) for s in (1.0, -1.0)), key=lambda x: float(x @ mean_x))
    return np.column_stack([x_0, np.cross(z_0, x_0), z_0])
