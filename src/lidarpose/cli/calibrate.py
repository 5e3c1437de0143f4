"""``lidarpose calibrate``: a session becomes a calibration file and a report."""

from __future__ import annotations

from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from cyclopts import Parameter

from lidarpose.cli.options import FiniteFloat, Json, PositiveFloat, Quiet, only_for
from lidarpose.errors import InputError, RejectedError
from lidarpose.model.sense import Sense, StatedSense

if TYPE_CHECKING:
    from lidarpose.model.calibration import Quality
    from lidarpose.model.turntable_run import TruthError, TurntableRun

Methods = Literal["joint", "paper", "paper-approx", "ransac", "harris"]
Extra = Literal[
    "range-offset",
    "range-scale",
    "black-bias",
    "beam-angle-scale",
    "beam-angle-offset",
    "encoder-scale",
    "focal-scale",
]
_IN_METRES = ("range-offset", "black-bias")


def calibrate(
    session: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    method: Methods = "joint",
    first_panel: Annotated[Literal[1, 2] | None, Parameter(group="Turntable sessions")] = None,
    estimate: Annotated[tuple[Extra, ...], Parameter(negative=(), group="Turntable sessions")] = (),
    any_order: Annotated[bool, Parameter(negative=(), show_default=False, group="Turntable sessions")] = False,
    beams_turn: Annotated[Sense | None, Parameter(group="Turntable sessions")] = None,
    table_turns: Annotated[Sense | None, Parameter(group="Turntable sessions")] = None,
    estimate_scale: Annotated[bool, Parameter(negative=(), show_default=False, group="Corner sessions")] = False,
    turntable: Annotated[Path | None, Parameter(group="Corner sessions")] = None,
    axis_beam_deg: Annotated[FiniteFloat | None, Parameter(group="Sweep recordings")] = None,
    start: Annotated[Path | None, Parameter(group="Sweep recordings")] = None,
    never_stops: Annotated[bool | None, Parameter(negative="--stops", group="Sweep recordings")] = None,
    want_mm: PositiveFloat | None = None,
    want_deg: PositiveFloat | None = None,
    report: Annotated[bool, Parameter(negative="--no-report", show_default=False)] = True,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Find the LiDAR's pose from a session: DIR/calibration.json and DIR/report.html.

    The kind of session, turntable or corner, is told by its session.toml. A sweep recording of a room calibrates
    its own rig without camera and target: sought is the mounting at which what is flat is flat.

    Parameters
    ----------
    session
        The session's folder, or that of a sweep recording.
    output
        The folder for the results; made if it is not there.
    method
        joint: one maximum-likelihood estimate with its covariance and a verdict. paper: the closed forms of the paper
        that the session's kind comes from. paper-approx, ransac, harris: the corner paper's other rows.
    first_panel
        The panel (1 or 2, in the session's order) on which the scan line of smaller beam angle lies. Needed only
        where the data cannot tell.
    estimate
        Further parameters of the instrument to estimate; each is tested for being observable first.
        beam-angle-offset is refused with the reason: it is a turn of the LiDAR about its own z, which is estimated.
    any_order
        Accept turntable readings that are equal or go back and forth.
    beams_turn
        How the beam turns on your rig as beam angles grow, and where that is seen from: above (the image's upper
        edge), the camera, or the right of the image. Most LiDARs that stand upright: anticlockwise-from-above. A
        result that contradicts it is rejected: scans in reverse, or a LiDAR upside down, show in no residual.
    table_turns
        The same for the turntable as its readings grow: negated readings show in no residual either.
    estimate_scale
        Estimate the scale between the LiDAR's metres and the world's.
    turntable
        The calibration of the turntable on which sweep recordings among a corner session's clouds were made, in place
        of the one that the session names.
    axis_beam_deg
        The beam angle that points along the turntable's axis, to some degrees, where the fan of beams holds the axis.
    start
        A calibration that is right to some degrees and centimetres: how any other rig is mounted.
    never_stops
        The turntable turned on during the sweeps: interpolate its readings by time_s.npy. Scan with it, too. --stops:
        it stood still during each. With neither it is taken to stop, and what it would change if it did not is in the
        standard deviations where the scene leaves that open.
    want_mm
        Standard deviation of the LiDAR's centre that is good enough, in mm.
    want_deg
        Standard deviation of its orientation that is good enough, in degrees.
    report
        Write report.html too.
    """
    from lidarpose.storage.atomic import require_apart, require_writable_folder
    from lidarpose.storage.recording_head import is_recording
    from lidarpose.storage.session import CORNER_SESSION_FORMAT, session_format

    require_writable_folder(output)
    require_apart(output / "calibration.json", turntable, start)
    common: dict[str, Any] = {"want_mm": want_mm, "want_deg": want_deg, "report": report, "json": json, "quiet": quiet}
    of_turntables = {
        "--first-panel": first_panel is not None,
        "--any-order": any_order,
        "--beams-turn": beams_turn is not None,
        "--table-turns": table_turns is not None,
    }
    of_corners = {"--estimate-scale": estimate_scale, "--turntable": turntable is not None}
    of_recordings = {"--axis-beam-deg": axis_beam_deg is not None, "--start": start is not None}
    if is_recording(session):
        only_for("turntable sessions", of_turntables)
        only_for("corner sessions", of_corners)
        only_for("sessions", {"--method": method != "joint"}, "nothing: a recording has one method")
        from lidarpose.cli.calibrate_recording import calibrate_recording

        mounting: dict[str, Any] = {"axis_beam_deg": axis_beam_deg, "start": start, "estimate": estimate}
        calibrate_recording(session, output, never_stops=never_stops, **mounting, **common)
        return
    found = session_format(session)
    only_for("sweep recordings", of_recordings, "a folder with recording.toml")
    if found == CORNER_SESSION_FORMAT:
        only_for("turntable sessions", {**of_turntables, "--estimate": bool(estimate)})
        from lidarpose.cli.calibrate_world import calibrate_world_session

        wanted: dict[str, Any] = {"method": method, "estimate_scale": estimate_scale or None, "turntable": turntable}
        calibration = calibrate_world_session(session, output, never_stops=never_stops, **wanted, **common)
        _refuse_if_rejected(calibration.quality)
        return
    _require_turntable_session(session, found, method, estimate)
    only_for("corner sessions", of_corners)
    sweeps = {"--never-stops": never_stops is True, "--stops": never_stops is False}
    only_for("sweep recordings", sweeps, "a recording, or a corner session with recordings")
    options = {
        "method": method,
        "first_panel": first_panel,
        "estimate": list(estimate),
        "any_order": any_order,
        "beams_turn": beams_turn,
        "table_turns": table_turns,
        "want_mm": want_mm,
        "want_deg": want_deg,
    }
    run = _calibrate_turntable(session, options, with_report=report, quiet=quiet or json)
    _finish(run, session, output, with_report=report, json=json, quiet=quiet)


def _require_turntable_session(folder: Path, found: str, method: str, estimate: Sequence[str]) -> None:
    """Raise InputError for what is no turntable session, and for what none can tell."""
    from lidarpose.storage.session import CORNER_SESSION_FORMAT, SESSION_FORMAT

    if found != SESSION_FORMAT:
        expected = f'"{SESSION_FORMAT}" or "{CORNER_SESSION_FORMAT}"'
        raise InputError(folder / "session.toml", f"is {found!r}", field="format", expected=expected)
    if method not in ("joint", "paper"):
        raise InputError("--method", f"{method!r} is for corner sessions", expected="joint or paper")
    if "beam-angle-offset" in estimate:
        raise InputError(
            "--estimate beam-angle-offset",
            "cannot be told from a turn of the LiDAR about its own z axis, which every estimate contains: adding the "
            "same angle to all beams and turning the LiDAR back by it gives the same points",
            remedy="Leave it out: the result is right for beam angles as the scans state them",
        )


def _refuse_if_rejected(quality: Quality | None) -> None:
    """What was found is written and printed; a script that looks at the exit status alone must not go on."""
    if quality is not None and quality.verdict == "rejected":
        raise RejectedError("The calibration is rejected", reasons=quality.reasons)


def _calibrate_turntable(folder: Path, options: dict[str, Any], *, with_report: bool, quiet: bool) -> TurntableRun:
    from lidarpose.cli.console import progress
    from lidarpose.refine.joint_options import JointOptions
    from lidarpose.storage.session import read_turntable_session, session_files
    from lidarpose.workflows.turntable import calibrate_turntable

    session = read_turntable_session(folder, any_order=options["any_order"])
    first_panel = options["first_panel"]

    def record() -> dict[str, Any]:
        from lidarpose.storage.provenance import provenance

        _import_what_follows(with_report=with_report)
        return provenance("calibrate", folder, session_files(folder, session), options)

    wishes = {k: options[k] for k in ("want_mm", "want_deg") if options[k] is not None}
    with progress("images and scans", len(session.places), quiet=quiet) as advance:
        return calibrate_turntable(
            session,
            method=options["method"],
            first_panel=None if first_panel is None else first_panel - 1,
            options=JointOptions(estimate=tuple(_parameter_name(extra) for extra in options["estimate"]), **wishes),
            stated=StatedSense(options["beams_turn"], options["table_turns"]),
            provenance=record,
            step=advance,
        )


def _import_what_follows(*, with_report: bool) -> None:
    """Modules that are needed when the calibration is there, while other processes are still searching images."""
    report = ("lidarpose.report.turntable_page",) if with_report else ()
    files = ("lidarpose.storage.calibration", "lidarpose.storage.truth")
    for name in ("lidarpose.cli.turntable_summary", "rich.console", "rich.table", *files, *report):
        import_module(name)


def _parameter_name(extra: str) -> str:
    return extra.replace("-", "_") + ("_m" if extra in _IN_METRES else "")


def _finish(run: TurntableRun, folder: Path, output: Path, *, with_report: bool, json: bool, quiet: bool) -> None:
    from lidarpose.cli.console import err, out, print_json
    from lidarpose.cli.turntable_summary import print_summary, summary
    from lidarpose.storage.calibration import write_calibration
    from lidarpose.storage.truth import read_turntable_truth
    from lidarpose.workflows.turntable import error_against_truth

    truth = read_turntable_truth(folder)
    error: TruthError | None = None
    if truth is not None:
        error = error_against_truth(
            run.calibration.motion, truth, [place.turntable_angle_rad for place in run.session.places]
        )
    write_calibration(output / "calibration.json", run.calibration)
    if with_report:
        _write_report(run, output / "report.html", error)
    if json:
        print_json(summary(run, error))
    else:
        written = ["calibration.json", *(["report.html"] if with_report else [])]
        print_summary(out(), run, error, [output / name for name in written])
    if run.left_out and not (json or quiet):
        err().print(f"{len(run.left_out)} features or places were left out; the report lists them with their reasons.")
    _refuse_if_rejected(run.calibration.quality)


def _write_report(run: TurntableRun, path: Path, error: TruthError | None) -> None:
    from lidarpose.report.turntable_page import turntable_page
    from lidarpose.storage.atomic import write_text

    boards = {placement: sources[0].load() for placement, sources in run.session.board_images.items()}
    write_text(path, turntable_page(run, boards, truth=error))
