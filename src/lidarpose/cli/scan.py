"""`lidarpose scan`: a sweep recording and a calibration become a cloud."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lidarpose.cli.options import Json

if TYPE_CHECKING:
    from lidarpose.model.calibration import TurntableCalibration
    from lidarpose.model.recording import SweepRecording


def scan(
    recording: Path,
    calibration: Path,
    /,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    world: Path | None = None,
    nearest_m: float = 0.0,
    farthest_m: float = math.inf,
    drop_mixed: Annotated[bool, Parameter(negative=())] = False,
    sigma: Annotated[bool, Parameter(negative=())] = False,
    indices: Annotated[bool, Parameter(negative=())] = False,
    keep_order: Annotated[bool, Parameter(negative=())] = False,
    never_stops: Annotated[bool, Parameter(negative=())] = False,
    json: Json = False,
) -> None:
    """Turn a sweep recording into a 3D cloud in the camera frame, or in the world's.

    Parameters
    ----------
    recording
        Folder of the sweep recording.
    calibration
        The turntable's calibration file.
    output
        The cloud to write: .ply .pcd .las .laz .e57 .npy; .npy is a plain (N, 3) array, without intensity, unless
        --sigma or --indices ask for more.
    world
        A world calibration for the camera frame; puts the cloud in the world's frame.
    nearest_m
        Leave out ranges below this.
    farthest_m
        Leave out ranges beyond this.
    drop_mixed
        Leave out mixed pixels: points that hang between two surfaces.
    sigma
        Give each point its standard deviation, field sigma_m.
    indices
        Give each point its sweep and beam.
    keep_order
        Keep beams without return as NaN points, in the recording's order (.ply, .pcd and .npy).
    never_stops
        The turntable turned on during the sweeps: interpolate its readings by time_s.npy.
    """
    from lidarpose.cli.console import out, print_json, progress
    from lidarpose.storage.atomic import require_apart
    from lidarpose.storage.calibration import read_turntable_calibration, read_world_calibration
    from lidarpose.storage.clouds import open_cloud_writer
    from lidarpose.storage.recording import read_recording, recording_files, release_pages
    from lidarpose.workflows.scanning import POINTS_PER_PART, ScanOptions, assemble_scan

    _check_gate(nearest_m, farthest_m)
    require_apart(output, calibration, world, *recording_files(recording))
    sweeps = read_recording(recording)
    turntable = read_turntable_calibration(calibration)
    world_calibration = None if world is None else read_world_calibration(world)
    # An array of plain numbers is what numpy.load is expected to give, unless more than points was asked for.
    plain = output.suffix.lower() == ".npy" and not (sigma or indices)
    options = ScanOptions(
        nearest_m, farthest_m, drop_mixed, sigma, indices, keep_order, never_stops, intensity=not plain
    )
    remarks = _remarks(sigma, turntable, sweeps)
    points = 0
    with (
        open_cloud_writer(output, fields=options.fields(sweeps)) as writer,
        progress("points", sweeps.range_m.size, quiet=json) as advance,
    ):
        done = 0
        for cloud in assemble_scan(sweeps, turntable, options, world_calibration):
            writer.append(cloud)
            points += len(cloud)
            release_pages(sweeps)
            step = min(POINTS_PER_PART, sweeps.range_m.size - done)
            done += step
            advance(step)
        _require_points(points, sweeps.range_m.size, nearest_m, farthest_m)
    frame = "camera" if world is None else "world"
    if json:
        print_json(
            {"cloud": str(output), "points": points, "beams": sweeps.range_m.size, "frame": frame, "remarks": remarks}
        )
        return
    for remark in remarks:
        out().print(f"Note: {remark}", markup=False, soft_wrap=True)
    out().print(f"{points} points of {sweeps.range_m.size} beams in the {frame} frame: {output}")


def _check_gate(nearest_m: float, farthest_m: float) -> None:
    from lidarpose.errors import InputError

    if not (math.isfinite(nearest_m) and nearest_m >= 0.0):
        raise InputError("--nearest-m", f"is {nearest_m:g}", expected="metres, not negative")
    if math.isnan(farthest_m) or farthest_m <= nearest_m:
        raise InputError("--farthest-m", f"is {farthest_m:g}", expected=f"metres beyond --nearest-m ({nearest_m:g})")


def _require_points(points: int, beams: int, nearest_m: float, farthest_m: float) -> None:
    """Refuse to write a cloud without points."""
    from lidarpose.errors import InputError, UndeterminedError

    if points > 0:
        return
    if nearest_m > 0.0 or math.isfinite(farthest_m):
        raise InputError(
            "--nearest-m, --farthest-m",
            f"none of the {beams} beams has a return between {nearest_m:g} and {farthest_m:g} m",
            expected="metres between which something stands (1500 mm are 1.5)",
        )
    remedy = "Record it again, with something within the LiDAR's reach."
    raise UndeterminedError(f"None of the recording's {beams} beams has a return", remedy=remedy)


def _remarks(sigma: bool, calibration: TurntableCalibration, recording: SweepRecording) -> list[str]:
    caution = None if calibration.quality is None else calibration.quality.caution
    remarks = [] if caution is None else [caution]
    if sigma and calibration.motion_covariance is None:
        remarks.append("the calibration carries no covariance; sigma_m holds the range noise alone")
    if sigma and recording.lidar.range_sigma_m is None:
        remarks.append("recording.toml names no lidar.range_sigma_m; sigma_m holds no range noise")
    return remarks
