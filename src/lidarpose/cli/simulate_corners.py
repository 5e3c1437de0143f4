"""`lidarpose simulate corners`: a corner session made up, with its truth beside it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter, validators

from lidarpose.cli.options import WholeNumber


def simulate_corners(
    out: Path,
    /,
    *,
    pose: Literal["1", "2", "arrow"] = "1",
    lidar: Literal["hdl32", "vlp16", "turntable"] = "hdl32",
    target: Literal["cube", "arrow", "oblique", "concave"] | None = None,
    frames: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=1, lte=1000))] = 20,
    places: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=1, lte=100))] = 6,
    clutter: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0, lte=100))] = 0,
    room: bool = False,
    hints: bool = False,
    range_sigma_m: Annotated[float, Parameter(validator=validators.Number(gte=0.0, lte=0.5))] = 0.008,
    world_sigma_m: Annotated[float, Parameter(validator=validators.Number(gte=0.0, lte=1.0))] = 0.0,
    dropout: Annotated[float, Parameter(validator=validators.Number(gte=0.0, lt=1.0))] = 0.02,
    seed: Annotated[WholeNumber, Parameter(validator=validators.Number(gte=0))] = 0,
    suffix: Literal[".pcd", ".ply", ".las", ".laz", ".e57", ".npy"] = ".pcd",
    force: Annotated[bool, Parameter(negative=())] = False,
) -> None:
    """Simulate a session in which a target of three faces is moved from place to place.

    Parameters
    ----------
    out
        The session's folder; OUT.truth.json holds the true pose and corners.
    pose
        A case of the corner paper: its cube at pose 1 or 2, or its arrow, whose faces are not perpendicular.
    lidar
        The instrument.
    target
        Another target than the case's own.
    frames
        Frames recorded at each place.
    places
        How many places.
    clutter
        How many boxes stand around.
    room
        Put walls and a ceiling around.
    hints
        Write the corner's rough place into positions.csv.
    range_sigma_m
        Noise along the beam.
    world_sigma_m
        Noise of each measured world coordinate.
    dropout
        Share of the beams without return.
    seed
        The same seed gives the same session.
    suffix
        Format of the clouds.
    force
        Replace a session that no simulation wrote.
    """
    import json

    from lidarpose.cli.console import out as console
    from lidarpose.simulate.corner_scene import CornerSceneSpec, simulate_corner_session
    from lidarpose.simulate.multibeam import Defects
    from lidarpose.storage.atomic import write_text
    from lidarpose.storage.calibration import transform_entry
    from lidarpose.storage.corner_session import corner_truth_document, write_corner_session
    from lidarpose.storage.truth import truth_path

    spec = CornerSceneSpec(
        pose=pose,
        target=target,
        lidar=lidar,
        places=places,
        frames=frames,
        seed=seed,
        room=room,
        clutter=clutter,
        world_sigma_m=world_sigma_m,
        hints=hints,
        defects=Defects(range_sigma_m, dropout),
    )
    session, truth = simulate_corner_session(spec)
    write_corner_session(out, session, suffix=suffix, force=force)
    positions = [
        {"position": p.position, "corner_world_m": w.tolist(), "corner_m": c.tolist()}
        for p, w, c in zip(session.places, truth.corners_world, truth.corners_lidar, strict=True)
    ]
    document = corner_truth_document(transform_entry("world", session.cloud_frame, truth.T_world_lidar), positions)
    write_text(truth_path(out), json.dumps(document, indent=2) + "\n")
    console().print(f"{out}: {places} places, {frames} frames each; truth in {truth_path(out).name}")
