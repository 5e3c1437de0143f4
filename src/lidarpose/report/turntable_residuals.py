"""What is left over between measurements and answer: by place, by kind, and over the image."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.turntable_result import Kind, TurntableEstimate
from lidarpose.model.turntable_run import TurntableRun
from lidarpose.report.markup import Markup
from lidarpose.report.numbers import short
from lidarpose.report.page import PANEL_CLASSES, figure, legend_key
from lidarpose.report.svg import Axis, Chart, columns_of
from lidarpose.report.turn_numbers import LEAST_WEIGHT

KIND_WORDS: dict[Kind, str] = {"corners": "chessboard corners", "stripes": "stripe pixels", "ranges": "ranges"}
_SCALE: dict[Kind, float] = {"corners": 1.0, "stripes": 1.0, "ranges": 1e3}
_UNIT: dict[Kind, str] = {"corners": "px", "stripes": "px", "ranges": "mm"}


def residuals_by_place(run: TurntableRun, estimate: TurntableEstimate, kind: Kind) -> Markup | None:
    """Box plots of what is left over at each place, against the expected spread."""
    order = {place.position: k + 1 for k, place in enumerate(run.session.places)}
    used = [
        (order[str(g.position)], g.panel, _SCALE[kind] * g.values[(g.weights > LEAST_WEIGHT) & np.isfinite(g.values)])
        for g in estimate.residuals
        if g.kind == kind and str(g.position) in order
    ]
    rows = [row for row in used if len(row[2])]
    if not rows:
        return None
    sigma = _SCALE[kind] * estimate.noise[kind].sigma
    ends = np.concatenate([_quantiles(values, _BOX[[0, 4]]) for _, _, values in rows])
    reach = max(3.2 * sigma, float(np.percentile(np.abs(ends), 98.0)) * 1.08)
    last = max(order.values())

    def draw(width: float) -> Markup:
        # Too many boxes for the width become one box for several neighbouring places.
        together = max(1, int(np.ceil(last / (width / 8.5))))
        x = Axis("place, in the session's order" + (f" ({together} a box)" if together > 1 else ""), 0.3, last + 0.7)
        y = Axis(f"measured \u2212 predicted, {_UNIT[kind]}", -reach, reach)
        chart = Chart(width, 270.0, x, y, f"Residuals of {kind}")
        for times, class_ in ((2.0, "band2"), (1.0, "band")):
            chart.area([x.low, x.high], [-times * sigma] * 2, [times * sigma] * 2, class_)
        thick = float(np.clip(0.3 * (width - 70.0) * together / (last + 1), 1.2, 9.0))
        for panel, class_ in enumerate(PANEL_CLASSES):
            at, five = _boxes([(place, values) for place, k, values in rows if k == panel], together)
            at = at + (-0.2 if panel == 0 else 0.2) * together
            chart.sticks(at, five[:, 0], five[:, 4], f"{class_} mid", max(0.7, thick / 4.0))
            chart.sticks(at, five[:, 1], five[:, 3], class_, thick)
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
    if noise.rows_as_one > 1.5:
        caption += f" Neighbours resemble each other: {short(noise.rows_as_one)} are worth one."
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
        for k, class_ in enumerate(PANEL_CLASSES):
            start, end = pixels[panels == k], (pixels + enlarged * arrows)[panels == k]
            if len(start):
                gap = np.full((len(start), 1, 2), np.nan)
                path = np.concatenate([start[:, None], end[:, None], gap], axis=1).reshape(-1, 2)
                chart.line(*columns_of(path), f"thin {class_}")
                chart.points(*columns_of(start), class_, 1.2)
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
        chart.line(
            *columns_of(np.concatenate([middles[:, None], ends[:, None], gap], axis=1).reshape(-1, 2)), "thin lidar"
        )
        chart.points(*columns_of(middles), "lidar", 1.2)
        return chart.render()

    caption = (
        f"Means over regions of {cell:.0f} px, {enlarged:g} times enlarged (median {short(typical)} px). "
        "Neighbours that point the same way over a large part of a panel show a board that is not flat, or lens "
        "distortion that camera.yaml does not hold."
    )
    legend = [legend_key("line", "lidar", "mean shift of the stripes")]
    return figure("Stripes: directions of the residuals", draw, caption, legend)


def _boxes(rows: Sequence[tuple[int, FloatArray]], together: int) -> tuple[FloatArray, FloatArray]:
    """Where boxes stand (B,), and their 5, 25, 50, 75 and 95 % points (B, 5); `together` places a box."""
    groups: dict[int, list[FloatArray]] = {}
    for place, values in rows:
        groups.setdefault((place - 1) // together, []).append(values)
    at = np.array([1.0 + (k + 0.5) * together - 0.5 for k in groups])
    five = [_quantiles(np.concatenate(values), _BOX) for values in groups.values()]
    return at, np.array(five).reshape(-1, 5)


_BOX = np.array([0.05, 0.25, 0.5, 0.75, 0.95])


def _quantiles(values: FloatArray, shares: FloatArray) -> FloatArray:
    """As numpy's, of finite values, at a fraction of its overhead."""
    ordered = np.sort(values)
    at = shares * (len(ordered) - 1)
    below = at.astype(np.intp)
    low, high = ordered[below], ordered[np.minimum(below + 1, len(ordered) - 1)]
    return np.asarray(low + (high - low) * (at - below))


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
    finite = np.isfinite(np.concatenate(arrows)).all(axis=1)
    return np.concatenate(pixels)[finite], np.concatenate(arrows)[finite], np.concatenate(panels)[finite]


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
        use = (group.weights > LEAST_WEIGHT) & np.isfinite(group.values)
        where.append(stripe.pixels[use])
        arrows.append((group.values[:, None] * stripe.normals)[use])
    return np.concatenate(where), np.concatenate(arrows)


def _round_factor(factor: float) -> float:
    """1, 2 or 5 times a power of ten, not above `factor` (but at least 1)."""
    if factor <= 1.0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(factor))
    return float(max(m * power for m in (1.0, 2.0, 5.0) if m * power <= factor))
