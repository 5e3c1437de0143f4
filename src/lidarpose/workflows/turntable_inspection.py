"""A look at a turntable session before it is calibrated: how far it carries, and where it is weak."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.model.observation import LeftOut
from lidarpose.model.session import TurntableSession
from lidarpose.workflows.turntable import (
    DetectedFeatures,
    Step,
    assign_lines,
    detect_features,
    merge_left_out,
    refine,
    solve,
    start_of,
    start_without_stripes,
)

if TYPE_CHECKING:
    from lidarpose.model.turntable_result import Direction, TurntableEstimate

# Below this arc the far side of the turn is known centimetres worse than the arc itself.
_SHORT_ARC_DEG = 5.0
_FEW_PLACES = 10


@dataclass(frozen=True)
class TurntableInspection:
    """What a session holds, and what it will determine.

    Attributes
    ----------
    corner_sigma_px
        By panel of the first placement: how well its corners were found; None if the board was not found.
    places_with_stripes, places_with_lines, places_used
        Places with a stripe on every panel; with two straight scan lines or more; that an estimate can use.
    expected_sigma
        Reading in degrees, sigma of the LiDAR's centre in mm, of its orientation in degrees.
    weak
        Directions that the data determine worst, with what to record.
    problems
        In words, each with what to do.
    undetermined
        Why the session determines no pose; None if it does.
    """

    first_deg: float
    last_deg: float
    arc_deg: float
    corner_sigma_px: tuple[float, ...] | None
    places_with_stripes: int
    places_with_lines: int
    places_used: int
    expected_sigma: tuple[tuple[float, float, float], ...]
    weak: tuple[Direction, ...]
    problems: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    undetermined: UndeterminedError | None


def inspect_turntable(session: TurntableSession, *, step: Step | None = None) -> TurntableInspection:
    """Look for boards, stripes and lines, and tell how well the motion would be determined.

    Raises
    ------
    InputError
        If an image or scan cannot be read. Data that determine nothing are no error here; see `undetermined`.
    """
    features: DetectedFeatures | None = None
    estimate: TurntableEstimate | None = None
    undetermined: UndeterminedError | None = None
    used = 0
    left_out: tuple[LeftOut, ...] = ()
    try:
        features = detect_features(session, step=step)
        left_out = features.left_out
        observations, stripe_pairs = assign_lines(session, features)
        left_out = observations.left_out
        used = len(observations.places)
        if any(place.stripes for place in observations.places):
            paper = solve(observations, stripe_pairs)
            left_out = merge_left_out(left_out, paper.left_out)
            start = start_of(paper)
        else:
            start = start_without_stripes(observations)
        estimate = refine(observations, start)
    except UndeterminedError as error:
        undetermined = error
    degrees = np.rad2deg([place.turntable_angle_rad for place in session.places])
    panels = range(len(session.panels))
    return TurntableInspection(
        first_deg=float(degrees[0]),
        last_deg=float(degrees[-1]),
        arc_deg=float(np.ptp(degrees)),
        corner_sigma_px=None if features is None else _corner_sigmas(features),
        places_with_stripes=sum(all(k in p.stripes for k in panels) for p in features.places) if features else 0,
        places_with_lines=sum(len(p.lines) >= len(session.panels) for p in features.places) if features else 0,
        places_used=used,
        expected_sigma=() if estimate is None else _expected_sigma(estimate, degrees),
        weak=() if estimate is None else estimate.directions,
        problems=(*_problems(session, degrees), *(features.notes if features else ())),
        left_out=left_out,
        undetermined=undetermined,
    )


def _corner_sigmas(features: DetectedFeatures) -> tuple[float, ...]:
    board = next(iter(features.boards.values()))
    return tuple(float(np.median(corners.sigma_px)) for corners in board.corners)


def _expected_sigma(estimate: TurntableEstimate, degrees: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    middle = 0.5 * (degrees.min() + degrees.max())
    rows = []
    for angle in (degrees.min(), middle, degrees.max(), middle + 90.0, middle + 180.0):
        pose = estimate.uncertain_pose(float(np.deg2rad(angle)))
        centre = 1e3 * float(np.sqrt(np.trace(pose.centre_covariance())))
        rotation = float(np.rad2deg(np.sqrt(np.trace(pose.rotation_covariance()))))
        rows.append((float(angle), centre, rotation))
    return tuple(rows)


def _problems(session: TurntableSession, degrees: np.ndarray) -> list[str]:
    problems = []
    arc = float(np.ptp(degrees))
    if len(session.places) < 3:
        problems.append(f"{len(session.places)} places: three at different readings are the least. Record more.")
    elif len(session.places) < _FEW_PLACES:
        problems.append(f"{len(session.places)} places: enough, but more places average the noise. Record 20 or more.")
    if 0.0 < arc < _SHORT_ARC_DEG:
        problems.append(
            f"the arc is {arc:.2f} deg: the far side of the turn will be known badly. Turn as far as the board allows."
        )
    for placement, shots in session.board_images.items():
        if len(shots) < 2:
            where = f" of placement {placement}" if placement else ""
            problems.append(f"one bright image{where}: whether the board moved cannot be seen. Record three or more.")
    if all(place.stripe_image is None for place in session.places):
        problems.append("no stripe images: boards and scans alone determine the pose less well.")
    return problems
