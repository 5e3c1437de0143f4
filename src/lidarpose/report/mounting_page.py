"""The report of a mounting found from flatness: the surfaces, what they are off by, and how sure the mounting is."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray, perpendicular_pair
from lidarpose.geometry.se3 import Pose
from lidarpose.model.spun_scan import MountingRun, SurfacePoints
from lidarpose.report.answer import answer_section
from lidarpose.report.markup import Markup, el, join
from lidarpose.report.numbers import fixed, plural, short
from lidarpose.report.page import (
    FACE_CLASSES,
    Tile,
    Tone,
    Verdict,
    card,
    document,
    figure,
    footer,
    headline,
    legend_key,
    provenance_block,
    section,
    sentence,
    table,
    tiles,
    title_of,
    verdict_block,
)
from lidarpose.report.scene import Scene, scene_block
from lidarpose.report.svg import Axis, Chart

MIRROR_NOTE = (
    "Seen from where the axis points, the table is taken to turn anticlockwise as its readings grow. If yours turns "
    "clockwise, all that is scanned comes out as in a mirror, just as flat: give the beam that points the other way "
    "(--axis-beam-deg plus 180)."
)
_COLOURS = ("--p1", "--p2", "--lidar", "--axis")
_MOST_DRAWN = 6
_MOST_POINTS_A_SURFACE = 500
_BINS = 20
_LEAST_IN_BIN = 8
_WORDS = {
    "rx_rad": ("tilt about the table's x", "°"),
    "ry_rad": ("tilt about the table's y", "°"),
    "x_m": ("place along the table's x", "mm"),
    "y_m": ("place along the table's y", "mm"),
    "encoder_scale": ("factor on the readings", "%"),
    "range_offset_m": ("offset of the ranges", "mm"),
    "beam_angle_scale": ("factor on the beam angles", "%"),
}
_FACTOR = {"°": float(np.rad2deg(1.0)), "mm": 1e3, "%": 1e2}


def mounting_page(run: MountingRun, name: str) -> str:
    """The whole report as one HTML text that needs nothing else; `name` is the recording's."""
    seen = run.seen
    body = [
        verdict_block(mounting_verdict(run)),
        tiles(_tiles(run)),
        _scene_section(run),
        *([_residual_section(run, seen)] if seen is not None else []),
        answer_section(run.calibration, has_camera=False),
        section("The surfaces", "What was found flat, the largest first.", card("", _surface_table(run))),
        section("How sure", "Standard deviations, and what they are made of.", *_certainty(run)),
        section("What no scene can tell", "", card("", el("p", MIRROR_NOTE))),
        section("To repeat this run", "Inputs, versions and options.", provenance_block(run.calibration.provenance)),
        footer("Millimetres and degrees throughout; standard deviations are one sigma. This page needs no network."),
    ]
    return document(title_of(name), "mounting from flatness", body, _scene(run))


def mounting_verdict(run: MountingRun) -> Verdict:
    """The verdict in words, with reasons and steps."""
    quality = run.estimate.quality
    tone: Tone = quality.verdict
    figures = quality.figures
    claim = "The" if tone == "good" else "By its own figures the"
    say = (
        f"{claim} LiDAR's tilt against the table's axis is known to {short(figures['sigma_tilt_deg'])}° and its place "
        f"beside it to {short(figures['sigma_shift_mm'])} mm, from "
        f"{plural(len(run.estimate.surfaces), 'flat surface')} with {figures['returns']} returns."
    )
    return Verdict(tone, headline(tone), say, [sentence(text) for text in quality.reasons], list(_todo(run)))


def _todo(run: MountingRun) -> Iterator[str]:
    """Steps for the user; the reasons of the verdict name their own remedies, these are the rest."""
    if run.estimate.quality.verdict == "good":
        return
    if run.estimate.bend_m > 5e-4:
        yield "Record a room with more walls, or with straighter ones: bent walls tell little."
    if run.estimate.jumps:
        yield "Look at the table's drive at the sweeps that are named, and record again."
    yield "Use it for what its figures allow; mend what the reasons name before relying on more."


def _tiles(run: MountingRun) -> Iterator[Tile]:
    estimate, figures = run.estimate, run.estimate.quality.figures
    yield Tile("Tilt against the axis", f"±{short(figures['sigma_tilt_deg'])}", "°", "the larger of two")
    yield Tile("Place beside the axis", f"±{short(figures['sigma_shift_mm'])}", "mm", "the larger of two")
    yield Tile("Distance from the axis", fixed(1e3 * run.calibration.motion.radius_m, 1), "mm")
    yield Tile("Flat surfaces", str(len(estimate.surfaces)), "", f"{figures['returns']} of {run.returns} returns")
    yield Tile("Range noise found", short(figures["range_noise_mm"]), "mm", "of the typical return")
    yield Tile("Surfaces bulge by", short(1e3 * estimate.bend_m), "mm", "each of seven smooth shapes")
    yield Tile("Rounds", str(run.rounds), "", "of surfaces and mounting")


def _scene_section(run: MountingRun) -> Markup:
    drawn = min(len(run.estimate.surfaces), _MOST_DRAWN)
    legend = [
        *(legend_key("dot", _class(k), f"surface {k + 1}") for k in range(min(drawn, len(_COLOURS)))),
        legend_key("line", "bad", "turntable's axis"),
    ]
    caption = (
        "The recording's points on the surfaces, put together by the answer; colours repeat. Axes: x red, y green, z "
        "blue, of the LiDAR at reading 0. Drag to turn, pinch (or ctrl and wheel) to zoom."
    )
    return section("The room in 3D", "Does this look like the room?", scene_block("Room and rig", caption, legend))


def _class(k: int) -> str:
    return (*FACE_CLASSES, "axis-c")[k % len(_COLOURS)]


def _scene(run: MountingRun) -> dict[str, Any]:
    scene = Scene(up=(0.0, 0.0, 1.0))
    if run.seen is not None:
        for k in range(len(run.estimate.surfaces)):
            points = run.seen.points[run.seen.surface == k]
            shown = points[:: max(1, -(-len(points) // _MOST_POINTS_A_SURFACE))]
            scene.add("points", shown, _COLOURS[k % len(_COLOURS)], size=1.1)
            if k < _MOST_DRAWN:
                scene.label(points.mean(axis=0), str(k + 1))
    scene.add("line", [[0.0, 0.0, -0.3], [0.0, 0.0, 0.5]], "--bad", width=2)
    pose = run.estimate.T_table_lidar
    scene.axes(Pose(pose.rotation, pose.translation), 0.3)
    return scene.data(front=(0.0, 1.0, 0.0), view=(0.5, 0.6))


def _residual_section(run: MountingRun, seen: SurfacePoints) -> Markup:
    figures = [_residual_figure(run, seen, k) for k in range(min(len(run.estimate.surfaces), _MOST_DRAWN))]
    lead = (
        "What returns are off their plane by, averaged over strips across the surface: bars are two standard "
        "deviations of such a mean to either side. Flat surfaces and the right mounting leave all bars about zero; a "
        "curve means a bent surface, or a mounting that is off."
    )
    return section("What is left over", lead, *figures)


def _residual_figure(run: MountingRun, seen: SurfacePoints, k: int) -> Markup:
    mine = seen.surface == k
    points, off = seen.points[mine], 1e3 * seen.off_m[mine]
    axes = perpendicular_pair(run.estimate.surfaces[k].plane.normal)
    here = points - points.mean(axis=0)
    # Along the surface's own long and short side.
    flat = here @ np.stack(axes).T
    places = flat @ np.linalg.svd(flat - flat.mean(axis=0), full_matrices=False)[2].T
    strips = [_strips(places[:, axis], off) for axis in (0, 1)]
    reach = max(float(np.abs(s[:, 1:]).max(initial=0.0)) for s in strips)
    reach = max(1.1 * reach, 1e3 * run.estimate.surfaces[k].sigma_m, 0.1)
    width_m = max(float(np.abs(places).max()), 0.1)

    def draw(width: float) -> Markup:
        x, y = Axis("along the surface, m", -width_m, width_m), Axis("off the plane, mm", -reach, reach)
        chart = Chart(width, min(0.6 * width, 260.0), x, y, f"Surface {k + 1}, off its plane")
        chart.level(0.0, "ink thin")
        for strip, class_ in zip(strips, ("p1", "p2"), strict=True):
            chart.sticks(strip[:, 0], strip[:, 1], strip[:, 2], class_, 3.0)
        return chart.render()

    legend = [legend_key("box", "p1", "along its long side"), legend_key("box", "p2", "along its short side")]
    sigma = f"{short(1e3 * run.estimate.surfaces[k].sigma_m)} mm"
    return figure(f"Surface {k + 1}", draw, f"{mine.sum()} returns that spread by {sigma} along their beams.", legend)


def _strips(place: FloatArray, off: FloatArray) -> FloatArray:
    """Rows (B, 3) of strips with returns enough: middle, and the mean less and plus two of its standard deviations."""
    edges = np.linspace(float(place.min()), float(place.max()), _BINS + 1)
    index = np.clip(np.searchsorted(edges, place, side="right") - 1, 0, _BINS - 1)
    rows = []
    for b in range(_BINS):
        values = off[index == b]
        if len(values) >= _LEAST_IN_BIN:
            mean, error = float(values.mean()), float(values.std() / np.sqrt(len(values)))
            rows.append((0.5 * (edges[b] + edges[b + 1]), mean - 2.0 * error, mean + 2.0 * error))
    return np.array(rows).reshape(-1, 3)


def _surface_table(run: MountingRun) -> Markup:
    rows = [
        (
            str(k + 1),
            str(surface.returns),
            str(surface.used),
            short(1e3 * surface.sigma_m),
            short(surface.pull),
            f"({', '.join(fixed(float(v), 4) for v in surface.plane.normal)}) at {fixed(surface.plane.offset, 3)} m",
        )
        for k, surface in enumerate(run.estimate.surfaces)
    ]
    header = ("", "returns", "used", "mm", "pull", "normal and distance in the table's frame")
    note = el(
        "p",
        "Used: with more than half of the full weight. mm: the spread of ranges along their beams. Pull: by how many "
        "standard deviations a surface disagrees with the others about the mounting.",
        class_="muted",
    )
    return join((table(header, rows, numeric=(1, 2, 3, 4), stacked_em=4.4), note))


def _certainty(run: MountingRun) -> Iterator[Markup]:
    estimate = run.estimate
    total, noise = (np.sqrt(np.diag(c)) for c in (estimate.covariance, estimate.noise_covariance))
    rows = []
    for k, name in enumerate(estimate.parameter_names):
        words, unit = _WORDS[name]
        factor = _FACTOR[unit]
        rows.append((words, f"{short(factor * noise[k])} {unit}", f"{short(factor * total[k])} {unit}"))
    note = el(
        "p",
        "Noise: of single returns, and of what surfaces disagree about. Together: with what bent surfaces, a parameter "
        "that seems to be missing, and a turn of the table during sweeps that the scene leaves open may move it by.",
        class_="muted",
    )
    yield card("The mounting", table(("", "by noise", "together"), rows, numeric=(1, 2)), note)
    asked = table(("", "value", "σ", ""), _asked(run), numeric=(1, 2), stacked_em=6.6)
    yield card("What else was asked", asked)


def _asked(run: MountingRun) -> Iterator[tuple[str, str, str, str]]:
    for extra in run.estimate.extras:
        words, unit = _WORDS[extra.name]
        factor = _FACTOR[unit]
        state = "estimated" if extra.estimated else "seems to be missing" if extra.suggested else "left alone"
        yield words, f"{fixed(factor * extra.value, 3)} {unit}", f"{short(factor * extra.sigma)} {unit}", state
    if run.estimate.turning is not None:
        share, sigma = run.estimate.turning
        words = "turn during the sweeps that the readings leave out"
        yield words, f"{fixed(100.0 * share, 0)} %", f"{short(100.0 * sigma)} %", "0 or 100 %"
    scatter = run.estimate.reading_scatter_rad
    yield (
        "readings scatter by",
        f"{fixed(float(np.rad2deg(scatter)), 3)} °",
        "–",
        plural(len(run.estimate.jumps), "jump"),
    )
