"""`lidarpose simulate turntable`: a turntable session made up, with its truth beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter, validators

from lidarpose.cli.options import FiniteFloat, Json, PositiveFloat, Quiet, WholeNumber
from lidarpose.model.rig_family import Family


def simulate_turntable(
    out: Path,
    /,
    *,
    seed: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0))] = 0,
    family: Family = "paper",
    places: Annotated[WholeNumber | None, Parameter(validator=validators.Number(gte=1, lte=10_000))] = None,
    step_deg: PositiveFloat | None = None,
    start_deg: FiniteFloat | None = None,
    range_sigma_mm: Annotated[FiniteFloat, Parameter(validator=validators.Number(gte=0.0, lte=500.0))] = 1.0,
    width: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=200, lte=10_000))] = 1624,
    height: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=150, lte=10_000))] = 1234,
    placements: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=1, lte=20))] = 1,
    board_shots: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=1, lte=100))] = 3,
    sweeps: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=1, lte=1000))] = 1,
    stripe: bool = True,
    lit_stripes: Annotated[bool, Parameter(negative=())] = False,
    saturated: Annotated[bool, Parameter(negative=())] = False,
    noise_free: Annotated[bool, Parameter(negative=())] = False,
    force: Annotated[bool, Parameter(negative=())] = False,
    json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Simulate a session of a LiDAR on a turntable before a camera and a V board of two chessboards.

    Parameters
    ----------
    out
        The session's folder; OUT.truth.json holds the true poses.
    seed
        The same seed gives the same session.
    family
        What is out of the ordinary; "paper" is the turntable paper's set-up, "mixed" draws everything freely.
    places
        Stops of the turntable; 87 unless the family says otherwise.
    step_deg
        Degrees between stops; unless given, the stops share an arc of 21.5 degrees.
    start_deg
        The turntable's first reading.
    range_sigma_mm
        Noise along the beam.
    width
        Of the images, in pixels.
    height
        Likewise.
    placements
        How often the board is put up; each is seen from all stops.
    board_shots
        Bright images of each placement.
    sweeps
        Sweeps in each scan.
    stripe
        Whether the camera sees the laser.
    lit_stripes
        Take the stripe images in bright light.
    saturated
        Expose the stripe far too long.
    noise_free
        No noise, blunders or lost beams: scans are exact, images rounded to whole levels.
    force
        Replace a session that no simulation wrote.
    """
    from dataclasses import replace

    from lidarpose.cli.console import out as console
    from lidarpose.cli.console import print_json, progress
    from lidarpose.simulate.lidar import LidarBehaviour
    from lidarpose.simulate.rig import draw_rig
    from lidarpose.simulate.session import SimulationOptions, draw_photography, simulate_session
    from lidarpose.storage.session_writer import count_files, write_turntable_session
    from lidarpose.storage.truth import truth_path

    rig = draw_rig(
        seed,
        family=family,
        places=places,
        step_deg=step_deg,
        start_deg=start_deg,
        range_sigma_m=1e-3 * range_sigma_mm,
        placements=placements,
        size=(width, height),
    )
    photography = draw_photography(seed)
    options = SimulationOptions(
        photography=replace(photography, stripe_level=1000.0) if saturated else photography,
        lidar=LidarBehaviour(sweeps=sweeps),
        board_shots=board_shots,
        with_stripe=stripe,
        lit_stripes=lit_stripes,
        noise_free=noise_free,
    )
    simulated = simulate_session(rig, seed, options)
    with progress("Simulating", count_files(simulated.session), quiet=quiet or json) as advance:
        write_turntable_session(out, simulated.session, truth=simulated.truth, force=force, step=advance)
    if json:
        print_json(_summary(out, simulated.truth))
    elif not quiet:
        text = f"{out}: {len(rig)} places, family {family}, seed {seed}; truth in {truth_path(out)}"
        console().print(text, soft_wrap=True, markup=False)


def _summary(out: Path, truth: dict[str, Any]) -> dict[str, Any]:
    from lidarpose.storage.truth import truth_path

    return {
        "session": str(out),
        "truth": str(truth_path(out)),
        "family": truth["family"],
        "seed": truth["seed"],
        "places": len(truth["places"]),
        "radius_mm": 1e3 * truth["transforms"][1]["translation_m"][0],
        "first_angle_deg": truth["places"][0]["turntable_angle_deg"],
        "last_angle_deg": truth["places"][-1]["turntable_angle_deg"],
    }
