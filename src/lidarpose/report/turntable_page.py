"""The report of a turntable calibration: first whether it is good, then everything to see why."""

from __future__ import annotations

from collections.abc import Iterator, Mapping

import numpy as np

from lidarpose.model.image import GrayImage
from lidarpose.model.session import DEFAULT_PLACEMENT
from lidarpose.model.turntable import PARAMETER_NAMES
from lidarpose.model.turntable_result import KINDS, Direction, TurntableEstimate
from lidarpose.model.turntable_run import TruthError, TurntableRun
from lidarpose.report import turntable_certainty as certainty
from lidarpose.report import turntable_residuals as residuals
from lidarpose.report import turntable_seen as seen
from lidarpose.report.answer import answer_section
from lidarpose.report.markup import Markup, el
from lidarpose.report.numbers import fixed, plural, short
from lidarpose.report.page import (
    Tile,
    Tone,
    Verdict,
    card,
    document,
    folded,
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
from lidarpose.report.scene import scene_block
from lidarpose.report.turn_numbers import TurnNumbers, arc_deg, turn_numbers, used_positions
from lidarpose.report.turntable_advice import left_out_summary, todo
from lidarpose.report.turntable_scene import turntable_scene

BoardImages = Mapping[str, GrayImage]


def turntable_page(
    run: TurntableRun,
    board_image: GrayImage | BoardImages | None = None,
    *,
    truth: TruthError | None = None,
) -> str:
    """The whole report as one HTML text that needs nothing else.

    Parameters
    ----------
    run
        The calibration with its evidence. One scan of its session is read for a figure.
    board_image
        The board in bright light: one image, or one by placement; None where there is none at hand.
    truth
        Errors against a known truth, for simulated sessions.
    """
    numbers = turn_numbers(run)
    body = [
        verdict_block(turntable_verdict(run, numbers)),
        tiles(_tiles(run, numbers)),
        *_truth_section(truth),
        _rig_section(run),
        answer_section(run.calibration, 0.5 * sum(arc_deg(run))),
        _seen_section(run, board_image),
        *_residual_sections(run),
        *_certainty_sections(run, numbers),
        _left_out_section(run),
        _paper_section(run),
        section("To repeat this run", "Inputs, versions and options.", provenance_block(run.calibration.provenance)),
        footer("Millimetres and degrees throughout; standard deviations are one sigma. This page needs no network."),
    ]
    return document(title_of(run.session.name), "turntable calibration", body, turntable_scene(run))


def turntable_verdict(run: TurntableRun, numbers: TurnNumbers | None = None) -> Verdict:
    """The verdict in words, with reasons and steps."""
    quality = run.calibration.quality
    found = numbers or turn_numbers(run)
    if quality is None:
        say = "The paper's closed form gives the pose, but not how sure it is. Calibrate with the joint method to know."
        return Verdict("unknown", "No verdict", say, run.notes, ())
    tone: Tone = quality.verdict
    reasons = tuple(sentence(text) for text in (*quality.reasons, *run.notes))
    return Verdict(tone, headline(tone), _say(run, found), reasons, todo(run))


def wished(run: TurntableRun) -> tuple[float | None, float | None]:
    """What standard deviations were wished inside the arc, mm and degrees; None where nothing was."""
    found = run.calibration.quality.figures if run.calibration.quality is not None else {}
    return _number(found.get("want_mm")), _number(found.get("want_deg"))


def _number(value: object) -> float | None:
    return float(value) if isinstance(value, (int, float)) and np.isfinite(value) else None


def _say(run: TurntableRun, numbers: TurnNumbers | None) -> str:
    if numbers is None:
        return "How sure the pose is, is not known."
    inside, around = numbers.worst(numbers.centre_mm)
    inside_deg, around_deg = numbers.worst(numbers.rotation_deg)
    low, high = arc_deg(run)
    sure = run.calibration.quality is not None and run.calibration.quality.verdict == "good"
    claim = "The" if sure else "By its own figures the"
    return (
        f"{claim} LiDAR's centre is known to {short(inside)} mm and its orientation to {short(inside_deg)}° within the "
        f"recorded arc ({fixed(low, 1)}° to {fixed(high, 1)}°), and to {short(around)} mm and {short(around_deg)}° "
        "anywhere on the turn."
    )


def _tiles(run: TurntableRun, numbers: TurnNumbers | None) -> Iterator[Tile]:
    if numbers is not None:
        want_mm, want_deg = wished(run)
        inside, around = numbers.worst(numbers.centre_mm)
        yield Tile("LiDAR's centre, in the arc", f"±{short(inside)}", "mm", *_against(run, inside, want_mm, "mm"))
        yield Tile("LiDAR's centre, whole turn", f"±{short(around)}", "mm", "worst reading")
        inside, around = numbers.worst(numbers.rotation_deg)
        yield Tile("Orientation, in the arc", f"±{short(inside)}", "°", *_against(run, inside, want_deg, "°"))
        yield Tile("Orientation, whole turn", f"±{short(around)}", "°", "worst reading")
        for distance, values in sorted(numbers.point_mm.items()):
            inside, around = numbers.worst(values)
            than = f"in the arc; ±{short(around)} mm on the turn"
            yield Tile(f"A scanned point at {distance:g} m", f"±{short(inside)}", "mm", than)
    total = len(run.session.places)
    used = len(used_positions(run))
    partly = used - len(used_positions(run, wholly=True))
    than = f"{partly} of them in part; {_arc_words(run)}" if partly else _arc_words(run)
    yield Tile("Places used", f"{used} of {total}", "", than)
    yield Tile(
        "Radius of the LiDAR's circle", fixed(1e3 * run.calibration.motion.radius_m, 2), "mm", _radius_words(run)
    )


def _against(run: TurntableRun, value: float, wish: float | None, unit: str) -> tuple[str, bool | None]:
    """A figure against the wish. It counts as met only where the verdict lets it be believed."""
    if wish is None:
        return "", None
    gap = "" if unit == "°" else " "
    if value > wish:
        return f"misses the wish of {short(wish)}{gap}{unit}", False
    good = run.calibration.quality is not None and run.calibration.quality.verdict == "good"
    return f"within the wish of {short(wish)}{gap}{unit}", True if good else None


def _arc_words(run: TurntableRun) -> str:
    low, high = arc_deg(run)
    return f"over {fixed(high - low, 1)}° of the turn"


def _radius_words(run: TurntableRun) -> str:
    covariance = run.calibration.motion_covariance
    return "" if covariance is None else f"±{short(1e3 * float(np.sqrt(max(covariance[6, 6], 0.0))))} mm"


def _truth_section(truth: TruthError | None) -> Iterator[Markup]:
    if truth is None:
        return
    rows = []
    for words, centre, rotation in (
        ("over the recorded readings", truth.arc_centre_mm, truth.arc_rotation_deg),
        ("over the whole turn", truth.turn_centre_mm, truth.turn_rotation_deg),
    ):
        rows.append((f"centre {words}, mm", fixed(centre.mean, 3), fixed(centre.largest, 3)))
        rows.append((f"orientation {words}, °", fixed(rotation.mean, 4), fixed(rotation.largest, 4)))
    content = card("", table(("", "mean", "largest"), rows, numeric=(1, 2)))
    yield section("Error against the truth", "This session is simulated, so the truth is known.", content)


def _rig_section(run: TurntableRun) -> Markup:
    legend = [
        legend_key("box", "p1 soft", "panel 1"),
        legend_key("box", "p2 soft", "panel 2"),
        legend_key("line", "axis-c", "turntable's axis"),
        legend_key("line", "lidar", "LiDAR: recorded arc, scan points"),
        legend_key("dash", "lidar", "its whole circle"),
    ]
    caption = (
        "Drag to turn, pinch (or ctrl and wheel) to zoom. The slider turns the table: the LiDAR moves along its circle "
        "with the fan of beams that met the board. Axes: x red, y green, z blue."
    )
    low, high = arc_deg(run)
    first = float((0.5 * (low + high) + 180.0) % 360.0 - 180.0)
    block = scene_block("Camera, board, turntable and LiDAR", caption, legend, slider=(first, "Reading"))
    return section("The rig in 3D", "Does this look like what stood in the room?", block)


def _seen_section(run: TurntableRun, board_image: GrayImage | BoardImages | None) -> Markup:
    blocks = []
    for placement in run.observations.corners:
        if isinstance(board_image, Mapping):
            image = board_image.get(placement)
        else:
            image = board_image if placement in (DEFAULT_PLACEMENT, next(iter(run.observations.corners))) else None
        blocks.append(seen.board_figure(run, placement, image))
    return section("What was found", "", *blocks, *seen.scan_figures(run))


def _residual_sections(run: TurntableRun) -> Iterator[Markup]:
    estimate = run.estimate
    if estimate is None:
        return
    blocks = [
        *(residuals.residuals_by_place(run, estimate, kind) for kind in ("stripes", "ranges")),
        *(residuals.residual_histogram(estimate, kind) for kind in KINDS),
        residuals.corner_arrows(run, estimate),
        residuals.stripe_map(run, estimate),
    ]
    lead = (
        "What measurements and answer differ by. Sound residuals look like noise: no place, region or kind stands out."
    )
    yield section("What is left over", lead, *(block for block in blocks if block is not None))


def _certainty_sections(run: TurntableRun, numbers: TurnNumbers | None) -> Iterator[Markup]:
    if numbers is None:
        yield section("How sure", "", card("", el("p", "This method gives no standard deviations.")))
        return
    lead = "Surest near the recorded arc; the far side of the turn follows from the axis, and is less sure."
    yield section(
        "How sure, over the turn",
        lead,
        *certainty.turn_figures(run, numbers, wished(run)),
        *certainty.ellipse_figures(run),
        card("In numbers", _table(numbers)),
    )
    if run.estimate is not None and run.estimate.directions:
        yield section(
            "Strong and weak directions",
            "What the recording determines worst, and what to record to mend it.",
            card("", _directions(run.estimate), folded("All ten numbers of the motion", _ten_numbers(run))),
            *_extras(run.estimate),
        )


def _table(numbers: TurnNumbers) -> Markup:
    rows = [("LiDAR's centre, mm", numbers.centre_mm), ("orientation, °", numbers.rotation_deg)]
    rows += [(f"scanned point at {d:g} m, mm", values) for d, values in sorted(numbers.point_mm.items())]
    cells = [(words, *(short(v) for v in numbers.worst(values))) for words, values in rows]
    return table(("standard deviation", "in the arc", "whole turn"), cells, numeric=(1, 2))


def _directions(estimate: TurntableEstimate) -> Markup:
    largest = max(_weight(d) for d in estimate.directions)
    rows = []
    for direction in estimate.directions:
        share = 100.0 * _weight(direction) / max(largest, 1e-300)
        bar = el("span", class_="bar", style=f"width:{max(share, 1.0):.1f}%")
        rows.append(
            (
                el("span", direction.name, bar),
                short(direction.sigma_mm),
                short(direction.sigma_deg, 2),
                f"{fixed(direction.angle_deg, 0)}°",
                direction.remedy or "–",
            )
        )
    header = ("direction, weakest first", "mm", "°", "at", "to mend it")
    return table(header, rows, numeric=(1, 2, 3), stacked_em=4.4)


def _ten_numbers(run: TurntableRun) -> Markup:
    """What each number of the motion is known to, the best first."""
    covariance = run.calibration.motion_covariance
    assert covariance is not None
    rows = []
    for k, name in enumerate(PARAMETER_NAMES):
        sigma = float(np.sqrt(max(covariance[k, k], 0.0)))
        length = name.endswith("_m")
        size = 1e3 * sigma if length else float(np.rad2deg(sigma))
        words = name.removesuffix("_m").removesuffix("_rad")
        rows.append((size if length else 10.0 * size, words, f"{short(size)} {'mm' if length else '°'}"))
    listed = [(el("code", words), value) for _, words, value in sorted(rows)]
    note = "Small changes of the two transforms: shift along and turn about the parent frame's axes, and the radius."
    return el("div", table(("number", "standard deviation"), listed, numeric=(1,)), el("p", note, class_="muted"))


def _weight(direction: Direction) -> float:
    """One millimetre weighs as a tenth of a degree."""
    return direction.sigma_mm + 10.0 * direction.sigma_deg


def _extras(estimate: TurntableEstimate) -> Iterator[Markup]:
    shown = [e for e in estimate.extras if e.observable or e.estimated]
    if not shown:
        return
    rows = []
    for e in shown:
        suffix = e.name.rsplit("_", 1)[-1]
        scale, unit = {"m": (1e3, "mm"), "px": (1.0, "px")}.get(suffix, (100.0, "%"))
        state = "estimated" if e.estimated else "called for by the residuals" if e.suggested else "tested, not needed"
        rows.append(
            (
                e.name.removesuffix("_m").removesuffix("_px").replace("_", " "),
                f"{short(scale * e.value)} {unit}",
                f"±{short(scale * e.sigma)} {unit}",
                f"{state}. {e.note}" if e.note else state,
            )
        )
    content = table(("parameter", "value", "σ", ""), rows, numeric=(1, 2), stacked_em=6.6)
    yield card("Instrument errors that were tested or estimated", content)


def _left_out_section(run: TurntableRun) -> Markup:
    groups = left_out_summary(run)
    if not groups:
        return section("Left out", "", card("", el("p", "Nothing was left out.")))
    rows = []
    for reason, what in groups:
        listed: object = ", ".join(what)
        if len(what) > 8:
            listed = folded(f"{', '.join(what[:4])} and {len(what) - 4} more", el("p", ", ".join(what)))
        rows.append((str(len(what)), reason, listed))
    content = table(("", "reason", "what"), rows, numeric=(0,))
    return section("Left out", "What was not used, or only with a small weight.", card("", content))


def _paper_section(run: TurntableRun) -> Markup:
    d = run.deviation
    if d is None:
        text = "No stripe was seen, so no place has a pose of its own, and the paper's method cannot be used."
        return section("Agreement with the paper's method", "", card("", el("p", text)))
    rows = [
        ("LiDAR's centre, mm", fixed(d.centre_mm.mean, 3), fixed(d.centre_mm.largest, 3)),
        ("z axis, °", fixed(d.z_deg.mean, 4), fixed(d.z_deg.largest, 4)),
        ("x axis, °", fixed(d.x_deg.mean, 4), fixed(d.x_deg.largest, 4)),
    ]
    note = (
        f"Deviation of the motion from {plural(len(run.samples), 'single pose')} that one place alone gives. "
        "It says how well the places agree with one motion; it is not an error against the truth."
    )
    blocks = [
        card("Table 1 of the turntable paper", el("p", note), table(("", "mean", "largest"), rows, (1, 2)), size="half")
    ]
    deviation = certainty.deviation_figure(run)
    if deviation is not None:
        blocks.append(deviation)
    if run.method == "joint":
        blocks.append(card("This answer and the paper's closed form", _against_paper(run)))
    return section("Agreement with the paper's method", "", *blocks)


def _against_paper(run: TurntableRun) -> Markup:
    low, high = (float(np.deg2rad(v)) for v in arc_deg(run))
    middle = 0.5 * (low + high)
    rows = []
    for words, angles in (
        ("in the recorded arc", np.linspace(low, high, 9)),
        ("over the whole turn", middle + np.linspace(-np.pi, np.pi, 37)),
    ):
        apart = [run.calibration.pose(a).distance(run.paper_motion.pose(a)) for a in angles]
        rows.append((words, short(1e3 * max(a for a, _ in apart)), short(float(np.rad2deg(max(b for _, b in apart))))))
    return el(
        "div",
        table(("largest distance", "mm", "°"), rows, numeric=(1, 2)),
        el("p", "The closed form takes each place by itself, this answer all measurements at once.", class_="muted"),
    )
