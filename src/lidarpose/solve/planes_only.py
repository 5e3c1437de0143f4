"""The turntable's motion from boards and scans alone, for a laser that the camera does not see.

Each scan line lies in its panel's plane: its direction and its place across the plane, two equations a line, four a
place, for the motion's ten numbers (the point-on-plane constraint of the literature that the turntable paper cites).
There is no closed form and the equations have several solutions, so many starts run at once: the poses in which one
place's two lines lie on both planes are a family of two parameters, known in closed form; times a grid of axes.

Both lines of all places exchanged, and everything mirrored in the plane that bisects the V, fits just as well: without
a stripe and with one placement of a symmetric board, only the user can tell which line lies on which panel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation, rotation_z
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.line_pair import FittedLine, free_directions

AXES = 40
STARTS = 300
STEPS = 60
# Ends of starts that are looked at closely.
LOOKED_AT = 40
# Places that the many starts run on.
FEW_PLACES = 8
# Two solutions are different if the LiDAR stands this much elsewhere at some reading.
DIFFERENT_M = 0.005


@dataclass(frozen=True, eq=False)
class PlaceOnPlanes:
    """One place: its reading, both lines in the LiDAR frame, both panels in the camera frame.

    Attributes
    ----------
    middles_camera, reaches_m
        Middle of each panel's grid (3,), and how far its outline may reach from there.
    """

    angle_rad: float
    lines: tuple[FittedLine, FittedLine]
    panels: tuple[Plane, Plane]
    middles_camera: tuple[FloatArray, FloatArray]
    reaches_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class PlanesOnlySolution:
    """A motion, and the root mean square of its standardised residuals."""

    motion: TurntableMotion
    rms: float


def solve_planes_only(places: Sequence[PlaceOnPlanes]) -> list[PlanesOnlySolution]:
    """Every motion that puts all lines on their panels, best first; several if the data do not tell them apart.

    Raises
    ------
    ValueError
        If no start leads to a motion that puts the lines within the panels' outlines.
    """
    few = [places[k] for k in np.unique(np.linspace(0, len(places) - 1, FEW_PLACES).astype(int))]
    T = _starts(few[len(few) // 2])
    state = _with_axes(T, few[len(few) // 2].angle_rad)
    system = _System.of(few)
    cost = (system.residuals(state)[0] ** 2).sum(axis=1)
    state = state[np.argsort(cost)[:STARTS]]
    state, cost = system.minimise(state, STEPS)
    everything = _System.of(places)
    found: list[PlanesOnlySolution] = []
    for k in np.argsort(cost)[:LOOKED_AT]:
        if len(found) >= 4 or cost[k] > 100.0 * max(cost.min(), 4.0 * len(few)):
            break
        if not _on_panels(few, state[k]) or any(_same(few, s.motion, state[k]) for s in found):
            continue
        refined, total = everything.minimise(state[k : k + 1], STEPS)
        motion = TurntableMotion.from_any_frame(*_poses(refined[0]))
        if _on_panels(places, refined[0]) and not any(_same(places, s.motion, refined[0]) for s in found):
            found.append(PlanesOnlySolution(motion, float(np.sqrt(total[0] / max(1, 4 * len(places) - 10)))))
    if not found:
        raise ValueError("no motion of the LiDAR puts the scan lines on the panels")
    return sorted(found, key=lambda s: s.rms)


def poses_of_place(place: PlaceOnPlanes, angle_to_fold_rad: FloatArray, along_fold_m: FloatArray) -> list[Pose]:
    """Poses that put both lines of a place on both planes: the family of two parameters.

    With d0 at the angle a to the fold in panel 0, and d1 at b in panel 1, the lines' angle alpha needs
    ``cos a cos b + sin a sin b cos(dihedral) = cos alpha``: two b for every a. Then E slides along the fold.
    """
    lidar = free_directions(*place.lines)
    E = place.lines[0].line.intersection(place.lines[1].line)
    fold = place.panels[0].intersect_plane(place.panels[1])
    f = fold.direction
    u = [unit((m - fold.point) - ((m - fold.point) @ f) * f) for m in place.middles_camera]
    middle = float(np.mean([(m - fold.point) @ f for m in place.middles_camera]))
    in_lidar = np.column_stack([[*lidar[0], 0.0], [*lidar[1], 0.0], [0.0, 0.0, _cross(lidar)]])
    poses: list[Pose] = []
    for a in angle_to_fold_rad:
        A, B = np.cos(a), np.sin(a) * (u[0] @ u[1])
        ratio = float(lidar[0] @ lidar[1]) / np.hypot(A, B)
        if abs(ratio) >= 1.0:
            continue
        for branch in (1.0, -1.0):
            b = float(np.arctan2(B, A) + branch * np.arccos(ratio)) % (2.0 * np.pi)
            if not 0.05 < b < np.pi - 0.05:
                continue
            d0, d1 = np.cos(a) * f + np.sin(a) * u[0], np.cos(b) * f + np.sin(b) * u[1]
            R = nearest_rotation(np.column_stack([d0, d1, np.cross(d0, d1)]) @ np.linalg.inv(in_lidar))
            at_fold = fold.point + middle * f - R @ np.array([*E, 0.0])
            poses.extend(Pose(R, at_fold + e * f) for e in along_fold_m)
    return poses


def _starts(place: PlaceOnPlanes) -> list[Pose]:
    reach = min(place.reaches_m)
    poses = poses_of_place(place, np.deg2rad(np.arange(25.0, 160.0, 15.0)), reach * np.array([-0.5, -0.2, 0.2, 0.5]))
    front = [T for T in poses if all(p.distance(T.translation) * -p.offset > 0.0 for p in place.panels)]
    if not front:
        raise ValueError("the two lines of a scan cannot lie on both panels with the LiDAR in front of them")
    return front


def _with_axes(poses: Sequence[Pose], angle_rad: float) -> FloatArray:
    """States (S, 2, 3, 4), [T_w, T_m] each: every pose with axes all round through the LiDAR's centre."""
    k = np.arange(AXES) + 0.5
    height, turn = 1.0 - 2.0 * k / AXES, np.pi * (1.0 + np.sqrt(5.0)) * k
    flat = np.sqrt(1.0 - height**2)
    states = []
    for axis in np.column_stack([flat * np.cos(turn), flat * np.sin(turn), height]):
        helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
        u = unit(np.cross(helper, axis))
        R_w = np.column_stack([u, np.cross(axis, u), axis])
        for T in poses:
            R_m = rotation_z(-angle_rad) @ R_w.T @ T.rotation
            states.append([np.column_stack([R_w, T.translation]), np.column_stack([R_m, np.zeros(3)])])
    return np.array(states)


@dataclass(frozen=True, eq=False)
class _System:
    """The equations of some places, for many states at once."""

    turns: FloatArray
    points: FloatArray
    directions: FloatArray
    normals: FloatArray
    offsets: FloatArray
    weights: FloatArray

    @staticmethod
    def of(places: Sequence[PlaceOnPlanes]) -> _System:
        pairs = [(p, k) for p in places for k in (0, 1)]
        flat = [(p.lines[k], p.panels[k]) for p, k in pairs]
        return _System(
            rotation_z(np.array([p.angle_rad for p, _ in pairs])),
            np.array([[*line.middle, 0.0] for line, _ in flat]),
            np.array([[*line.line.direction, 0.0] for line, _ in flat]),
            np.array([plane.normal for _, plane in flat]),
            np.array([plane.offset for _, plane in flat]),
            # A panel's own pose is known to a tenth of a millimetre and of a milliradian or so, no better.
            np.array(
                [
                    [1.0 / np.hypot(line.offset_sigma_m, 2e-4), 1.0 / np.hypot(line.direction_sigma_rad, 3e-4)]
                    for line, _ in flat
                ]
            ),
        )

    def residuals(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Standardised residuals (S, 4P) and derivatives (S, 4P, 12) by left perturbations of T_w and T_m."""
        R_w, t_w = state[:, 0, :, :3], state[:, 0, :, 3]
        R_m, t_m = state[:, 1, :, :3], state[:, 1, :, 3]
        turned = R_w[:, None] @ self.turns
        on_table = np.einsum("sij,nj->sni", R_m, self.points) + t_m[:, None]
        along = np.einsum("sij,nj->sni", R_m, self.directions)
        q = np.einsum("snij,snj->sni", turned, on_table) + t_w[:, None]
        v = np.einsum("snij,snj->sni", turned, along)
        N = np.broadcast_to(self.normals, q.shape)
        N_table = np.einsum("snji,snj->sni", turned, N)
        across = (q * N).sum(-1) - self.offsets
        tilt = (v * N).sum(-1)
        zero = np.zeros_like(N)
        J_across = np.concatenate([N, np.cross(q, N), N_table, np.cross(on_table, N_table)], axis=-1)
        J_tilt = np.concatenate([zero, np.cross(v, N), zero, np.cross(along, N_table)], axis=-1)
        r = np.stack([across, tilt], axis=-1) * self.weights
        J = np.stack([J_across, J_tilt], axis=-2) * self.weights[..., None]
        return r.reshape(len(state), -1), J.reshape(len(state), -1, 12)

    def minimise(self, state: FloatArray, steps: int) -> tuple[FloatArray, FloatArray]:
        """Levenberg-Marquardt on all states at once: states and their sums of squares."""
        r, J = self.residuals(state)
        cost = (r**2).sum(axis=1)
        damping = np.full(len(state), 1e-2)
        for _ in range(steps):
            H = np.einsum("sna,snb->sab", J, J)
            g = np.einsum("sna,sn->sa", J, r)
            # The turn about the axis and the shift along it are free: damping by the identity leaves them alone.
            scale = np.einsum("saa->sa", H)
            floor = 1e-9 * scale.max(axis=1, keepdims=True)
            step = np.linalg.solve(H + (damping[:, None] * scale + floor)[:, :, None] * np.eye(12), -g[..., None])
            candidate = _moved(state, step[..., 0])
            new_r, new_J = self.residuals(candidate)
            new_cost = (new_r**2).sum(axis=1)
            better = new_cost < cost
            state = np.where(better[:, None, None, None], candidate, state)
            r, J = np.where(better[:, None], new_r, r), np.where(better[:, None, None], new_J, J)
            cost = np.where(better, new_cost, cost)
            damping = np.clip(np.where(better, 0.2 * damping, 5.0 * damping), 1e-12, 1e6)
            if not better.any() and damping.min() > 1e3:
                break
        return state, cost


def _moved(state: FloatArray, step: FloatArray) -> FloatArray:
    moved = np.empty_like(state)
    for k in (0, 1):
        small = step[:, 6 * k : 6 * k + 6]
        R = exp_so3(small[:, 3:])
        moved[:, k, :, :3] = nearest_rotation(R @ state[:, k, :, :3])
        moved[:, k, :, 3] = np.einsum("sij,sj->si", R, state[:, k, :, 3]) + small[:, :3]
    return moved


def _poses(state: FloatArray) -> tuple[Pose, Pose]:
    return Pose(state[0, :, :3], state[0, :, 3]), Pose(state[1, :, :3], state[1, :, 3])


def _pose_at(state: FloatArray, angle_rad: float) -> Pose:
    T_w, T_m = _poses(state)
    return T_w @ Pose.rot_z(angle_rad) @ T_m


def _on_panels(places: Sequence[PlaceOnPlanes], state: FloatArray) -> bool:
    """Whether at nearly all places the LiDAR stands before the panels and the lines' ends lie within their outlines."""
    good = 0
    for place in places:
        T = _pose_at(state, place.angle_rad)
        inside = all(p.distance(T.translation) * -p.offset > 0.0 for p in place.panels)
        for line, middle, reach in zip(place.lines, place.middles_camera, place.reaches_m, strict=True):
            ends = T @ np.column_stack([line.ends, np.zeros(2)])
            inside = inside and bool(np.linalg.norm(ends - middle, axis=1).max() < reach)
        good += inside
    return good >= 0.8 * len(places)


def _same(places: Sequence[PlaceOnPlanes], motion: TurntableMotion, state: FloatArray) -> bool:
    off = [motion.pose(p.angle_rad).distance(_pose_at(state, p.angle_rad)) for p in (places[0], places[-1])]
    return max(o[0] for o in off) < DIFFERENT_M and max(o[1] for o in off) < 0.02


def _cross(directions: FloatArray) -> float:
    return float(directions[0, 0] * directions[1, 1] - directions[0, 1] * directions[1, 0])
