"""A look at a turntable session before it is calibrated: how far it carries, and where it is weak.

The figures come from the geometry alone: where the board is, how the LiDAR is mounted (roughly, by the closed form),
the readings, and the noise that detection states. No residual is looked at; that is what `calibrate` is for.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose
from lidarpose.model.observation import LeftOut, TurntableObservations
from lidarpose.model.sense import StatedSense
from lidarpose.model.session import TurntableSession
from lidarpose.model.turntable import TurntableMotion
from lidarpose.workflows.reversed_scans import describe_reversed, reversed_scans
from lidarpose.workflows.turning_sense import check_sense, turning_sense
from lidarpose.workflows.turntable import (
    DetectedFeatures,
    Step,
    assign_lines,
    detect_features,
    merge_left_out,
    solve,
    start_of,
    start_without_stripes,
)

if TYPE_CHECKING:
    from lidarpose.model.turntable_result import Direction
    from lidarpose.refine.joint_options import Start
    from lidarpose.refine.prediction import ExpectedNoise, PredictedUncertainty

# Below this arc the far side of the turn is known centimetres worse than the arc itself.
_SHORT_ARC_DEG = 5.0
_FEW_PLACES = 10


@dataclass(frozen=True)
class Remedy:
    """What a further recording would bring: sigma of the centre (mm) and of the orientation (degrees), each amid the
    readings and half a turn away."""

    what: str
    inside_mm: float
    inside_deg: float
    half_turn_mm: float
    half_turn_deg: float


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
        Directions that the geometry determines worst, with what to record.
    remedies
        What further recordings would bring.
    sense
        In which sense beams and table turn by the files, in words; empty where no solution tells.
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
    remedies: tuple[Remedy, ...]
    sense: str
    problems: tuple[str, ...]
    left_out: tuple[LeftOut, ...]
    undetermined: UndeterminedError | None


def inspect_turntable(
    session: TurntableSession, *, stated: StatedSense | None = None, step: Step | None = None
) -> TurntableInspection:
    """Look for boards, stripes and lines, and tell from the geometry how well the motion would be determined.

    Parameters
    ----------
    stated
        How beams and table turn, as the user sees it on his rig; a contradiction is a problem.
    step
        Called after each place.

    Raises
    ------
    InputError
        If an image or scan cannot be read. Data that determine nothing are no error here; see `undetermined`.
    """
    stated = (stated or StatedSense()).filled_from(session.stated)
    features: DetectedFeatures | None = None
    found: _Geometry | None = None
    undetermined: UndeterminedError | None = None
    used = 0
    left_out: tuple[LeftOut, ...] = ()
    try:
        features = detect_features(session, step=step)
        left_out = features.left_out
        observations, fitted = assign_lines(session, features)
        left_out = observations.left_out
        used = len(observations.places)
        if any(place.stripes for place in observations.places):
            paper = solve(observations, fitted)
            left_out = merge_left_out(left_out, paper.left_out)
            start = start_of(paper)
        else:
            start = start_without_stripes(observations)
        found = _geometry(session, observations, start)
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
        expected_sigma=() if found is None else found.expected_sigma,
        weak=() if found is None else found.predicted.directions,
        remedies=() if found is None else found.remedies,
        sense="" if found is None else found.sense(session, stated),
        problems=(
            *_problems(session, degrees),
            *(features.notes if features else ()),
            *(found.problems(session, stated) if found is not None else ()),
        ),
        left_out=left_out,
        undetermined=undetermined,
    )


def _corner_sigmas(features: DetectedFeatures) -> tuple[float, ...]:
    board = next(iter(features.boards.values()))
    return tuple(float(np.median(corners.sigma_px)) for corners in board.corners)


@dataclass(frozen=True, eq=False)
class _Geometry:
    """A rough solution, and what an estimate in its geometry would know."""

    start: Start
    suspects: tuple[str, ...]
    predicted: PredictedUncertainty
    expected_sigma: tuple[tuple[float, float, float], ...]
    remedies: tuple[Remedy, ...]

    def sense(self, session: TurntableSession, stated: StatedSense) -> str:
        return turning_sense(self.start[0], session.places[0].turntable_angle_rad, stated)

    def problems(self, session: TurntableSession, stated: StatedSense) -> tuple[str, ...]:
        motion, poses = self.start
        known = {name: [p for p in found if p is not None] for name, found in poses.items()}
        reverse = reversed_scans(session, motion, known, self.suspects)
        check = check_sense(motion, [place.turntable_angle_rad for place in session.places], stated)
        return (*((describe_reversed(reverse),) if reverse else ()), *check.contradictions, *check.notes)


def _geometry(session: TurntableSession, observations: TurntableObservations, start: Start) -> _Geometry:
    from lidarpose.refine.prediction import predict_uncertainty

    motion, poses = start
    known = {name: [p for p in found if p is not None] for name, found in poses.items()}
    angles = np.array([place.turntable_angle_rad for place in observations.places])
    seen = [place.placement for place in observations.places]
    noise = _expected_noise(observations)
    with_stripe = any(place.stripes for place in observations.places)

    def predict(plan: _Plan) -> PredictedUncertainty:
        return predict_uncertainty(
            session.camera,
            session.panels,
            plan.board,
            motion,
            plan.angles_rad,
            noise,
            with_stripe=with_stripe,
            placements=plan.seen,
        )

    now = _Plan("as recorded", angles, known, seen)
    predicted = predict(now)
    remedies = []
    for plan in _further(now):
        try:
            remedies.append(Remedy(plan.what, *_inside_and_away(motion, predict(plan), now.middle_rad)))
        except UndeterminedError:
            continue
    used = {place.position for place in observations.places}
    suspects = tuple(place.position for place in session.places if place.position not in used)
    return _Geometry(start, suspects, predicted, _expected_sigma(motion, predicted, angles), tuple(remedies))


def _expected_noise(observations: TurntableObservations) -> ExpectedNoise:
    """What detection states: of corners, of stripes per pixel of their length, of ranges, and the beams' spacing."""
    from lidarpose.refine.prediction import ExpectedNoise

    corners = np.concatenate([c.sigma_px for found in observations.corners.values() for c in found])
    lines = [line for place in observations.places for line in place.scan_lines.values()]
    stripes = [stripe for place in observations.places for stripe in place.stripes.values() if len(stripe) > 1]
    per_px = [
        np.median(s.sigma_px) * np.sqrt(np.linalg.norm(s.pixels[-1] - s.pixels[0]) / (len(s) - 1)) for s in stripes
    ]
    default = ExpectedNoise()
    return ExpectedNoise(
        corner_px=float(np.median(corners)),
        stripe_px=float(np.median(per_px)) if per_px else default.stripe_px,
        range_m=observations.lidar.range_sigma_m or float(np.median([np.median(line.sigma_m) for line in lines])),
        beam_step_rad=float(np.median([np.ptp(line.angle_rad) / max(len(line) - 1, 1) for line in lines])),
    )


@dataclass(frozen=True, eq=False)
class _Plan:
    """A recording: readings, the placement of the board seen at each, and T_camera_panel by placement."""

    what: str
    angles_rad: FloatArray
    board: Mapping[str, Sequence[Pose]]
    seen: Sequence[str]

    @property
    def middle_rad(self) -> float:
        return 0.5 * float(self.angles_rad.min() + self.angles_rad.max())


def _further(now: _Plan) -> tuple[_Plan, ...]:
    """What else could be recorded."""
    # Beyond the arc the scan may leave the board: what is recorded stays, so that more is never said to be worse.
    wider = np.concatenate([now.angles_rad, now.middle_rad + 2.0 * (now.angles_rad - now.middle_rad)])
    arc_deg = float(np.rad2deg(np.ptp(wider)))
    elsewhere = {_again(name): _elsewhere(found) for name, found in now.board.items()}
    return (
        _Plan(
            f"as many places again over twice the arc ({arc_deg:.0f} deg, as far as the scan stays on the board)",
            wider,
            now.board,
            [*now.seen, *now.seen],
        ),
        _Plan(
            "four times the places over the same arc",
            np.repeat(now.angles_rad, 4),
            now.board,
            [name for name in now.seen for _ in range(4)],
        ),
        _Plan(
            f"a second placement of the board (turned by {_TURN_DEG:g} deg, a fifth nearer), as many places again",
            np.tile(now.angles_rad, 2),
            {**now.board, **elsewhere},
            [*now.seen, *map(_again, now.seen)],
        ),
    )


def _again(placement: str) -> str:
    return f"{placement} again"


_NEARER, _TURN_DEG = 0.8, 20.0


def _elsewhere(poses: Sequence[Pose]) -> list[Pose]:
    """The board turned about the camera's y through its middle, and moved nearer along the line of sight."""
    middle = np.mean([pose.translation for pose in poses], axis=0)
    turn = Pose.exp([0.0, 0.0, 0.0, 0.0, np.deg2rad(_TURN_DEG), 0.0])
    about = Pose(np.eye(3), _NEARER * middle) @ turn @ Pose(np.eye(3), -middle)
    return [about @ pose for pose in poses]


def _sigma(motion: TurntableMotion, predicted: PredictedUncertainty, angle_rad: float) -> tuple[float, float]:
    """Sigma of the LiDAR's centre in mm and of its orientation in degrees at a reading."""
    J = motion.pose_jacobian(angle_rad)
    pose = UncertainPose(motion.pose(angle_rad), J @ predicted.covariance @ J.T)
    centre = 1e3 * float(np.sqrt(np.trace(pose.centre_covariance())))
    return centre, float(np.rad2deg(np.sqrt(np.trace(pose.rotation_covariance()))))


def _inside_and_away(
    motion: TurntableMotion, predicted: PredictedUncertainty, middle_rad: float
) -> tuple[float, float, float, float]:
    return (*_sigma(motion, predicted, middle_rad), *_sigma(motion, predicted, middle_rad + np.pi))


def _expected_sigma(
    motion: TurntableMotion, predicted: PredictedUncertainty, angles: FloatArray
) -> tuple[tuple[float, float, float], ...]:
    middle = 0.5 * float(angles.min() + angles.max())
    readings = (float(angles.min()), middle, float(angles.max()), middle + 0.5 * np.pi, middle + np.pi)
    return tuple((float(np.rad2deg(reading)), *_sigma(motion, predicted, reading)) for reading in readings)


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
