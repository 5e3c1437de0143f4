"""The recording branch of `lidarpose calibrate`: a spun 2D LiDAR calibrated from the flat surfaces it sees."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from lidarpose.errors import InputError

if TYPE_CHECKING:
    from rich.console import Console

    from lidarpose.geometry.se3 import Pose
    from lidarpose.model.spun_scan import MountingRun

# As in `lidarpose.refine.flatness.EXTRA_NAMES`; what else `--estimate` knows needs a target.
_EXTRAS = {
    "encoder-scale": "encoder_scale",
    "range-offset": "range_offset_m",
    "beam-angle-scale": "beam_angle_scale",
}


def calibrate_recording(
    folder: Path,
    output: Path,
    *,
    axis_beam_deg: float | None,
    start: Path | None,
    never_stops: bool | None = None,
    estimate: tuple[str, ...] = (),
    want_mm: float | None = None,
    want_deg: float | None = None,
    report: bool = True,
    json: bool = False,
    quiet: bool = False,
) -> MountingRun:
    """Calibrate from a sweep recording and write `output`/calibration.json and `output`/report.html.

    Parameters
    ----------
    axis_beam_deg, start
        One of the two: the beam angle that points along the turntable's axis, or a calibration file that is roughly
        right.
    never_stops
        Readings are interpolated by the sweeps' times; False says that the table stops for each sweep, None nothing.
    estimate
        Extra parameters by their names on the command line.
    report
        Write the report too.

    Raises
    ------
    InputError
        For unreadable input, or without a start.
    UndeterminedError
        If the scene does not tell the mounting.
    """
    from lidarpose.cli.console import out, print_json, progress
    from lidarpose.refine.mounting_verdict import MountingOptions
    from lidarpose.report.mounting_page import mounting_page
    from lidarpose.storage.atomic import write_text
    from lidarpose.storage.calibration import write_calibration
    from lidarpose.storage.provenance import provenance
    from lidarpose.storage.recording import read_recording, recording_files
    from lidarpose.workflows.measuring import with_readings_between
    from lidarpose.workflows.self_calibration import MOST_ROUNDS, calibrate_by_flatness

    T_table_lidar = _start(axis_beam_deg, start)
    wishes = {k: v for k, v in (("want_mm", want_mm), ("want_deg", want_deg)) if v is not None}
    options = MountingOptions(
        tuple(_parameter(name) for name in estimate),
        want_mm if want_mm is not None else MountingOptions.want_mm,
        want_deg if want_deg is not None else MountingOptions.want_deg,
        sweeps_stated=never_stops is not None,
    )
    recording = read_recording(folder)
    if never_stops and not recording.has_reading_per_beam:
        recording = with_readings_between(recording)
    stated = {
        "axis_beam_deg": axis_beam_deg,
        "start": None if start is None else start.name,
        "never_stops": never_stops,
        "estimate": list(estimate),
        **wishes,
    }
    with progress("rounds", MOST_ROUNDS, quiet=quiet or json) as advance:
        run = calibrate_by_flatness(
            recording,
            T_table_lidar,
            options,
            provenance=provenance("calibrate", folder, recording_files(folder), stated),
            step=advance,
        )
    written = [output / "calibration.json"]
    write_calibration(written[0], run.calibration)
    if report:
        written.append(output / "report.html")
        write_text(written[1], mounting_page(run, recording.name))
    if json:
        print_json(summary(run))
    else:
        _print(out(), run, written)
    return run


def _parameter(name: str) -> str:
    if name not in _EXTRAS:
        raise InputError(
            f"--estimate {name}",
            "cannot be told from flat surfaces of unknown size and place",
            expected="for a sweep recording: " + ", ".join(_EXTRAS),
        )
    return _EXTRAS[name]


def _start(axis_beam_deg: float | None, start: Path | None) -> Pose:
    import math

    from lidarpose.storage.calibration import read_turntable_calibration
    from lidarpose.workflows.self_calibration import axis_in_fan

    if (axis_beam_deg is None) == (start is None):
        raise InputError(
            "--axis-beam-deg",
            "is missing" if start is None else "and --start are both given",
            expected="how the LiDAR is mounted, roughly, in one of two ways",
            remedy="Give the beam angle that points along the turntable's axis (--axis-beam-deg 90), or a calibration "
            "file of about that rig (--start FILE)",
        )
    if start is not None:
        return read_turntable_calibration(start).motion.T_turntable_lidar
    assert axis_beam_deg is not None
    return axis_in_fan(math.radians(axis_beam_deg))


def summary(run: MountingRun) -> dict[str, Any]:
    """The result as a JSON object; units in the keys."""
    from lidarpose.report.mounting_page import MIRROR_NOTE

    estimate, quality = run.estimate, run.estimate.quality
    return {
        "kind": "turntable",
        "verdict": quality.verdict,
        "reasons": list(quality.reasons),
        **quality.figures,
        "radius_mm": 1e3 * run.calibration.motion.radius_m,
        "axis_in_lidar": estimate.T_table_lidar.rotation[2].tolist(),
        "extras": [
            {
                "name": extra.name,
                "value": extra.value,
                "sigma": extra.sigma,
                "estimated": extra.estimated,
                "suggested": extra.suggested,
            }
            for extra in estimate.extras
        ],
        "planes": [
            {
                "normal": surface.plane.normal.tolist(),
                "offset_m": surface.plane.offset,
                "returns": surface.returns,
                "range_sigma_mm": 1e3 * surface.sigma_m,
                "pull": surface.pull,
            }
            for surface in estimate.surfaces
        ],
        "rounds": run.rounds,
        "notes": [MIRROR_NOTE],
    }


def _print(console: Console, run: MountingRun, written: list[Path]) -> None:
    from lidarpose.report.mounting_page import MIRROR_NOTE, mounting_verdict
    from lidarpose.report.summary import figures_table, print_verdict

    estimate = run.estimate
    print_verdict(console, mounting_verdict(run))
    x, y, z = estimate.T_table_lidar.rotation[2]
    radius_mm = 1e3 * run.calibration.motion.radius_m
    console.print(
        f"axis in the LiDAR's frame ({x:+.5f}, {y:+.5f}, {z:+.5f}); radius {radius_mm:.2f} mm", soft_wrap=True
    )
    rows = []
    for extra in estimate.extras:
        factor, unit = (1e3, "mm") if extra.name.endswith("_m") else (1e2, "%")
        state = "estimated" if extra.estimated else ("missing" if extra.suggested else "left alone")
        rows.append((extra.name, f"{factor * extra.value:.3f} {unit}", f"{factor * extra.sigma:.3f} {unit}", state))
    console.print(figures_table("Further parameters", ("value", "standard deviation", ""), rows))
    console.print(MIRROR_NOTE, markup=False, soft_wrap=True)
    for file in written:
        console.print(f"written: {file}", markup=False, soft_wrap=True)
