"""`lidarpose simulate disk`: a sweep recording of a disk made up, with its truth and its calibration beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from lidarpose.cli.options import WholeNumber

Share = Annotated[float, Parameter(validator=validators.Number(gte=0.0, lt=1.0))]
Tilt = Annotated[float, Parameter(validator=validators.Number(gte=0.0, lte=75.0))]


def simulate_disk(
    out: Path,
    /,
    *,
    diameter_m: Annotated[float, Parameter(validator=validators.Number(gte=0.01, lte=2.0))] = 0.14,
    distance_m: Annotated[float, Parameter(validator=validators.Number(gte=0.2, lte=20.0))] = 1.5,
    tilt_deg: Tilt = 15.0,
    tilt_direction_deg: Annotated[float, Parameter(validator=validators.Number(gte=-360.0, lte=360.0))] = 30.0,
    background: Literal["wall", "near", "none"] = "wall",
    stand: bool = False,
    cover: bool = False,
    spot_m: Annotated[float, Parameter(validator=validators.Number(gte=0.0, lte=0.1))] = 0.001,
    spot: Literal["even", "gaussian"] = "even",
    mixing: Literal["mean", "strongest", "first", "random", "dropped"] = "mean",
    range_sigma_m: Annotated[float, Parameter(validator=validators.Number(gte=0.0, lte=0.1))] = 0.001,
    dropout: Share = 0.0,
    beam_step_deg: Annotated[float, Parameter(validator=validators.Number(gte=0.005, lte=2.0))] = 1.0 / 12.0,
    sweep_step_deg: Annotated[float, Parameter(validator=validators.Number(gte=0.005, lte=2.0))] = 0.05,
    seed: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0))] = 0,
    force: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Simulate a sweep recording of a disk, as in the turntable paper's section 3.2.

    Parameters
    ----------
    out
        The recording's folder; OUT.truth.json and OUT.calibration.json hold the disk and the true calibration.
    diameter_m
        Of the disk.
    distance_m
        From the LiDAR to the disk.
    tilt_deg
        Between the disk's normal and the line of sight.
    tilt_direction_deg
        About which direction it is tilted.
    background
        A wall 0.6 m behind, one 60 mm behind, or nothing.
    stand
        Put the disk on a post that is flush with its lower part.
    cover
        Put a post before it.
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
    beam_step_deg
        Between the beams of a sweep.
    sweep_step_deg
        Between sweeps.
    seed
        The same seed gives the same recording.
    force
        Replace a recording that no simulation wrote.
    """
    from lidarpose.cli.console import out as console
    from lidarpose.simulate.disk_scene import DiskScene, disk_pose, rig_motion
    from lidarpose.simulate.disk_scene import simulate_disk as simulate
    from lidarpose.simulate.sweep_scene import BeamModel
    from lidarpose.storage.recording import write_simulated_recording

    beam = BeamModel(spot_m=spot_m, shape=spot, mixing=mixing, range_sigma_m=range_sigma_m, dropout=dropout)
    scene = DiskScene(
        diameter_m=diameter_m,
        distance_m=distance_m,
        tilt_deg=tilt_deg,
        tilt_direction_deg=tilt_direction_deg,
        background=background,
        stand=stand,
        cover=cover,
        beam=beam,
        beam_step_deg=beam_step_deg,
        sweep_step_deg=sweep_step_deg,
    )
    motion = rig_motion()
    recording = simulate(scene, motion, seed=seed)
    pose = disk_pose(scene, motion)
    truth = {
        "diameter_mm": 1e3 * diameter_m,
        "centre_m": pose.translation.tolist(),
        "normal": (-pose.rotation[:, 2]).tolist(),
    }
    write_simulated_recording(out, recording, motion, truth, force=force)
    sweeps, beams = recording.range_m.shape
    console().print(f"{out}: {sweeps} sweeps of {beams} beams; truth in {out}.truth.json")
