"""`lidarpose simulate scene`: a sweep recording of a scene of the user's own."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter, validators

from lidarpose.cli.options import FiniteFloat, PositiveFloat, WholeNumber
from lidarpose.errors import InputError

if TYPE_CHECKING:
    from lidarpose.model.turntable import TurntableMotion
    from lidarpose.simulate.surfaces import Surface
    from lidarpose.storage.scene import SceneFile

_MOST_BEAMS = 20_000_000


def simulate_scene(
    scene: Path,
    out: Path,
    /,
    *,
    calibration: Path | None = None,
    turntable_deg: Annotated[tuple[FiniteFloat, FiniteFloat], Parameter(negative="")] = (-15.0, 15.0),
    sweep_step_deg: PositiveFloat = 0.05,
    beams_deg: Annotated[tuple[FiniteFloat, FiniteFloat], Parameter(negative="")] = (-20.0, 20.0),
    beam_step_deg: PositiveFloat = 1.0 / 12.0,
    spot_m: PositiveFloat = 0.001,
    spot: Literal["even", "gaussian"] = "even",
    mixing: Literal["mean", "strongest", "first", "random", "dropped"] = "mean",
    range_sigma_m: Annotated[FiniteFloat, Parameter(validator=validators.Number(gte=0.0, lte=0.5))] = 0.001,
    dropout: Annotated[FiniteFloat, Parameter(validator=validators.Number(gte=0.0, lt=1.0))] = 0.0,
    seed: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0))] = 0,
    force: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Simulate a sweep recording of boxes, disks and planes that a scene file describes.

    Parameters
    ----------
    scene
        A scene file (docs/simulator.md): [[disks]], [[boxes]], [[planes]] in the camera's frame, metres.
    out
        The recording's folder; OUT.truth.json and OUT.calibration.json hold the true poses.
    calibration
        A turntable calibration to place the LiDAR by; otherwise one that looks along the camera's z.
    turntable_deg
        First and last reading.
    sweep_step_deg
        Between sweeps.
    beams_deg
        First and last beam of a sweep.
    beam_step_deg
        Between the beams of a sweep.
    spot_m
        Diameter of a beam's spot.
    spot
        How light is spread over the spot.
    mixing
        What a spot on two surfaces gives: the mean range by light, the surface with most light, the nearest, any range
        between, or nothing.
    range_sigma_m
        Noise along the beam.
    dropout
        Share of the beams without return.
    seed
        The same seed gives the same recording.
    force
        Replace a recording that no simulation wrote.
    """
    import numpy as np

    from lidarpose.cli.console import out as console
    from lidarpose.simulate.sweep_scene import BeamModel, SweepPlan, simulate_sweeps
    from lidarpose.storage.recording import write_simulated_recording
    from lidarpose.storage.scene import read_scene

    surfaces = _surfaces(read_scene(scene))
    motion = _motion(calibration)
    readings = _steps("--turntable-deg", turntable_deg, sweep_step_deg)
    beams = _steps("--beams-deg", beams_deg, beam_step_deg)
    if len(readings) * len(beams) > _MOST_BEAMS:
        found = f"{len(readings)} sweeps of {len(beams)} beams"
        raise InputError("--sweep-step-deg", found, expected=f"at most {_MOST_BEAMS} beams in all")
    beam = BeamModel(spot_m=spot_m, shape=spot, mixing=mixing, range_sigma_m=range_sigma_m, dropout=dropout)
    recording = simulate_sweeps(SweepPlan(motion, np.array(readings), np.array(beams), beam), surfaces, seed=seed)
    write_simulated_recording(out, recording, motion, force=force)
    hits = int(np.isfinite(recording.range_m).sum())
    console().print(f"{out}: {len(readings)} sweeps of {len(beams)} beams, {hits} returns", markup=False)


def _steps(option: str, ends: tuple[float, float], step: float) -> list[float]:
    low, high = ends
    if not low < high:
        raise InputError(option, f"is {low:g} to {high:g}", expected="first and last, growing")
    return [low + k * step for k in range(int((high - low) / step + 1e-9) + 1)]


def _motion(calibration: Path | None) -> TurntableMotion:
    from lidarpose.simulate.disk_scene import rig_motion
    from lidarpose.storage.calibration import read_turntable_calibration

    return rig_motion() if calibration is None else read_turntable_calibration(calibration).motion


def _surfaces(scene: SceneFile) -> list[Surface]:
    import numpy as np

    from lidarpose.simulate.surfaces import Box, Disk, Sheet

    surfaces: list[Surface] = [Disk(d.pose(), 0.5 * d.diameter_m, d.reflectivity) for d in scene.disks]
    surfaces += [Box(b.pose(), (b.size_m[0], b.size_m[1], b.size_m[2]), b.reflectivity) for b in scene.boxes]
    for plane in scene.planes:
        half = (np.inf, np.inf) if plane.size_m is None else (0.5 * plane.size_m[0], 0.5 * plane.size_m[1])
        holes = tuple((hole.centre_m[0], hole.centre_m[1], 0.5 * hole.diameter_m) for hole in plane.holes)
        surfaces.append(Sheet(plane.pose(), half, holes, plane.reflectivity))
    return surfaces
