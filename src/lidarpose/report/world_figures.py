"""The figures of a world report: faces, corners of single frames, what is left over, and the scene in 3D."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.planes import fit_plane
from lidarpose.geometry.robust import medians, quantile
from lidarpose.geometry.se3 import Pose
from lidarpose.model.world_run import WorldPlace, WorldRun
from lidarpose.report.markup import Markup
from lidarpose.report.numbers import fixed
from lidarpose.report.page import FACE_CLASSES, figure, legend_key
from lidarpose.report.scene import Scene
from lidarpose.report.svg import Axis, Chart, columns_of, padded

_FACE_COLOURS = ("--p1", "--p2", "--lidar")
_AXES = ("x", "y", "z")
_MOST_POINTS_A_FACE = 150
_MOST_POINTS_IN_FIGURE = 1500
MIN_FRAMES = 5


def world_scene(run: WorldRun) -> dict[str, Any]:
    """What the 3D viewer shows, in the world's frame."""
    scene = Scene(up=(0.0, 0.0, 1.0))
    pose, scale = run.calibration.T_world_source, run.calibration.scale
    corners = np.stack([p.corner_world for p in run.places]) if run.places else np.zeros((1, 3))
    reach = float(np.linalg.norm(np.ptp(np.vstack([corners, pose.translation]), axis=0)))
    for place in run.places:
        for k, points in place.faces.items():
            shown = points[:: max(1, len(points) // _MOST_POINTS_A_FACE)]
            scene.add("points", pose @ (scale * shown), _FACE_COLOURS[k % 3], size=1.1)
        _cross(scene, place.corner_world, 0.012 * reach)
        scene.label(place.corner_world, place.position)
    scene.axes(pose, 0.12 * reach, counts=True)
    scene.add("points", [pose.translation], "--lidar", size=4)
    scene.label(pose.translation, "LiDAR" if run.calibration.source == "lidar" else "camera", "--lidar")
    scene.axes(Pose.identity(), 0.08 * reach, counts=True)
    scene.add("points", [np.zeros(3)], "--muted", size=2)
    scene.label(np.zeros(3), "world", "--muted")
    towards = corners.mean(axis=0) - pose.translation
    level = np.array([towards[0], towards[1], 0.0])
    front = unit(level) if np.linalg.norm(level) > 1e-6 else np.array([1.0, 0.0, 0.0])
    return scene.data(front=front.tolist())


def _cross(scene: Scene, at: FloatArray, size: float) -> None:
    for axis in np.eye(3):
        scene.add("line", [at - size * axis, at + size * axis], "--bad", width=1.8)


def face_figures(run: WorldRun) -> list[Markup]:
    """The three faces of one place, each seen square on, with the edges that the planes make."""
    whole = [p for p in run.places if len(p.faces) == 3 and min(map(len, p.faces.values())) >= 6]
    if not whole:
        return []
    place = whole[len(whole) // 2]
    return [_face_figure(run, place, k) for k in range(3)]


def _face_figure(run: WorldRun, place: WorldPlace, face: int) -> Markup:
    points = place.faces[face]
    plane = fit_plane(points)
    normals = [fit_plane(place.faces[k]).normal for k in range(3)] if run.normals is None else run.normals
    edges = [_edge(normals[face], normals[k], points, place.corner) for k in range(3) if k != face]
    basis = np.stack([edges[0], np.cross(plane.normal, edges[0])])
    seen = 1e3 * (points - place.corner) @ basis.T
    rms = 1e3 * float(np.sqrt(np.mean(plane.distance(points) ** 2)))
    class_ = FACE_CLASSES[face]
    shown = seen[:: max(1, len(seen) // _MOST_POINTS_IN_FIGURE)]

    def draw(width: float) -> Markup:
        (x0, x1), (y0, y1) = (padded([*column, 0.0], 0.08) for column in columns_of(seen))
        axes = Axis("mm from the corner", x0, x1), Axis("mm", y0, y1)
        chart = Chart(width, 300.0, *axes, f"Points of face {face + 1}", equal=True)
        chart.points(*columns_of(shown), f"{class_} mid", 1.3)
        for edge in edges:
            end = 0.9 * float(np.abs(seen).max()) * (basis @ edge)
            chart.line([0.0, end[0]], [0.0, end[1]], "ink thin")
        chart.points([0.0], [0.0], "bad", 4.0)
        return chart.render()

    caption = f"{len(points)} points; they lie {fixed(rms, 2)} mm (RMS) off their plane."
    legend = [
        legend_key("dot", class_, "points"),
        legend_key("line", "ink", "edges"),
        legend_key("dot", "bad", "corner"),
    ]
    return figure(f"Place {place.position}, face {face + 1}", draw, caption, legend, size="third")


def _edge(own: FloatArray, other: FloatArray, points: FloatArray, corner: FloatArray) -> FloatArray:
    """Unit direction (3,) of the edge of two planes, from the corner to the side where the face's points are."""
    direction = unit(np.cross(own, other))
    return direction if float((points.mean(axis=0) - corner) @ direction) > 0.0 else -direction


def corner_residuals(run: WorldRun) -> Markup:
    """Each place's corner as the answer puts it, minus as measured, by the world's axes."""
    residuals = 1e3 * np.stack([p.residual_world(run.calibration) for p in run.places])
    at = np.arange(1, len(residuals) + 1, dtype=float)
    reach = max(1.15 * float(np.abs(residuals).max()), 1e-3)

    def draw(width: float) -> Markup:
        x = Axis("place, in the session's order", 0.4, len(at) + 0.6, ticks=tuple(at.tolist()))
        chart = Chart(width, 270.0, x, Axis("answer \u2212 measured, mm", -reach, reach), "Residuals of the corners")
        chart.level(0.0, "faint hair")
        for k, class_ in enumerate(FACE_CLASSES):
            where = at + 0.18 * (k - 1)
            low, high = np.minimum(residuals[:, k], 0.0), np.maximum(residuals[:, k], 0.0)
            chart.sticks(where, low, high, f"{class_} mid", min(9.0, 0.12 * width / len(at)))
            chart.points(where, residuals[:, k], class_, 2.8)
        return chart.render()

    legend = [legend_key("box", class_, f"world {axis}") for axis, class_ in zip(_AXES, FACE_CLASSES, strict=True)]
    caption = (
        "Each place's corner by its own points. Residuals much larger than the standard deviation of the world "
        "coordinates, or one place far from the rest, mean wrong coordinates, a turned target, or a wrong corner."
    )
    return figure("Residuals of the corners", draw, caption, legend, size="wide")


def frame_boxes(run: WorldRun) -> Markup | None:
    """Box plots, place by place, of the corner of each single frame, along the clouds' axes."""
    known = {k + 1: np.isfinite(p.frame_corners).all(axis=1) & p.frame_used for k, p in enumerate(run.places)}
    rows = [(k + 1, p) for k, p in enumerate(run.places) if known[k + 1].sum() >= MIN_FRAMES]
    if not rows:
        return None
    off = {k: 1e3 * (p.frame_corners - medians(p.frame_corners[known[k]], axis=0)) for k, p in rows}
    used = np.concatenate([off[k][known[k]] for k, _ in rows])
    reach = max(1.3 * quantile(np.abs(used), 0.995), 1e-3)

    def draw(width: float) -> Markup:
        count = len(run.places)
        x = Axis("place, in the session's order", 0.4, count + 0.6, ticks=tuple(float(k) for k in range(1, count + 1)))
        chart = Chart(width, 270.0, x, Axis("from the median, mm", -reach, reach), "Corners of single frames")
        chart.level(0.0, "faint hair")
        thick = min(10.0, 0.1 * width / count)
        for axis, class_ in enumerate(FACE_CLASSES):
            where = np.array([k + 0.2 * (axis - 1) for k, _ in rows])
            kept = [off[k][known[k], axis] for k, _ in rows]
            five = np.array([[quantile(v, share) for share in (0.025, 0.25, 0.75, 0.975)] for v in kept])
            chart.sticks(where, five[:, 0], five[:, 3], f"{class_} mid", max(1.0, thick / 5.0))
            chart.sticks(where, five[:, 1], five[:, 2], class_, thick)
            for at, (k, p) in zip(where, rows, strict=True):
                gone = np.clip(off[k][~p.frame_used, axis], -0.98 * reach, 0.98 * reach)
                chart.crosses(np.full(len(gone), at), gone, "bad thin")
        return chart.render()

    legend = [legend_key("box", class_, f"sensor's {axis}") for axis, class_ in zip(_AXES, FACE_CLASSES, strict=True)]
    if any(not p.frame_used.all() for _, p in rows):
        legend.append(legend_key("cross", "bad", "frame left out"))
    caption = (
        "The corner from each frame alone, against the place's median: thick the middle half, thin 2.5 to 97.5 %. "
        "Crosses at the edge lie beyond it."
    )
    return figure("Corners of single frames, place by place", draw, caption, legend, size="wide")
