"""What `calibrate` prints of a turntable session: a table for people, an object for programs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lidarpose.report.summary import figures_table, print_verdict
from lidarpose.report.turntable_page import turntable_verdict

if TYPE_CHECKING:
    from rich.console import Console

    from lidarpose.model.turntable_run import Deviation, FunctionDeviation, TruthError, TurntableRun


def summary(run: TurntableRun, error: TruthError | None) -> dict[str, Any]:
    """The result as a JSON object; units in the keys."""
    quality = run.calibration.quality
    axis = run.calibration.axis_sigma()
    document: dict[str, Any] = {
        "kind": "turntable",
        "method": run.method,
        "verdict": None if quality is None else quality.verdict,
        "reasons": [] if quality is None else list(quality.reasons),
        "places": {"recorded": len(run.session.places), "used": places_used(run)},
        "radius_mm": 1e3 * run.calibration.motion.radius_m,
        "axis_direction_camera": run.calibration.motion.axis_direction_camera.tolist(),
        "axis_sigma": None if axis is None else {"radius_mm": 1e3 * axis[0], "tilt_deg": float(np.rad2deg(axis[1]))},
        "table_1": None if run.deviation is None else _table_1(run.deviation),
        "sigma": [
            {"angle_deg": angle, "centre_mm": centre, "rotation_deg": rotation}
            for angle, centre, rotation in sigma_rows(run)
        ],
        "left_out": [{"what": item.what, "reason": item.reason} for item in run.left_out],
        "notes": list(run.notes),
    }
    if error is not None:
        document["error_against_truth"] = {
            "arc": {"centre_mm": _pair(error.arc_centre_mm), "rotation_deg": _pair(error.arc_rotation_deg)},
            "turn": {"centre_mm": _pair(error.turn_centre_mm), "rotation_deg": _pair(error.turn_rotation_deg)},
        }
    return document


def places_used(run: TurntableRun) -> int:
    """Places that the answer rests on."""
    return len(run.samples) if run.samples else len(run.observations.places)


def _table_1(deviation: FunctionDeviation) -> dict[str, Any]:
    return {
        "centre_mm": _pair(deviation.centre_mm),
        "z_deg": _pair(deviation.z_deg),
        "x_deg": _pair(deviation.x_deg),
    }


def _print_deviation(console: Console, found: FunctionDeviation) -> None:
    rows = [
        (name, f"{deviation.mean:.{digits}f}", f"{deviation.largest:.{digits}f}")
        for name, deviation, digits in (
            ("LiDAR's centre / mm", found.centre_mm, 2),
            ("z axis / deg", found.z_deg, 3),
            ("x axis / deg", found.x_deg, 3),
        )
    ]
    console.print(figures_table("Deviation from the single places (the paper's Table 1)", ("mean", "largest"), rows))


def sigma_rows(run: TurntableRun) -> list[tuple[float, float, float]]:
    """Reading in degrees, sigma of the LiDAR's centre in mm, of its rotation in degrees: in the arc, and across it."""
    readings = [place.turntable_angle_rad for place in run.session.places]
    middle = 0.5 * (min(readings) + max(readings))
    rows = []
    for angle in (min(readings), middle, max(readings), middle + np.pi / 2, middle + np.pi):
        uncertain = run.calibration.uncertain_pose(float(angle))
        if uncertain is not None:
            centre = 1e3 * float(np.sqrt(np.trace(uncertain.centre_covariance())))
            rotation = float(np.rad2deg(np.sqrt(np.trace(uncertain.rotation_covariance()))))
            rows.append((float(np.rad2deg(angle)), centre, rotation))
    return rows


def print_summary(console: Console, run: TurntableRun, error: TruthError | None, written: Sequence[Path]) -> None:
    """The result for a person: the verdict with its reasons and what to do, then the figures."""
    print_verdict(console, turntable_verdict(run))
    _print_sigmas(console, run)
    if run.deviation is not None:
        _print_deviation(console, run.deviation)
    if error is not None:
        _print_truth(console, error)
    console.print(f"{places_used(run)} of {len(run.session.places)} places used, method {run.method}")
    for file in written:
        console.print(f"written: {file}", markup=False, soft_wrap=True)


def _print_sigmas(console: Console, run: TurntableRun) -> None:
    where = ("start of the arc", "its middle", "its end", "a quarter turn on", "half a turn on")
    rows = [
        (name, f"{angle:.2f}", f"{centre:.3f}", f"{rotation:.4f}")
        for name, (angle, centre, rotation) in zip(where, sigma_rows(run), strict=False)
    ]
    if rows:
        console.print(figures_table("Standard deviations", ("reading / deg", "centre / mm", "rotation / deg"), rows))
    axis, motion = run.calibration.axis_sigma(), run.calibration.motion
    if axis is not None:
        x, y, z = motion.axis_direction_camera
        console.print(
            f"axis in the camera frame ({x:+.5f}, {y:+.5f}, {z:+.5f}), tilt known to {np.rad2deg(axis[1]):.4f} deg; "
            f"radius {1e3 * motion.radius_m:.3f} mm, known to {1e3 * axis[0]:.3f} mm",
            soft_wrap=True,
        )


def _print_truth(console: Console, error: TruthError) -> None:
    rows = [
        (name, f"{c.mean:.3f}", f"{c.largest:.3f}", f"{r.mean:.4f}", f"{r.largest:.4f}")
        for name, c, r in (
            ("over the arc", error.arc_centre_mm, error.arc_rotation_deg),
            ("over the turn", error.turn_centre_mm, error.turn_rotation_deg),
        )
    ]
    columns = ("centre / mm", "largest", "rotation / deg", "largest")
    console.print(figures_table("Error against the truth", columns, rows))


def _pair(deviation: Deviation) -> dict[str, float]:
    return {"mean": deviation.mean, "largest": deviation.largest}
