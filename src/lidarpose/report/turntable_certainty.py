"""How sure the answer is over the turn, and how well single places agree with it."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.markup import Markup
from lidarpose.report.numbers import short
from lidarpose.report.page import Size, figure, legend_key
from lidarpose.report.svg import Axis, Chart, padded
from lidarpose.report.turn_numbers import TurnNumbers, arc_deg, uncertain_pose_of


def turn_figures(run: TurntableRun, numbers: TurnNumbers, want: tuple[float | None, float | None]) -> list[Markup]:
    """Standard deviations of the LiDAR's centre and orientation, and of scanned points, over the turn."""
    legend = [
        legend_key("line", "lidar", "standard deviation"),
        legend_key("box", "arc", "recorded arc"),
    ]
    points = [
        (f"{d:g} m from the LiDAR", numbers.point_mm[d], class_)
        for d, class_ in zip(sorted(numbers.point_mm), ("p1", "p2"), strict=True)
    ]
    centre = [("the LiDAR's centre", numbers.centre_mm, "lidar")]
    rotation = [("orientation", numbers.rotation_deg, "lidar")]
    return [
        _turn_figure(run, numbers, "Centre of the LiDAR", "mm", centre, want[0], legend, ""),
        _turn_figure(run, numbers, "Orientation of the LiDAR", "degrees", rotation, want[1], legend, ""),
        _turn_figure(
            run,
            numbers,
            "A scanned point, over the turn",
            "mm",
            points + centre,
            None,
            [
                *(legend_key("line", class_, name) for name, _, class_ in points + centre),
                legend_key("box", "arc", "recorded arc"),
            ],
            "What this calibration alone adds to a scanned point in the camera frame, in the scan plane's worst "
            "direction; the ranges' own noise comes on top.",
            size="wide",
        ),
    ]


def ellipse_figures(run: TurntableRun) -> list[Markup]:
    """Error ellipses of the LiDAR's centre along the camera's axes: in the arc, and elsewhere on the turn."""
    uncertain = uncertain_pose_of(run)
    if uncertain is None:
        return []
    low, high = arc_deg(run)
    middle = 0.5 * (low + high)
    shown = [
        (words, 1e6 * uncertain(float(np.deg2rad(middle + turn))).centre_covariance(), class_)
        for words, turn, class_ in (
            ("middle of the arc", 0.0, "lidar"),
            ("a quarter turn on", 90.0, "p1"),
            ("half a turn on", 180.0, "p2"),
        )
    ]
    legend = [legend_key("line", class_, words) for words, _, class_ in shown]
    reach = 1.15 * float(np.sqrt(max(float(np.diag(covariance).max()) for _, covariance, _ in shown)))

    def draw_plane(width: float, axes: tuple[int, int]) -> Markup:
        names = ("x (right)", "y (down)", "z (forward)")
        x, y = (Axis(f"camera's {names[k]}, mm", -reach, reach, reverse=k == 1) for k in axes)
        chart = Chart(width, min(0.72 * width, 330.0), x, y, f"Error ellipses, {names[axes[1]]}", equal=True)
        for _, covariance, class_ in shown:
            chart.ellipse(np.zeros(2), covariance[np.ix_(axes, axes)], class_)
        chart.points([0.0], [0.0], "ink", 2.0)
        return chart.render()

    return [
        figure("The centre's error ellipse, from above", lambda width: draw_plane(width, (0, 2)), "", legend),
        figure("The same as the camera looks", lambda width: draw_plane(width, (0, 1)), "", legend),
    ]


def deviation_figure(run: TurntableRun) -> Markup | None:
    """Each place's own pose (section 1 of the paper) against the one motion through all."""
    readings = {p.position: p.turntable_angle_rad for p in run.session.places}
    found = [(readings[k], pose) for k, pose in run.samples.items() if k in readings]
    if not found:
        return None
    modelled = [run.calibration.pose(a) for a, _ in found]
    distance = [m.distance(pose) for m, (_, pose) in zip(modelled, found, strict=True)]
    degrees = np.rad2deg([a for a, _ in found])
    centre = np.array([1e3 * d[0] for d in distance])

    def draw(width: float) -> Markup:
        high = max(1.05 * float(np.percentile(centre, 97.0)), 1.02 * float(np.median(centre)) * 2.0, 1e-3)
        x = Axis("reading of the turntable, degrees", *padded(degrees, 0.03))
        chart = Chart(width, 250.0, x, Axis("distance, mm", 0.0, high), "Single places against the motion")
        chart.points(degrees, np.minimum(centre, high * 0.995), "p1", 2.6)
        return chart.render()

    caption = (
        "Distance between the LiDAR's centre from one place alone and the motion through all places. A single place "
        "is noisy; what counts is that no stretch of the arc stands out. Points at the upper edge lie beyond it."
    )
    return figure("Single places against the motion", draw, caption)


def _turn_figure(
    run: TurntableRun,
    numbers: TurnNumbers,
    title: str,
    unit: str,
    curves: Sequence[tuple[str, FloatArray, str]],
    wish: float | None,
    legend: Iterable[Markup],
    caption: str,
    *,
    size: Size = "half",
) -> Markup:
    low, high = arc_deg(run)
    top = 1.1 * max(float(values.max()) for _, values, _ in curves)
    # A wish far above everything would flatten the curve; it is then said in words.
    shown = wish is not None and wish < 4.0 * top
    if wish is not None and shown:
        top = max(top, 1.15 * wish)
    first, last = float(numbers.reading_deg[0]), float(numbers.reading_deg[-1])
    ticks = tuple(float(t) for t in np.arange(np.ceil(first / 45.0), np.floor(last / 45.0) + 1) * 45.0)

    def draw(width: float) -> Markup:
        x = Axis("reading of the turntable, degrees", first, last, ticks=ticks)
        chart = Chart(width, 260.0, x, Axis(f"standard deviation, {unit}", 0.0, top), f"{title}: over the turn")
        chart.span(low, high, "arc")
        for _, values, class_ in curves:
            chart.line(numbers.reading_deg, values, class_)
        if wish is not None and shown:
            chart.level(wish, "wish dash thin")
        return chart.render()

    if shown:
        legend = [*legend, legend_key("dash", "wish", "wished")]
    words = [caption] if caption else []
    if wish is not None:
        side = "" if shown else ", far above this chart"
        words.append(f"Wished inside the arc: {short(wish)} {unit}{side}.")
    return figure(title, draw, " ".join(words), legend, size=size)
