"""What `calibrate` prints of a turntable session: a table for people, an object for programs."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from rich.console import Console

    from lidarpose.model.calibration import Verdict
    from lidarpose.model.turntable_run import Deviation, TruthError, TurntableRun

_COLOURS: dict[Verdict, str] = {"good": "bold green", "doubtful": "bold yellow", "rejected": "bold red"}


def summary(run: TurntableRun, error: TruthError | None) -> dict[str, Any]:
    """The result as a JSON object; units in the keys."""
    quality = run.calibration.quality
    document: dict[str, Any] = {
        "kind": "turntable",
        "method": run.method,
        "verdict": None if quality is None else quality.verdict,
        "reasons": [] if quality is None else list(quality.reasons),
        "places": {"recorded": len(run.session.places), "used": len(run.samples)},
        "radius_mm": 1e3 * run.calibration.motion.radius_m,
        "table_1": {
            "centre_mm": _pair(run.deviation.centre_mm),
            "z_deg": _pair(run.deviation.z_deg),
            "x_deg": _pair(run.deviation.x_deg),
        },
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


def print_summary(console: Console, run: TurntableRun, error: TruthError | None, output: Path) -> None:
    """The result for a person: deviations, standard deviations, error against a known truth, verdict with reasons."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    console.print(f"{len(run.samples)} of {len(run.session.places)} places used, method {run.method}")
    table = Table(box=SIMPLE_HEAD, title="Deviation of the motion from its samples (Table 1)", title_justify="left")
    for column in ("", "mean", "largest"):
        table.add_column(column, justify="right" if column else "left")
    for name, deviation, digits in (
        ("LiDAR's centre / mm", run.deviation.centre_mm, 2),
        ("z axis / deg", run.deviation.z_deg, 3),
        ("x axis / deg", run.deviation.x_deg, 3),
    ):
        table.add_row(name, f"{deviation.mean:.{digits}f}", f"{deviation.largest:.{digits}f}")
    console.print(table)
    _print_sigmas(console, run)
    if error is not None:
        _print_truth(console, error)
    quality = run.calibration.quality
    if quality is not None:
        console.print(f"verdict: [{_COLOURS[quality.verdict]}]{quality.verdict}[/]")
        for reason in quality.reasons:
            console.print(f"  - {reason}", markup=False)
    for note in run.notes:
        console.print(f"note: {note}", markup=False)
    console.print(f"written: {output / 'calibration.json'}", markup=False, soft_wrap=True)


def _print_sigmas(console: Console, run: TurntableRun) -> None:
    rows = sigma_rows(run)
    for (angle, centre, rotation), where in zip(
        rows, ("start", "middle", "end of the arc", "a quarter turn on", "half a turn on"), strict=False
    ):
        console.print(f"sigma at {angle:8.2f} deg: {centre:7.3f} mm {rotation:8.4f} deg   ({where})")


def _print_truth(console: Console, error: TruthError) -> None:
    for name, centre, rotation in (
        ("over the arc", error.arc_centre_mm, error.arc_rotation_deg),
        ("over the turn", error.turn_centre_mm, error.turn_rotation_deg),
    ):
        console.print(
            f"error against truth {name}: mean {centre.mean:.3f} mm {rotation.mean:.4f} deg, "
            f"largest {centre.largest:.3f} mm {rotation.largest:.4f} deg",
            soft_wrap=True,
        )


def _pair(deviation: Deviation) -> dict[str, float]:
    return {"mean": deviation.mean, "largest": deviation.largest}
