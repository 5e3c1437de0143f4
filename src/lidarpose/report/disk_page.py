"""The report of a measured disk or round hole: its edge, its circle, and how sure its diameter is."""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.model.round_view import RoundView
from lidarpose.report.markup import Markup
from lidarpose.report.numbers import fixed, plural, short
from lidarpose.report.page import (
    Tile,
    Tone,
    Verdict,
    card,
    document,
    figure,
    footer,
    legend_key,
    section,
    sentence,
    table,
    tiles,
    title_of,
    verdict_block,
)
from lidarpose.report.scene import Scene, scene_block
from lidarpose.report.svg import Axis, Chart, columns_of

_MOST_POINTS = 4000


def disk_page(view: RoundView) -> str:
    """The whole report as one HTML text that needs nothing else."""
    body = [
        verdict_block(_verdict(view)),
        tiles(_tiles(view)),
        section("The edge", "What the diameter rests on.", _circle_figure(view), _edge_figure(view)),
        section("How sure", "What the standard deviation is made of.", card("", _parts(view))),
        _scene_section(view),
        footer("Millimetres throughout; standard deviations are one sigma. This page needs no network."),
    ]
    return document(title_of(view.name), f"measured {view.kind}", body, _scene(view))


def _verdict(view: RoundView) -> Verdict:
    value = f"{_to_sigma(1e3 * view.diameter_m, 1e3 * view.sigma_m)} mm, ±{short(1e3 * view.sigma_m)} mm"
    beams = plural(len(view.on) + len(view.off), "beam")
    covered = f"{100.0 * view.covered:.0f} %"
    say = f"The {view.kind}'s diameter from {beams} on it and about its edge, {covered} of which is free."
    tone: Tone = "doubtful" if view.remarks else "good"
    return Verdict(tone, f"Diameter {value}", say, [sentence(r) for r in view.remarks])


def _to_sigma(value: float, sigma: float) -> str:
    """A value with as many decimals as its standard deviation deserves: two digits of it."""
    return fixed(value, int(np.clip(1 - np.floor(np.log10(max(sigma, 1e-6))), 0, 4)))


def _tiles(view: RoundView) -> list[Tile]:
    gap = fixed(1e3 * (view.outermost_diameter_m - view.diameter_m), 2)
    centre = ", ".join(fixed(float(v), 4) for v in view.centre)
    sigma, flatness = short(1e3 * view.sigma_m), short(1e3 * view.plane_rms_m)
    diameter = _to_sigma(1e3 * view.diameter_m, 1e3 * view.sigma_m)
    return [
        Tile("Diameter", diameter, "mm", f"±{sigma} mm"),
        Tile("Circle of the outermost points", fixed(1e3 * view.outermost_diameter_m, 2), "mm", f"off by {gap} mm"),
        Tile("Edge that is free", f"{100.0 * view.covered:.0f}", "%", "determined by beams"),
        Tile("Flatness of the returns", flatness, "mm", f"RMS; centre at {centre} m ({view.frame})"),
    ]


def _circle_figure(view: RoundView) -> Markup:
    on, off = 1e3 * view.on, 1e3 * view.off
    radius = 500.0 * view.diameter_m
    turn = np.linspace(0.0, 2.0 * np.pi, 241)
    reach = 1.22 * radius
    shown = on[:: max(1, len(on) // _MOST_POINTS)]

    def draw(width: float) -> Markup:
        axes = Axis("mm from the centre", -reach, reach), Axis("mm", -reach, reach)
        chart = Chart(width, min(0.9 * width, 460.0), *axes, "The edge and its circle", equal=True)
        chart.points(*columns_of(shown), "p1 mid", 1.5)
        chart.crosses(*columns_of(off), "faint thin", 1.8)
        chart.line(radius * np.cos(turn), radius * np.sin(turn), "ink")
        chart.points([0.0], [0.0], "ink", 2.5)
        return chart.render()

    caption = (
        f"Where beams meet the plane of the {view.kind}, seen square on. The circle runs between those that came back "
        "from it and those that did not."
    )
    return figure("Beams and circle", draw, caption, _legend())


def _edge_figure(view: RoundView) -> Markup:
    radius = 500.0 * view.diameter_m
    rows = []
    for points, class_ in ((1e3 * view.on, "p1"), (1e3 * view.off, "faint")):
        out = np.linalg.norm(points, axis=1) - radius
        rows.append((np.rad2deg(np.arctan2(points[:, 1], points[:, 0])), out, class_))
    reach = max(1.1 * float(np.abs(rows[1][1]).max(initial=0.0)), 4.0)
    reach = min(reach, 0.4 * radius)
    sigma = 500.0 * view.sigma_m

    def draw(width: float) -> Markup:
        x = Axis("direction from the centre, degrees", -180.0, 180.0, ticks=tuple(range(-180, 181, 45)))
        y = Axis("outside the circle, mm", -reach, reach)
        chart = Chart(width, min(0.9 * width, 460.0), x, y, "The edge unrolled")
        for angle, out, class_ in rows:
            near = np.abs(out) <= reach
            if class_ == "p1":
                chart.points(angle[near], out[near], f"{class_} mid", 1.6)
            else:
                chart.crosses(angle[near], out[near], f"{class_} thin", 2.2)
        chart.area([-180.0, 180.0], [-sigma] * 2, [sigma] * 2, "band")
        chart.level(0.0, "ink thin")
        return chart.render()

    caption = (
        f"The edge unrolled. The band is the radius' standard deviation, ±{short(sigma)} mm. A beam just inside may be "
        "lost too, where only part of its spot is on the material. Returns beyond the line would show here, and so "
        "would a stretch without beams."
    )
    return figure("Along the edge", draw, caption, _legend())


def _legend() -> list[Markup]:
    return [
        legend_key("dot", "p1", "returned from it"),
        legend_key("cross", "faint", "did not"),
        legend_key("line", "ink", "circle"),
    ]


def _parts(view: RoundView) -> Markup:
    rows = [(name, f"{fixed(1e3 * value, 4)} mm") for name, value in view.sigma_parts_m.items()]
    rows.append(("together", f"{fixed(1e3 * view.sigma_m, 4)} mm"))
    return table(("part", "standard deviation of the diameter"), rows, numeric=(1,))


def _scene_section(view: RoundView) -> Markup:
    legend = [legend_key("dot", "p1", "returns"), legend_key("line", "bad", "circle and normal")]
    caption = f"The {view.kind} in the {view.frame} frame. Drag to turn, pinch (or ctrl and wheel) to zoom."
    return section("In 3D", "", scene_block(sentence(view.kind), caption, legend))


def _scene(view: RoundView) -> dict[str, Any]:
    scene = Scene(up=(0.0, -1.0, 0.0) if view.frame == "camera" else (0.0, 0.0, 1.0))
    radius = view.diameter_m / 2.0
    turn = np.linspace(0.0, 2.0 * np.pi, 121)
    rim = view.centre + radius * (np.cos(turn)[:, None] * view.axes[0] + np.sin(turn)[:, None] * view.axes[1])
    scene.add("points", view.points[:: max(1, len(view.points) // 1500)], "--p1", size=1.1)
    scene.add("line", rim, "--bad", width=2)
    scene.add("line", [view.centre, view.centre + radius * view.normal], "--bad", width=1.5)
    scene.label(view.centre, f"{fixed(1e3 * view.diameter_m, 2)} mm", "--bad")
    front = -view.normal if abs(float(view.normal @ scene.up)) < 0.95 else np.array([1.0, 0.0, 0.0])
    return scene.data(front=front.tolist(), view=(0.5, 0.3))
