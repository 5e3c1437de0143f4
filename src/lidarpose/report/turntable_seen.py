"""What was found in a session: the board's image with grids and stripes, and a scan with its two lines."""

from __future__ import annotations

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import PanelCorners, PlaceObservation
from lidarpose.model.scan import Scan
from lidarpose.model.targets import Panel
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.markup import Markup, el
from lidarpose.report.numbers import plural
from lidarpose.report.page import PANEL_CLASSES, figure, legend_key, picture
from lidarpose.report.pictures import jpeg_data_uri
from lidarpose.report.svg import Axis, Chart, columns_of, drawing, padded, path_data
from lidarpose.report.turn_numbers import LEAST_WEIGHT, used_positions

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
    name = f" – {placement}" if placement else ""
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
        *(legend_key("dot", PANEL_CLASSES[k], f"on panel {k + 1}") for k in sorted(near)),
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
        chart.points(*columns_of(everything), "faint", 1.1)
        for k, points in near.items():
            chart.points(*columns_of(points), PANEL_CLASSES[k], 1.6)
        chart.points([0.0], [0.0], "lidar", 4.5)
        chart.text_px(float(chart.px(0.0)) + 9.0, float(chart.py(0.0)) + 4.0, "LiDAR", "lidar")
        return chart.render()

    def close(width: float) -> Markup:
        span = 0.35 * float(np.ptp(board, axis=0).max())
        chart = _scan_chart(width, board.min(axis=0) - span, board.max(axis=0) + span, "The scan near the board")
        chart.points(*columns_of(everything), "faint", 1.6)
        for k, points in near.items():
            chart.points(*columns_of(points), PANEL_CLASSES[k], 1.9)
            chart.line(*columns_of(_through(points, span)), f"thin {PANEL_CLASSES[k]}")
        for points in out:
            chart.crosses(*columns_of(points), "bad thin")
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
