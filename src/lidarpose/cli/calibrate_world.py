"""The world branch of `lidarpose calibrate` and `lidarpose inspect`: corner sessions."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from lidarpose.geometry.se3 import Pose
    from lidarpose.model.calibration import WorldCalibration
    from lidarpose.model.corner_session import CornerSession
    from lidarpose.model.world_run import WorldRun


def calibrate_world_session(
    session_folder: Path,
    output: Path,
    *,
    method: str = "joint",
    estimate_scale: bool | None = None,
    want_mm: float | None = None,
    want_deg: float | None = None,
    seed: int = 0,
    report: bool = True,
    json: bool = False,
    quiet: bool = False,
    turntable: Path | None = None,
    never_stops: bool | None = None,
) -> WorldCalibration:
    """Calibrate a corner session and write `output`/calibration.json and `output`/report.html.

    Parameters
    ----------
    session_folder
        A folder whose session.toml has the format lidarpose/corner-session@1.
    output
        The folder to write to.
    method
        One of `lidarpose.workflows.world.WORLD_METHODS`.
    estimate_scale
        Overrules the session's own `estimate_scale`, if given.
    want_mm, want_deg
        Standard deviations that are good enough, in place of 5 mm and 0.1 degrees.
    seed
        For the random choices of detection.
    report
        Write the report too.
    json
        Print one JSON object in place of the summary.
    turntable
        The calibration of the turntable on which recordings among the clouds were made, in place of the session's own.
    never_stops
        It turned on during their sweeps; False and None: it stood still.

    Raises
    ------
    InputError
        For unreadable input, and methods that are not known.
    UndeterminedError
        If the data determine no pose.
    """
    from lidarpose.cli.console import progress
    from lidarpose.errors import InputError
    from lidarpose.storage.calibration import read_turntable_calibration, write_calibration
    from lidarpose.storage.corner_session import read_corner_session, session_provenance, truth_beside
    from lidarpose.workflows.recorded_corners import with_scans
    from lidarpose.workflows.world import WORLD_METHODS, world_run

    chosen = next((name for name in WORLD_METHODS if name == method), None)
    if chosen is None:
        raise InputError("--method", f"is {method!r}", expected="for a corner session: " + ", ".join(WORLD_METHODS))
    session = read_corner_session(session_folder)
    if (turntable is not None or never_stops is not None) and not session.has_recordings:
        stops = "--never-stops" if never_stops else "--stops"
        option = stops if turntable is None else "--turntable"
        raise InputError(option, "is for sweep recordings", expected="folders of recordings in the column clouds")
    if turntable is not None:
        session = replace(session, turntable=read_turntable_calibration(turntable))
    options = {
        "method": method,
        "estimate_scale": estimate_scale,
        "want_mm": want_mm,
        "want_deg": want_deg,
        "seed": seed,
        "turntable": None if turntable is None else str(turntable),
        "never_stops": bool(never_stops),
    }
    steps = len(session.places) + sum(len(p.clouds) for p in session.places)
    with progress("Reading clouds", steps, quiet=quiet or json) as advance:
        run = world_run(
            with_scans(session, never_stops=bool(never_stops)),
            chosen,
            estimate_scale=estimate_scale,
            wishes={k: v for k, v in (("want_mm", want_mm), ("want_deg", want_deg)) if v is not None},
            seed=seed,
            provenance=session_provenance(session_folder, session, options),
            tick=lambda: advance(),
        )
    calibration = run.calibration
    written = [output / "calibration.json"]
    write_calibration(written[0], calibration)
    if report:
        from lidarpose.report.world_page import world_page
        from lidarpose.storage.atomic import write_text

        written.append(output / "report.html")
        write_text(written[1], world_page(run))
    _print_result(run, truth_beside(session_folder), written, json)
    return calibration


def _print_result(run: WorldRun, truth: Pose | None, written: list[Path], json: bool) -> None:
    from lidarpose.cli.console import out, print_json
    from lidarpose.report.summary import print_verdict
    from lidarpose.report.world_page import world_verdict

    calibration = run.calibration
    if json:
        print_json(summary(calibration, truth))
        return
    console = out()
    print_verdict(console, world_verdict(run))
    lines = summary_lines(calibration)
    if truth is not None:
        metres, radians = calibration.T_world_source.distance(truth)
        lines.append(f"error against the truth beside the session: {1e3 * metres:.3f} mm, {radians * 57.29578:.4f} deg")
    for line in [*lines, *(f"written: {file}" for file in written)]:
        console.print(line, markup=False, soft_wrap=True)


def summary(calibration: WorldCalibration, truth: Pose | None) -> dict[str, Any]:
    """The result as a JSON object; units in the keys."""
    from lidarpose.storage.calibration import transform_entry

    quality = calibration.quality
    document: dict[str, Any] = {
        "kind": "world",
        "method": calibration.provenance.get("method"),
        "verdict": quality.verdict if quality else None,
        "reasons": list(quality.reasons) if quality else [],
        "transform": transform_entry("world", calibration.source, calibration.T_world_source, calibration.covariance),
        "scale": calibration.scale,
        **(quality.figures if quality else {}),
    }
    if truth is not None:
        metres, radians = calibration.T_world_source.distance(truth)
        document["error_against_truth"] = {"position_mm": 1e3 * metres, "rotation_deg": radians * 57.29577951308232}
    return document


def summary_lines(calibration: WorldCalibration) -> list[str]:
    """What a person wants to read of a world calibration: millimetres and degrees."""
    quality = calibration.quality
    figures: dict[str, Any] = dict(quality.figures) if quality else {}
    x, y, z = (1e3 * float(v) for v in calibration.T_world_source.translation)
    qx, qy, qz, qw = (float(v) for v in calibration.T_world_source.quaternion_xyzw)
    lines = [
        f"world <- {calibration.source}: ({x:.2f}, {y:.2f}, {z:.2f}) mm, "
        f"quaternion xyzw ({qx:.7f}, {qy:.7f}, {qz:.7f}, {qw:.7f})",
    ]
    if "sigma_position_mm" in figures:
        lines.append(
            f"standard deviations: {figures['sigma_position_mm']:.3g} mm, {figures['sigma_rotation_deg']:.3g} deg "
            f"(in the worst direction), from {figures.get('places_used', '?')} places"
        )
    if calibration.scale != 1.0:
        lines.append(f"scale: {calibration.scale:.6f}")
    if "range_sigma_mm" in figures:
        lines.append(f"range noise found: {figures['range_sigma_mm']:.2f} mm")
    if "ring_sigma_mm" in figures:
        largest = max(figures["ring_offsets_mm"].items(), key=lambda item: abs(item[1]))
        lines.append(
            f"rings are off by {figures['ring_sigma_mm']:.1f} mm (standard deviation), corrected; most the one at "
            f"{largest[0]} deg, {largest[1]:+.1f} mm"
        )
    crossing = figures.get("beam_crossing_left_out_mm")
    # A VLP-16's 42 mm would be seen with less.
    if crossing is not None and crossing["sigma"] > 10.0:
        lines.append(
            "whether the LiDAR's beams cross before its axis is left open by the data (standard deviation "
            f"{crossing['sigma']:.0f} mm): if its driver lets all beams start at one point, state beam_crossing_m"
        )
    return lines


def inspect_world_session(session_folder: Path) -> dict[str, Any]:
    """What is there, what is missing, and what will be badly determined, without opening a cloud.

    Raises
    ------
    InputError
        For unreadable input.
    """
    from lidarpose.storage.corner_session import read_corner_session

    session = read_corner_session(session_folder)
    return {
        "format": "lidarpose/corner-session@1",
        "places": [
            {
                "position": p.position,
                "corner_world_m": [float(x) for x in p.corner_world],
                "frames": len(p.clouds),
                "hint": p.near is not None,
            }
            for p in session.places
        ],
        "cloud_frame": session.cloud_frame,
        "warnings": [*layout_warnings(session), *_recording_warnings(session)],
    }


def _recording_warnings(session: CornerSession) -> list[str]:
    if session.turntable is None and session.has_recordings:
        return ["places hold sweep recordings: name turntable_calibration in session.toml, or give --turntable"]
    return []


def layout_warnings(session: CornerSession) -> list[str]:
    """What the places' layout will determine badly, whatever the clouds hold."""
    import numpy as np

    from lidarpose.errors import UndeterminedError
    from lidarpose.workflows.corner_target import check_layout, world_coordinates

    warnings = []
    try:
        check_layout(session)
    except UndeterminedError as error:
        return [error.what]
    world = world_coordinates(session)
    spread = np.linalg.svd(world - world.mean(axis=0), compute_uv=False) / np.sqrt(len(world))
    if spread[0] > 100.0:
        warnings.append(f"the places are {spread[0]:.0f} m apart: are the world coordinates in millimetres?")
    if spread[0] < 0.3:
        warnings.append(f"the places are close together ({spread[0]:.2f} m RMS): the rotation will be poor")
    if spread[1] < 0.15 * spread[0]:
        warnings.append("the places are nearly on one line: the rotation about it will be poor")
    if spread[2] < 0.02:
        warnings.append(
            "the places are in one plane: left-handed coordinates cannot be told; put one place at another height"
        )
    if session.world_sigma_m is None:
        warnings.append("world_sigma_m is not given: the noise of the world coordinates is estimated from the misfit")
    return warnings
