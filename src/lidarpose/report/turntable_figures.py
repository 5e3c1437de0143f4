"""The figures of a turntable report: what was seen, what is left over, and how sure the answer is."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import PanelCorners, PlaceObservation
from lidarpose.model.scan import Scan
from lidarpose.model.targets import Panel
from lidarpose.model.turntable_result import Kind, ResidualGroup, TurntableEstimate
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.markup import Markup, el
from lidarpose.report.numbers import plural, short
from lidarpose.report.page import Size, figure, legend_key, picture
from lidarpose.report.pictures import jpeg_data_uri
from lidarpose.report.svg import Axis, Chart, drawing, padded, path_data
from lidarpose.report.turn_numbers import LEAST_WEIGHT, TurnNumbers, arc_deg, used_positions

KIND_WORDS: dict[Kind, str] = {"corners": "chessboard corners", "stripes": "stripe pixels", "ranges": "ranges"}
_SCALE: dict[Kind, float] = {"corners": 1.0, "stripes": 1.0, "ranges": 1e3}
_UNIT: dict[Kind, str] = {"corners": "px", "stripes": "px", "ranges": "mm"}
_PANEL_CLASSES = ("p1", "p2")
_STRIPE_POINTS = 14


def board_figure(run: TurntableRun, placement: str, image: GrayImage | None) -> Markup:
    """The board in bright light with both grids and every stripe over it."""
    camera = run.observations.camera
    parts = [el("rect", width=camera.width, height=camera.height, fill="#20242a")]
    if image is not None:
        parts = [el("image", href=jpeg_data_uri(image), width=camera.width, height=camera.height)]
    used = used_positions(run)
    places = [p for p in run.observations.places if p.placement == placement]
    for chosen, class_ in ((True, "im-stripe"), (False, "im-out")):
        paths = [_stripe_path(p) for p in places if (p.position in used) is chosen]
        parts.append(el("path", d="".join(paths), class_=f"photo {class_}"))
    for k, (panel, found) in enumerate(zip(run.observations.panels, run.observations.corners[placement], strict=False)):
        parts.append(el("path", d=_grid_path(panel, found), class_=f"photo im-p{k + 1}"))
    content = drawing(camera.width, camera.height, parts, "The board's image with both grids and all stripes over it")
    out = sum(1 for p in places if p.position not in used and p.stripes)
    legend = [
        legend_key("line", "im-p1", "grid of panel 1"),
        legend_key("line", "im-p2", "grid of panel 2"),
        legend_key("line", "im-stripe", f"stripes of {plural(len(places) - out, 'place')}"),
        *([legend_key("line", "im-out", f"stripes not used ({plural(out, 'place')})")] if out else []),
    ]
    name = f" – placement {placement}" if placement else ""
    caption = (
        "Each grid must lie on the inner corners of its chessboard, and every stripe on its panel only. "
        "A grid beside the corners means a wrong number of columns or rows; stripes that all lie beside the board "
        "mean that the camera or the board moved between the images."
    )
    missing = "" if image is not None else " The bright image itself was not at hand when this page was made."
    return picture(f"The board as the camera saw it{name}", content, caption + missing, legend)


def scan_figures(run: TurntableRun) -> list[Markup]:
    """One place's scan: as a whole, and near the board with the two lines and what was left out."""
    place = _typical_place(run)
    if place is None:
        return []
    source = next((p for p in run.session.places if p.position == place.position), None)
    try:
        scan = source.scan.load() if source is not None else None
    except InputError:
        scan = None
    near = {k: line.points_lidar() for k, line in place.scan_lines.items()}
    out = _left_out_points(run, place)
    everything = _returns(scan) if scan is not None else np.zeros((0, 2))
    board = np.concatenate([*near.values(), *out])
    legend = [
        *(legend_key("dot", _PANEL_CLASSES[k], f"on panel {k + 1}") for k in sorted(near)),
        legend_key("dot", "faint", "other returns"),
        *([legend_key("cross", "bad", "left out of a line")] if sum(map(len, out)) else []),
    ]
    reading = f"{np.rad2deg(place.turntable_angle_rad):.2f}°".replace("-", "\u2212")

    def overview(width: float) -> Markup:
        seen = np.concatenate([everything, board, np.zeros((1, 2))])
        low, high = np.percentile(seen, 1.0, axis=0), np.percentile(seen, 99.0, axis=0)
        low, high = np.minimum(low, [*board.min(axis=0)]), np.maximum(high, [*board.max(axis=0)])
        low, high = np.minimum(low, 0.0), np.maximum(high, 0.0)
        chart = _scan_chart(width, low, high, "The whole scan of one place")
        chart.points(*_xy(everything), "faint", 1.1)
        for k, points in near.items():
            chart.points(*_xy(points), _PANEL_CLASSES[k], 1.6)
        chart.points([0.0], [0.0], "lidar", 4.5)
        chart.text_px(float(chart.px(0.0)) + 9.0, float(chart.py(0.0)) + 4.0, "LiDAR", "lidar")
        return chart.render()

    def close(width: float) -> Markup:
        span = 0.35 * float(np.ptp(board, axis=0).max())
        chart = _scan_chart(width, board.min(axis=0) - span, board.max(axis=0) + span, "The scan near the board")
        chart.points(*_xy(everything), "faint", 1.6)
        for k, points in near.items():
            chart.points(*_xy(points), _PANEL_CLASSES[k], 1.9)
            chart.line(*_xy(_through(points, span)), f"thin {_PANEL_CLASSES[k]}")
        for points in out:
            chart.crosses(*_xy(points), "bad thin")
        return chart.render()

    title = f"The scan of place {place.position}, reading {reading}"
    return [
        figure(title, overview, "Seen from above the scan plane: the LiDAR, what surrounds it, and the board.", legend),
        figure(
            "The same scan near the board",
            close,
            "Two straight lines, one a panel, that meet at the fold. Returns beside them were recognised as something "
            "else, or as mixed pixels at an edge.",
            legend,
        ),
    ]


def residuals_by_place(run: TurntableRun, estimate: TurntableEstimate, kind: Kind) -> Markup | None:
    """Box plots of what is left over at each place, against the expected spread."""
    groups = [g for g in estimate.residuals if g.kind == kind and g.position is not None]
    order = {place.position: k + 1 for k, place in enumerate(run.session.places)}
    rows = [(order[str(g.position)], g.panel, _five(g, kind)) for g in groups if str(g.position) in order]
    rows = [row for row in rows if row[2] is not None]
    if not rows:
        return None
    sigma = _SCALE[kind] * estimate.noise[kind].sigma
    boxes = np.array([row[2] for row in rows])
    reach = max(3.2 * sigma, float(np.percentile(np.abs(boxes[:, [0, 4]]), 98.0)) * 1.08)
    last = max(order.values())

    def draw(width: float) -> Markup:
        y = Axis(f"measured \u2212 predicted, {_UNIT[kind]}", -reach, reach)
        chart = Chart(width, 270.0, Axis("place, in the session's order", 0.3, last + 0.7), y, f"Residuals of {kind}")
        chart.area([0.3, last + 0.7], [-2 * sigma] * 2, [2 * sigma] * 2, "band2")
        chart.area([0.3, last + 0.7], [-sigma] * 2, [sigma] * 2, "band")
        pitch = (width - 70.0) / (last + 1)
        thick = float(np.clip(0.3 * pitch, 1.2, 9.0))
        for panel, class_ in enumerate(_PANEL_CLASSES):
            mine = np.array([[row[0], *row[2]] for row in rows if row[1] == panel and row[2] is not None])
            if not len(mine):
                continue
            x = mine[:, 0] + (-0.2 if panel == 0 else 0.2)
            chart.sticks(x, mine[:, 1], mine[:, 5], f"{class_} mid", max(0.7, thick / 4.0))
            chart.sticks(x, mine[:, 2], mine[:, 4], class_, thick)
        chart.level(0.0, "faint hair")
        return chart.render()

    legend = [
        legend_key("box", "p1", "panel 1: middle half; thin: 5 to 95 %"),
        legend_key("box", "p2", "panel 2"),
        legend_key("box", "band", f"expected: ±{short(sigma)} {_UNIT[kind]} (and twice that)"),
    ]
    caption = (
        "Boxes should sit about zero and within the inner band, at every place alike. Boxes that wander together from "
        "place to place show that camera, board or turntable moved, or that the readings are not true."
    )
    return figure(f"Residuals of the {KIND_WORDS[kind]}, place by place", draw, caption, legend, size="wide")


def residual_histogram(estimate: TurntableEstimate, kind: Kind) -> Markup | None:
    """All residuals of a kind in units of their expected spread, against the bell curve."""
    groups = [g for g in estimate.residuals if g.kind == kind]
    if not groups:
        return None
    units = np.concatenate([(g.values / g.sigma).ravel() for g in groups])
    units = units[np.isfinite(units)]
    if units.size == 0:
        return None
    edges = np.linspace(-5.0, 5.0, 51)
    heights = np.histogram(np.clip(units, -4.999, 4.999), edges)[0] / (units.size * 0.2)
    beyond = float(np.mean(np.abs(units) > 3.0))
    noise = estimate.noise[kind]
    bell_x = np.linspace(-5.0, 5.0, 121)
    bell = np.exp(-0.5 * bell_x**2) / np.sqrt(2.0 * np.pi)

    def draw(width: float) -> Markup:
        top = 1.08 * max(float(heights.max()), float(bell.max()))
        x = Axis("residual / expected standard deviation", -5.0, 5.0)
        chart = Chart(width, 240.0, x, Axis("share per unit", 0.0, top), f"Histogram of {kind} residuals")
        chart.bars(edges, heights, "p1 mid")
        chart.line(bell_x, bell, "ink")
        return chart.render()

    unit = _UNIT[kind]
    caption = (
        f"{noise.count} measurements; standard deviation {short(_SCALE[kind] * noise.sigma)} {unit}, "
        f"{short(noise.factor)} times the stated one; {100.0 * beyond:.1f} % lie beyond three "
        "(0.3 % if all were well); the outermost bars hold all that lies further out."
    )
    if noise.place_sigma > 0.0:
        caption += f" Whole lines are off by a further {short(_SCALE[kind] * noise.place_sigma)} {unit}."
    legend = [legend_key("box", "p1 mid", "measured"), legend_key("line", "ink", "expected")]
    return figure(KIND_WORDS[kind].capitalize(), draw, caption, legend, size="third")


def corner_arrows(run: TurntableRun, estimate: TurntableEstimate) -> Markup | None:
    """What is left over at each corner of the boards, as enlarged arrows over the image."""
    pixels, arrows, panels = _corner_residuals(run, estimate)
    if not len(pixels):
        return None
    camera = run.observations.camera
    typical = float(np.median(np.linalg.norm(arrows, axis=1)))
    enlarged = _round_factor(0.018 * camera.width / max(typical, 1e-6))

    def draw(width: float) -> Markup:
        chart = _image_chart(width, camera.width, camera.height, "Directions of the corners' residuals")
        for k, class_ in enumerate(_PANEL_CLASSES):
            start, end = pixels[panels == k], (pixels + enlarged * arrows)[panels == k]
            if len(start):
                gap = np.full((len(start), 1, 2), np.nan)
                path = np.concatenate([start[:, None], end[:, None], gap], axis=1).reshape(-1, 2)
                chart.line(*_xy(path), f"thin {class_}")
                chart.points(*_xy(start), class_, 1.2)
        return chart.render()

    caption = (
        f"From each corner towards where it was measured, {enlarged:g} times enlarged (median {short(typical)} px). "
        "Arrows should point anywhere. Arrows that swirl, or all point in or out, show that camera.yaml does not "
        "describe this camera; arrows that bend along a board show that the board is not flat."
    )
    legend = [legend_key("line", "p1", "panel 1"), legend_key("line", "p2", "panel 2")]
    return figure("Corners: directions of the residuals", draw, caption, legend)


def stripe_map(run: TurntableRun, estimate: TurntableEstimate) -> Markup | None:
    """Mean residual of the stripes' pixels by region of the image, as arrows across the stripe."""
    camera = run.observations.camera
    where, arrows = _stripe_residuals(run, estimate)
    if not len(where):
        return None
    cell = max(camera.width, camera.height) / 36.0
    key = np.floor(where / cell).astype(int)
    cells, index, counts = np.unique(key, axis=0, return_inverse=True, return_counts=True)
    means = np.stack([np.bincount(index.ravel(), arrows[:, k]) for k in (0, 1)], axis=1) / counts[:, None]
    middles = (cells + 0.5) * cell
    enough = counts >= 5
    middles, means = middles[enough], means[enough]
    if not len(middles):
        return None
    typical = float(np.median(np.linalg.norm(means, axis=1)))
    enlarged = _round_factor(0.02 * camera.width / max(typical, 1e-6))

    def draw(width: float) -> Markup:
        chart = _image_chart(width, camera.width, camera.height, "Mean residuals of the stripes over the image")
        gap = np.full((len(middles), 1, 2), np.nan)
        ends = middles + enlarged * means
        chart.line(*_xy(np.concatenate([middles[:, None], ends[:, None], gap], axis=1).reshape(-1, 2)), "thin lidar")
        chart.points(*_xy(middles), "lidar", 1.2)
        return chart.render()

    caption = (
        f"Means over regions of {cell:.0f} px, {enlarged:g} times enlarged (median {short(typical)} px). "
        "Neighbours that point the same way over a large part of a panel show a board that is not flat, or lens "
        "distortion that camera.yaml does not hold."
    )
    legend = [legend_key("line", "lidar", "mean shift of the stripes")]
    return figure("Stripes: directions of the residuals", draw, caption, legend)


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


# --- helpers -----------------------------------------------------------------------------------------------------


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


def _xy(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    return points[:, 0], points[:, 1]


def _stripe_path(place: PlaceObservation) -> str:
    parts = []
    for stripe in place.stripes.values():
        if len(stripe) >= 2:
            pick = np.unique(np.linspace(0, len(stripe) - 1, _STRIPE_POINTS).round().astype(int))
            parts.append(path_data(*_along(stripe.pixels)[pick].T))
    return "".join(parts)


def _along(pixels: FloatArray) -> FloatArray:
    """Points sorted along their own main direction."""
    centred = pixels - pixels.mean(axis=0)
    direction = np.linalg.svd(centred, full_matrices=False)[2][0]
    return pixels[np.argsort(centred @ direction, kind="stable")]


def _grid_path(panel: Panel, found: PanelCorners) -> str:
    """Lines along the rows and columns through the corners that were found."""
    index = np.round(found.corners_panel[:, :2] / panel.square_m).astype(int)
    parts = []
    for across in (0, 1):
        for line in np.unique(index[:, across]):
            mine = index[:, across] == line
            order = np.argsort(index[mine, 1 - across])
            parts.append(path_data(*found.pixels[mine][order].T))
    return "".join(parts)


def _typical_place(run: TurntableRun) -> PlaceObservation | None:
    """The used place nearest to the middle that has both lines (or any line)."""
    used = used_positions(run)
    places = [p for p in run.observations.places if p.scan_lines]
    best = [p for p in places if p.position in used and len(p.scan_lines) == 2] or places
    return best[len(best) // 2] if best else None


def _left_out_points(run: TurntableRun, place: PlaceObservation) -> list[FloatArray]:
    """Points of a place's lines that the estimate gave no weight."""
    if run.estimate is None:
        return []
    found = []
    for group in run.estimate.residuals:
        line = place.scan_lines.get(group.panel)
        mine = group.kind == "ranges" and group.position == place.position
        if mine and line is not None and len(line) == len(group.weights):
            found.append(line.points_lidar()[group.weights < LEAST_WEIGHT])
    return found


def _returns(scan: Scan) -> FloatArray:
    points = scan.points_lidar()[scan.has_return]
    return points[:: max(1, len(points) // 4000)]


def _through(points: FloatArray, more: float) -> FloatArray:
    """The ends (2, 2) of the straight line through points, prolonged a little."""
    middle = np.median(points, axis=0)
    direction = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2][0]
    along = (points - middle) @ direction
    return np.asarray(middle + np.outer([along.min() - 0.15 * more, along.max() + 0.15 * more], direction))


def _scan_chart(width: float, low: FloatArray, high: FloatArray, description: str) -> Chart:
    height = min(0.86 * width, 430.0)
    x, y = (padded([a, b], 0.05, 0.05) for a, b in zip(low, high, strict=True))
    return Chart(width, height, Axis("x, m", *x), Axis("y, m", *y), description, equal=True)


def _image_chart(width: float, columns: int, rows: int, description: str) -> Chart:
    height = (width - 60.0) * rows / columns + 70.0
    return Chart(
        width,
        height,
        Axis("column, px", 0.0, columns),
        Axis("row, px", 0.0, rows, reverse=True),
        description,
        equal=True,
    )


def _five(group: ResidualGroup, kind: Kind) -> FloatArray | None:
    """The 5, 25, 50, 75 and 95 % points of what was used."""
    values = _SCALE[kind] * group.values[group.weights > LEAST_WEIGHT]
    return np.percentile(values, [5.0, 25.0, 50.0, 75.0, 95.0]) if len(values) else None


def _corner_residuals(run: TurntableRun, estimate: TurntableEstimate) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels (N, 2), residuals (N, 2) and panels (N,) of the corners."""
    pixels: list[FloatArray] = [np.zeros((0, 2))]
    arrows: list[FloatArray] = [np.zeros((0, 2))]
    panels: list[FloatArray] = [np.zeros(0)]
    for group in estimate.residuals:
        found = run.observations.corners.get(group.placement, ())
        if group.kind != "corners" or group.panel >= len(found) or group.values.size != found[group.panel].pixels.size:
            continue
        use = (
            np.all(group.weights.reshape(-1, 2) > LEAST_WEIGHT, axis=1)
            if group.weights.size == group.values.size
            else ...
        )
        pixels.append(found[group.panel].pixels[use].reshape(-1, 2))
        arrows.append(group.values.reshape(-1, 2)[use].reshape(-1, 2))
        panels.append(np.full(len(arrows[-1]), group.panel))
    return np.concatenate(pixels), np.concatenate(arrows), np.concatenate(panels)


def _stripe_residuals(run: TurntableRun, estimate: TurntableEstimate) -> tuple[FloatArray, FloatArray]:
    """Pixels (N, 2) and residual vectors (N, 2) of the stripes that were used."""
    places = {p.position: p for p in run.observations.places}
    where: list[FloatArray] = [np.zeros((0, 2))]
    arrows: list[FloatArray] = [np.zeros((0, 2))]
    for group in estimate.residuals:
        place = places.get(group.position or "")
        stripe = place.stripes.get(group.panel) if place is not None else None
        if group.kind != "stripes" or stripe is None or len(stripe) != len(group.values):
            continue
        use = group.weights > LEAST_WEIGHT
        where.append(stripe.pixels[use])
        arrows.append((group.values[:, None] * stripe.normals)[use])
    return np.concatenate(where), np.concatenate(arrows)


def _round_factor(factor: float) -> float:
    """1, 2 or 5 times a power of ten, not above `factor` (but at least 1)."""
    if factor <= 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= factor))
