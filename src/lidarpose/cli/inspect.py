"""``lidarpose inspect``: what a session holds, lacks, and will determine badly, before anything is calibrated."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from lidarpose.cli.options import Json, Quiet, only_for
from lidarpose.errors import InputError, UndeterminedError
from lidarpose.model.sense import Sense, StatedSense

if TYPE_CHECKING:
    from lidarpose.model.session import TurntableSession
    from lidarpose.workflows.turntable_inspection import TurntableInspection


def inspect(
    session: Path,
    /,
    *,
    any_order: Annotated[bool, Parameter(negative=(), show_default=False)] = False,
    beams_turn: Sense | None = None,
    table_turns: Sense | None = None,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Say what is there, what is missing, and what will be badly determined.

    Of a turntable session the standard deviations come from the geometry alone: where board and LiDAR stand, and which
    readings were recorded. With them comes what would be weak, where, and what further recordings would bring.
    Nothing is written. The exit status is 1 if the session does not determine the pose.

    Parameters
    ----------
    session
        The session's folder, turntable or corner.
    any_order
        Accept turntable readings that are equal or go back and forth.
    beams_turn
        How the beam turns on your rig as beam angles grow, and where that is seen from; see `calibrate`.
    table_turns
        The same for the turntable as its readings grow.
    """
    from lidarpose.storage.recording_head import is_recording
    from lidarpose.storage.session import CORNER_SESSION_FORMAT, SESSION_FORMAT, session_format

    if is_recording(session):
        raise InputError(
            session,
            "is a sweep recording",
            expected="a turntable or corner session",
            remedy="`lidarpose calibrate` with --axis-beam-deg says how well a recording determines its mounting.",
        )
    found = session_format(session)
    if found == CORNER_SESSION_FORMAT:
        given = {
            "--any-order": any_order,
            "--beams-turn": beams_turn is not None,
            "--table-turns": table_turns is not None,
        }
        only_for("turntable sessions", given)
        _inspect_corners(session, json=json)
    elif found == SESSION_FORMAT:
        _inspect_turntable(
            session, any_order=any_order, stated=StatedSense(beams_turn, table_turns), json=json, quiet=quiet
        )
    else:
        expected = f'"{SESSION_FORMAT}" or "{CORNER_SESSION_FORMAT}"'
        raise InputError(session / "session.toml", f"is {found!r}", field="format", expected=expected)


def _inspect_corners(folder: Path, *, json: bool) -> None:
    from lidarpose.cli.calibrate_world import inspect_world_session
    from lidarpose.cli.console import out, print_json

    document = inspect_world_session(folder)
    if json:
        print_json(document)
        return
    console = out()
    frames = [place["frames"] for place in document["places"]]
    console.print(f"corner session: {len(frames)} places, {sum(frames)} clouds, frame {document['cloud_frame']}")
    for warning in document["warnings"]:
        console.print(f"  - {warning}", markup=False)


def _inspect_turntable(folder: Path, *, any_order: bool, stated: StatedSense, json: bool, quiet: bool) -> None:
    from lidarpose.cli.console import out, print_json, progress
    from lidarpose.storage.session import read_turntable_session
    from lidarpose.workflows.turntable_inspection import inspect_turntable

    session = read_turntable_session(folder, any_order=any_order)
    with progress("images and scans", len(session.places), quiet=quiet or json) as advance:
        inspection = inspect_turntable(session, stated=stated, step=advance)
    if json:
        print_json(_document(session, inspection))
    else:
        for line in _lines(session, inspection):
            out().print(line, markup=False, soft_wrap=True)
    if inspection.undetermined is not None:
        raise UndeterminedError(inspection.undetermined.what, remedy=inspection.undetermined.remedy)


def _document(session: TurntableSession, inspection: TurntableInspection) -> dict[str, Any]:
    return {
        "kind": "turntable",
        "places": len(session.places),
        "readings_deg": {"first": inspection.first_deg, "last": inspection.last_deg, "arc": inspection.arc_deg},
        "placements": {name: len(shots) for name, shots in session.board_images.items()},
        "panels": [
            {"columns": p.columns, "rows": p.rows, "square_m": p.square_m, "corner_sigma_px": sigma}
            for p, sigma in zip(session.panels, inspection.corner_sigma_px or [None] * len(session.panels), strict=True)
        ],
        "places_with_stripes": inspection.places_with_stripes,
        "places_with_lines": inspection.places_with_lines,
        "places_used": inspection.places_used,
        "determined": inspection.undetermined is None,
        "expected_sigma": [
            {"angle_deg": angle, "centre_mm": centre, "rotation_deg": rotation}
            for angle, centre, rotation in inspection.expected_sigma
        ],
        "weak": [
            {"what": d.name, "angle_deg": d.angle_deg, "mm": d.sigma_mm, "deg": d.sigma_deg, "remedy": d.remedy}
            for d in inspection.weak
        ],
        "remedies": [
            {
                "what": r.what,
                "inside": {"centre_mm": r.inside_mm, "rotation_deg": r.inside_deg},
                "half_a_turn_away": {"centre_mm": r.half_turn_mm, "rotation_deg": r.half_turn_deg},
            }
            for r in inspection.remedies
        ],
        "sense": inspection.sense,
        "problems": list(inspection.problems),
        "left_out": [{"what": item.what, "reason": item.reason} for item in inspection.left_out],
    }


def _lines(session: TurntableSession, inspection: TurntableInspection) -> list[str]:
    shots = sum(len(images) for images in session.board_images.values())
    panels = " and ".join(f"{p.columns} x {p.rows} of {1e3 * p.square_m:g} mm" for p in session.panels)
    lines = [
        f"camera: {session.camera.width} x {session.camera.height}, {session.camera.model}",
        f"board: {panels}; {shots} bright images, {len(session.board_images)} placement(s)",
        f"places: {len(session.places)}, readings {inspection.first_deg:g} to {inspection.last_deg:g} deg",
        f"found: stripes on every panel at {inspection.places_with_stripes} places, "
        f"scan lines at {inspection.places_with_lines}, {inspection.places_used} places usable",
    ]
    lines += [
        f"expected sigma, from the geometry, at {angle:8.2f} deg: {centre:7.3f} mm {rotation:8.4f} deg"
        for angle, centre, rotation in inspection.expected_sigma
    ]
    lines += [
        f"weak: {d.name}: {d.sigma_mm:.3f} mm, {d.sigma_deg:.4f} deg at {d.angle_deg:.0f} deg. {d.remedy}"
        for k, d in enumerate(inspection.weak[:3])
        if d.name not in {worse.name for worse in inspection.weak[:k]}
    ]
    lines += [
        f"would be with {r.what}: {r.inside_mm:.3f} mm {r.inside_deg:.4f} deg amid the readings, "
        f"{r.half_turn_mm:.3f} mm {r.half_turn_deg:.4f} deg half a turn away"
        for r in inspection.remedies
    ]
    lines += [f"sense: {inspection.sense}"] if inspection.sense else []
    lines += [f"problem: {problem}" for problem in inspection.problems]
    lines += [f"left out: {item.what}: {item.reason}" for item in inspection.left_out[:20]]
    if len(inspection.left_out) > 20:
        lines.append(f"left out: {len(inspection.left_out) - 20} more; --json lists all")
    return lines
