"""The report of a world calibration: where the LiDAR is in the world, whether that is good, and why."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import UncertainPose, skew
from lidarpose.model.world_run import WorldRun
from lidarpose.report import world_figures as figures
from lidarpose.report.answer import answer_section
from lidarpose.report.markup import Markup, el
from lidarpose.report.numbers import fixed, short
from lidarpose.report.page import (
    FACE_CLASSES,
    Tile,
    Tone,
    Verdict,
    card,
    document,
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

DISTANCE_M = 5.0
_AXES = ("x", "y", "z")


def world_page(run: WorldRun) -> str:
    """The whole report as one HTML text that needs nothing else."""
    body = [
        verdict_block(world_verdict(run)),
        tiles(_tiles(run)),
        _scene_section(run),
        answer_section(run.calibration),
        *_figure_sections(run),
        _alignment_section(run),
        _left_out_section(run),
        section("To repeat this run", "Inputs, versions and options.", provenance_block(run.calibration.provenance)),
        footer("Millimetres and degrees throughout; standard deviations are one sigma. This page needs no network."),
    ]
    return document(title_of(run.session.name), "world calibration", body, figures.world_scene(run))


def world_verdict(run: WorldRun) -> Verdict:
    """The verdict in words, with reasons and steps."""
    quality = run.calibration.quality
    if quality is None:
        return Verdict("unknown", "No verdict", "How sure the pose is, is not known.")
    tone: Tone = quality.verdict
    return Verdict(tone, headline(tone), _say(run), [sentence(text) for text in quality.reasons], list(_todo(run)))


def _uncertain(run: WorldRun) -> UncertainPose | None:
    c = run.calibration
    return None if c.covariance is None else UncertainPose(c.T_world_source, c.covariance)


def _sigmas(run: WorldRun) -> tuple[float, float, float] | None:
    """Standard deviations in the worst direction: the sensor's centre (mm), its orientation (degrees), a point (mm)."""
    pose = _uncertain(run)
    if pose is None:
        return None
    centre = 1e3 * _largest(pose.centre_covariance())
    turn = float(np.rad2deg(_largest(pose.rotation_covariance())))
    return centre, turn, _point_mm(pose, DISTANCE_M)


def _largest(covariance: FloatArray) -> float:
    return float(np.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)))


def _point_mm(pose: UncertainPose, distance_m: float) -> float:
    """Standard deviation of a point at a distance from the sensor, over all axes, in the worst direction, mm."""
    worst = 0.0
    for direction in np.vstack([np.eye(3), -np.eye(3)]):
        point = pose.pose @ (distance_m * direction)
        J = np.hstack([np.eye(3), -skew(point)])
        worst = max(worst, float(np.trace(J @ pose.covariance @ J.T)))
    return 1e3 * float(np.sqrt(worst))


def _say(run: WorldRun) -> str:
    sigmas = _sigmas(run)
    if sigmas is None:
        return "How sure the pose is, is not known."
    sure = run.calibration.quality is not None and run.calibration.quality.verdict == "good"
    claim = "The" if sure else "By its own figures the"
    sensor = "LiDAR's centre" if run.calibration.source == "lidar" else "camera's centre"
    return (
        f"{claim} {sensor} is known to {short(sigmas[0])} mm in the world and its orientation to {short(sigmas[1])}°, "
        f"each in its worst direction; a point {DISTANCE_M:g} m away to {short(sigmas[2])} mm."
    )


def _todo(run: WorldRun) -> Iterator[str]:
    """Steps for the user; the reasons of the verdict name their own remedies, these are the rest."""
    quality = run.calibration.quality
    if quality is None or quality.verdict == "good":
        return
    residuals = np.array([np.linalg.norm(p.residual_world(run.calibration)) for p in run.places])
    second, largest = np.sort(residuals)[-2:] if len(residuals) >= 4 else (0.0, 0.0)
    # A wrong place pulls the others along: it need not stand out by much to be the one.
    if largest > max(1.7 * second, 0.005):
        worst = run.places[int(np.argmax(residuals))]
        yield (
            f"Look at place {worst.position} first: its corner misses by {1e3 * largest:.0f} mm, no other by more than "
            f"{1e3 * second:.0f} mm. Measure its world coordinates again, and check that the target was not turned "
            "there and that its clouds were recorded there; or calibrate without it."
        )
    if len(run.places) < 5:
        yield "Record five or more places, spread as widely as the target can still be seen well, at several heights."
    sigma = _sigmas(run)
    if sigma is not None and quality.verdict == "doubtful" and len(residuals) and residuals.max() < 0.01:
        yield "More frames at each place, larger faces or a nearer target lower the standard deviations."
    if quality.verdict == "rejected":
        yield "Correct what the reasons name and calibrate again; until then do not measure with this calibration.json."
    else:
        yield "Use it for what its figures allow; mend what the reasons name before relying on more."


def _tiles(run: WorldRun) -> Iterator[Tile]:
    sensor = "LiDAR" if run.calibration.source == "lidar" else "Camera"
    sigmas = _sigmas(run)
    found = _figures(run)
    if sigmas is not None:
        yield Tile(f"{sensor}'s centre", f"±{short(sigmas[0])}", "mm", "worst direction")
        yield Tile(f"{sensor}'s orientation", f"±{short(sigmas[1])}", "°", "worst direction")
        yield Tile(f"A point at {DISTANCE_M:g} m", f"±{short(sigmas[2])}", "mm", "from the pose alone")
    yield Tile("Places used", f"{found.get('places_used', len(run.places))} of {len(run.session.places)}")
    frames = sum(len(p.clouds) for p in run.session.places)
    yield Tile("Frames recorded", str(frames))
    if run.places:
        rms = np.sqrt(np.mean([float((p.residual_world(run.calibration) ** 2).sum()) for p in run.places]))
        yield Tile("Corners miss by", short(1e3 * float(rms)), "mm", "RMS over the places")
    if "range_sigma_mm" in found:
        stated = run.session.lidar.range_sigma_m
        than = f"stated {short(1e3 * stated)} mm" if stated else ""
        yield Tile("Range noise found", short(float(found["range_sigma_mm"])), "mm", than)
    if run.calibration.scale != 1.0:
        yield Tile("Scale", f"{run.calibration.scale:.5f}", "", "world over LiDAR")


def _figures(run: WorldRun) -> dict[str, Any]:
    return dict(run.calibration.quality.figures) if run.calibration.quality is not None else {}


def _scene_section(run: WorldRun) -> Markup:
    legend = [
        *(legend_key("dot", class_, f"face {k + 1}") for k, class_ in enumerate(FACE_CLASSES)),
        legend_key("cross", "bad", "measured corner"),
    ]
    caption = (
        "Drag to turn, pinch (or ctrl and wheel) to zoom. The target at every place with the points that were taken "
        "for its faces, put into the world by the answer; crosses are the corners as they were measured. "
        "Axes: x red, y green, z blue, at the sensor and at the world's origin."
    )
    return section(
        "The places in 3D", "Does this look like the room?", scene_block("Target and sensor", caption, legend)
    )


def _figure_sections(run: WorldRun) -> Iterator[Markup]:
    faces = figures.face_figures(run)
    if faces:
        lead = "The points of each face at one place, seen square on; the corner is where the lines meet."
        yield section("The target's faces", lead, *faces)
    if run.places:
        lead = "What corners and answer disagree by. One place that stands out was measured or recorded wrongly."
        boxes = figures.frame_boxes(run)
        content = [figures.corner_residuals(run), card("In numbers", _residual_table(run), size="wide")]
        yield section("What is left over", lead, *content, *([boxes] if boxes is not None else []))


def _residual_table(run: WorldRun) -> Markup:
    rows = []
    for place in run.places:
        r = 1e3 * place.residual_world(run.calibration)
        frames = f"{int(place.frame_used.sum())} of {len(place.frame_used)}" if len(place.frame_used) else "–"
        rows.append((place.position, *(fixed(v, 2) for v in r), fixed(float(np.linalg.norm(r)), 2), frames))
    return table(("place", "x mm", "y mm", "z mm", "all mm", "frames"), rows, numeric=range(1, 6))


def _alignment_section(run: WorldRun) -> Markup:
    rows = [(f"sensor's {axis} axis", *_to_axes(column)) for axis, column in zip(_AXES, _rotation(run).T, strict=True)]
    if run.normals is not None:
        turned = run.normals @ _rotation(run).T
        rows += [(f"normal of face {k + 1}", *_to_axes(normal)) for k, normal in enumerate(turned)]
    content = card("", table(("", "nearest world axis", "angle °"), rows, numeric=(2,)), *_face_angles(run))
    lead = "How the sensor and the target's faces stand in the world. A levelled face shows an angle near zero."
    return section("Alignment with the world's axes", lead, content)


def _rotation(run: WorldRun) -> FloatArray:
    return run.calibration.T_world_source.rotation


def _to_axes(direction: FloatArray) -> tuple[str, str]:
    k = int(np.argmax(np.abs(direction)))
    sign = "+" if direction[k] > 0.0 else "\u2212"
    across = float(np.linalg.norm(np.delete(direction, k)))
    return f"{sign}{_AXES[k]}", fixed(float(np.rad2deg(np.arctan2(across, abs(direction[k])))), 3)


def _face_angles(run: WorldRun) -> Iterator[Markup]:
    if run.normals is None:
        return
    pairs = ((0, 1), (0, 2), (1, 2))
    angles = [np.rad2deg(np.arccos(np.clip(run.normals[a] @ run.normals[b], -1.0, 1.0))) for a, b in pairs]
    words = ", ".join(f"{a + 1} and {b + 1}: {fixed(float(v), 3)}°" for (a, b), v in zip(pairs, angles, strict=True))
    yield el("p", f"Angles between the faces' normals: {words}.", class_="muted")


def _left_out_section(run: WorldRun) -> Markup:
    items = _figures(run).get("left_out", [])
    rows = [(str(item.get("what", "")), str(item.get("reason", ""))) for item in items if isinstance(item, dict)]
    if not rows:
        return section("Left out", "", card("", el("p", "Nothing was left out.")))
    return section("Left out", "What was not used, and why.", card("", table(("what", "reason"), rows)))
