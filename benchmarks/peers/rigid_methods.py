"""The literature's methods for a camera and a 2D LiDAR that are fixed to each other, from several boards.

Each takes the views of one reading of the turntable, while nothing but the board moves, and gives T_camera_lidar.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

import numpy as np

from benchmarks.peers.plane_views import Constraints, PlaneView, refined
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.lines import fit_line2
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation
from lidarpose.model.targets import Panel
from lidarpose.simulate.board_pattern import Plate

STARTS = 32


def zhang_pless_linear(views: Sequence[PlaneView]) -> Pose | None:
    """Zhang and Pless, "Extrinsic calibration of a camera and laser range finder", IROS 2004, section IV: nine linear
    unknowns, then the nearest rotation. Needs five boards; None with fewer."""
    if len(views) < 5:
        return None
    A, b = Constraints.of(views).linear()
    h = np.linalg.lstsq(A, b, rcond=None)[0].reshape(3, 3)
    r1, r2, t = h
    return Pose(nearest_rotation(np.column_stack([r1, r2, np.cross(r1, r2)])), t)


def zhang_pless(views: Sequence[PlaneView]) -> Pose | None:
    """The same refined by the distances of the points from the boards (their section V; board poses held)."""
    start = zhang_pless_linear(views)
    if start is None:
        return None
    R, t, _ = refined(Constraints.of(views), start.rotation[None], start.translation[None])
    return Pose(R[0], t[0])


def guo_roumeliotis(views: Sequence[PlaneView]) -> Pose | None:
    """Guo and Roumeliotis, "An analytical least-squares solution to the line scan LIDAR-camera extrinsic calibration
    problem", ICRA 2013: the global minimum of the same cost from three boards on, without a start.

    They find every stationary point by polynomial resultants; here the translation, which is linear, is eliminated at
    starts spread over all rotations. The minimiser is the same.
    """
    if len({(v.placement, v.panel) for v in views}) < 3:
        return None
    constraints = Constraints.of(views)
    turns = np.random.default_rng(0).normal(size=(STARTS, 4))
    turns /= np.linalg.norm(turns, axis=1, keepdims=True)
    vector = (
        2.0 * np.arccos(np.clip(turns[:, :1], -1, 1)) * turns[:, 1:] / np.linalg.norm(turns[:, 1:], axis=1)[:, None]
    )
    R = exp_so3(vector)
    R, t, cost = refined(constraints, R, _best_translation(constraints, R), iterations=8)
    few = np.argsort(cost)[:4]
    R, t, cost = refined(constraints, R[few], t[few])
    # Mirrored solutions behind the boards fit as well where the views say little; the boards face the LiDAR.
    facing = [_faces(views, Pose(r, s)) for r, s in zip(R, t, strict=True)]
    if not any(facing):
        return None
    best = int(np.argmin(np.where(facing, cost, np.inf)))
    return Pose(R[best], t[best])


def dong_isler(
    views: Sequence[PlaneView], start: Pose, panels: Sequence[Panel], margin_m: float, inset_m: float
) -> Pose:
    """Dong and Isler, "A novel method for the extrinsic calibration of a 2D laser rangefinder and a camera", IEEE
    Sensors Journal 18 (2018): a V of two boards, whose fold and edges constrain where each scan line begins and ends.

    Beside the points on planes: the fold point lies on both boards, and each line's outer end on the plane through
    the board's edge. Their boards are triangles, ours rectangles, so one view alone leaves a slide along the fold.
    `start` is the global minimum without the edges.
    """
    R, t = start.rotation, start.translation
    for _ in range(2):
        edges = _edge_constraints(views, Pose(R, t), panels, margin_m, inset_m)
        plain = Constraints.of(views)
        both = Constraints(
            np.concatenate([plain.normals, edges.normals]),
            np.concatenate([plain.offsets, edges.offsets]),
            np.concatenate([plain.rows, edges.rows]),
        )
        found_R, found_t, _ = refined(both, R[None], t[None])
        R, t = found_R[0], found_t[0]
    return Pose(R, t)


def _best_translation(constraints: Constraints, R: FloatArray) -> FloatArray:
    """The translations (K, 3) of least cost for rotations (K, 3, 3)."""
    e = constraints.residuals(R, np.zeros((len(R), 3)))
    A = (constraints.rows[:, :, 2, None] * constraints.normals[:, None, :]).reshape(-1, 3)
    return np.asarray(-np.linalg.lstsq(A, e.T, rcond=None)[0].T)


def _faces(views: Sequence[PlaneView], pose: Pose) -> bool:
    """Whether the LiDAR stands before all boards (z of a board points into it) and sees points, not their mirror."""
    return all(v.plane.distance(pose.translation) < 0.0 for v in views)


def _edge_constraints(
    views: Sequence[PlaneView], pose: Pose, panels: Sequence[Panel], margin_m: float, inset_m: float
) -> Constraints:
    """Fold points on both boards, and outer ends on the planes through the edges they lie next to."""
    normals: list[FloatArray] = []
    offsets: list[float] = []
    rows: list[FloatArray] = []

    def add(normal: FloatArray, offset: float, point: FloatArray) -> None:
        normals.append(normal)
        offsets.append(offset)
        rows.append(np.vstack([[*point, 1.0], np.zeros((2, 3))]))

    by_placement: dict[str, list[PlaneView]] = defaultdict(list)
    for view in views:
        by_placement[view.placement].append(view)
    for pair in by_placement.values():
        if len(pair) != 2:
            continue
        lines = [fit_line2(v.points) for v in pair]
        fold = lines[0].intersection(lines[1])
        for view, line in zip(pair, lines, strict=True):
            add(view.plane.normal, view.plane.offset, fold)
            end = _outer_end(view.points, line.direction, fold)
            normal, offset = _edge_plane(view, pose, end, Plate.of(panels[view.panel], margin_m), inset_m)
            add(normal, offset, end)
    return Constraints(np.stack(normals), np.array(offsets), np.stack(rows))


def _outer_end(points: FloatArray, direction: FloatArray, fold: FloatArray) -> FloatArray:
    """Where the line ends away from the fold: half a beam's spacing beyond the last point."""
    along = (points - fold) @ direction
    sign = 1.0 if np.median(along) > 0.0 else -1.0
    reach = np.sort(sign * along)
    spacing = (reach[-1] - reach[0]) / (len(reach) - 1)
    return np.asarray(fold + sign * direction * (reach[-1] + 0.5 * spacing))


def _edge_plane(view: PlaneView, pose: Pose, end: FloatArray, plate: Plate, inset_m: float) -> tuple[FloatArray, float]:
    """The plane through the board's edge that a line's end is nearest to, across the board, drawn in by `inset_m`."""
    x, y, _ = view.T_camera_panel.inverse() @ (pose @ np.array([*end, 0.0]))
    edges = {
        (0, plate.x_min + inset_m): abs(x - plate.x_min),
        (0, plate.x_max - inset_m): abs(x - plate.x_max),
        (1, plate.y_max - inset_m): abs(y - plate.y_max),
    }
    axis, place = min(edges, key=lambda key: edges[key])
    normal = view.T_camera_panel.rotation[:, axis]
    return normal, float(place + normal @ view.T_camera_panel.translation)
