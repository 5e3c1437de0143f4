"""Which two lines of each scan lie on which panels: decided by evidence from all places together, or refused.

The turntable paper takes it as known. Exchanging the two lines of one place gives a second, mirrored pose, so a place
alone cannot tell. What can:

1. the angle between the lines, and where they end, against the stripes that the camera sees;
2. the LiDAR stands in front of both panels;
3. all places fit one turning motion with the known readings;
4. where nothing of this tells two solutions apart (a board and an axis that are mirror images of themselves), what the
   user says of the lines' order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.model.camera import Camera
from lidarpose.model.observation import LeftOut, PlaceFeatures, PlaceObservation, ScanLine
from lidarpose.model.scan import polar_to_points
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.assignment_blind import choose_without_stripes
from lidarpose.solve.assignment_candidates import (
    STRIPE_POINTS,
    Candidate,
    Pool,
    candidates_of,
    pool_of,
)
from lidarpose.solve.assignment_decision import Decision, decide
from lidarpose.solve.assignment_solutions import SLACK_SIGMAS, Solution, rms_misfit, solutions_of, support_of
from lidarpose.solve.light_plane import StripePair
from lidarpose.solve.line_pair import FittedLines
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.turntable_function import (
    require_readings,
)


@dataclass(frozen=True, eq=False)
class Assignment:
    """Places whose scan lines have found their panels.

    Attributes
    ----------
    places
        In the order given, without those left out.
    left_out
        Places that could not be used, each with its reason.
    motion
        The motion that the choice rests on; a start for better estimates.
    decided_by
        What told the solution from its rival: "the motion of all places", "the ends of the lines",
        "the order given by --first-panel", "all placements of the board" or "no rival".
    figures
        The evidence as numbers, units in the keys.
    stripe_pairs
        The light plane and stripes of each place by position, where all points of the stripes were used.
    against
        What speaks for the other order, where the user's was taken.
    """

    places: tuple[PlaceObservation, ...]
    left_out: tuple[LeftOut, ...]
    motion: TurntableMotion
    decided_by: str
    figures: Mapping[str, float]
    stripe_pairs: Mapping[str, StripePair] = field(default_factory=dict)
    against: str | None = None


def assign(
    camera: Camera,
    panel_poses: Mapping[str, Sequence[PanelPose]],
    places: Sequence[PlaceFeatures],
    *,
    panels: Sequence[Panel] | None = None,
    first_panel: int | None = None,
) -> Assignment:
    """Find the two scan lines on the board at every place, and which panel each lies on.

    Sessions without any stripe are assigned too, if the board had several placements and `panels` are given
    (`lidarpose.solve.assignment_blind`).

    Parameters
    ----------
    panel_poses
        By placement of the board: the poses of panel 0 and panel 1.
    places
        Stripes by panel, and the scans' straight lines in any order.
    panels
        The chessboards, in the session's order; needed only without stripes.
    first_panel
        The user's hint: the panel, 0 or 1, that the line of smaller beam angle lies on (1 or 2 on the command line).

    Raises
    ------
    UndeterminedError
        If fewer than three places at different readings can be used, or nothing tells two solutions apart.
    InputError
        If the hint contradicts the places' motion.
    """
    if panels is not None and not any(len(s) for place in places for s in place.stripes.values()):
        return _without_stripes(panels, panel_poses, places, first_panel)
    candidates, reasons = candidates_of(camera, panel_poses, places)
    angles = np.array([p.turntable_angle_rad for p in places])
    usable = sorted({c.place for c in candidates})
    _require_places(angles[usable], places, reasons)
    pool = pool_of(candidates, angles)
    solutions = solutions_of(pool)
    if not solutions or _explain_nothing(solutions[0], places):
        raise UndeterminedError(
            "No turning motion explains the places: no choice of scan lines fits the stripes and the readings",
            remedy="Check that the readings in positions.csv are in degrees and belong to their scans and images, "
            "and that the board did not move",
            details=_details(places, reasons),
        )
    decision = decide(pool, solutions, places, panel_poses, first_panel)
    return _assignment(pool, decision, places, reasons)


def _explain_nothing(best: Solution, places: Sequence[PlaceFeatures]) -> bool:
    """Whether even the best motion leaves most lit places aside and fits the others no better than chance lines."""
    support = support_of(best)
    lit = sum(len(place.stripes) > 1 for place in places)
    return bool(support.sum() < 0.5 * lit and rms_misfit(best.misfit, support) > SLACK_SIGMAS)


def _without_stripes(
    panels: Sequence[Panel],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    places: Sequence[PlaceFeatures],
    first_panel: int | None,
) -> Assignment:
    choice = choose_without_stripes(panels, panel_poses, places, first_panel=first_panel)
    assigned = []
    for k, (i, j) in sorted(choice.lines.items()):
        place = places[k]
        lines = {0: place.lines[i], 1: place.lines[j]}
        assigned.append(PlaceObservation(place.position, place.turntable_angle_rad, {}, lines, place.placement))
    _require_places(np.array([p.turntable_angle_rad for p in assigned]), places, choice.reasons)
    left_out = tuple(LeftOut(f"position {places[k].position}", reason) for k, reason in sorted(choice.reasons.items()))
    return Assignment(tuple(assigned), left_out, choice.motion, "all placements of the board", choice.figures)


def _require_places(angles: FloatArray, places: Sequence[PlaceFeatures], reasons: Mapping[int, str]) -> None:
    try:
        require_readings(angles)
    except UndeterminedError as error:
        raise UndeterminedError(error.what, remedy=error.remedy, details=_details(places, reasons)) from None


def _details(places: Sequence[PlaceFeatures], reasons: Mapping[int, str]) -> tuple[str, ...]:
    return tuple(f"position {places[k].position}: {reason}" for k, reason in sorted(reasons.items()))


def _assignment(
    pool: Pool,
    decision: Decision,
    places: Sequence[PlaceFeatures],
    reasons: dict[int, str],
) -> Assignment:
    best = decision.solution
    support = support_of(best)
    chosen = {int(k): pool.candidates[best.chosen[k]] for k in np.flatnonzero(support)}
    pieces = _pieces(places, chosen)
    assigned = []
    stripe_pairs = {}
    for k, place in enumerate(places):
        if not support[k]:
            reasons.setdefault(k, "its scan lines do not fit the motion of the other places")
            continue
        candidate = chosen[k]
        lines = {key: _joined([place.lines[candidate.lines[key]], *pieces.get((k, key), [])]) for key in (0, 1)}
        assigned.append(
            PlaceObservation(place.position, place.turntable_angle_rad, place.stripes, lines, place.placement)
        )
        if all(len(place.stripes[key]) <= STRIPE_POINTS for key in (0, 1)):
            stripe_pairs[place.position] = candidate.stripes
    angles = np.array([p.turntable_angle_rad for p in assigned])
    _require_places(angles, places, reasons)
    left_out = tuple(LeftOut(f"position {places[k].position}", reason) for k, reason in sorted(reasons.items()))
    return Assignment(
        tuple(assigned),
        left_out,
        best.motion,
        decision.decided_by,
        decision.figures,
        stripe_pairs,
        decision.against,
    )


def _pieces(places: Sequence[PlaceFeatures], chosen: Mapping[int, Candidate]) -> dict[tuple[int, int], list[ScanLine]]:
    """By place and panel, the pieces that detection may have split off the chosen scan line."""
    others = [
        (k, line) for k, c in chosen.items() for j, line in enumerate(places[k].lines) if j not in c.lines and len(line)
    ]
    found: dict[tuple[int, int], list[ScanLine]] = {}
    if not others:
        return found
    count = np.array([len(line) for _, line in others])
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    points = polar_to_points(*(np.concatenate([getattr(o, n) for _, o in others]) for n in ("angle_rad", "range_m")))
    sigma = np.concatenate([line.sigma_m for _, line in others])
    for key in (0, 1):
        fits = FittedLines.of([chosen[k].fits[key] for k, _ in others])
        reach = np.array([np.ptp(chosen[k].stripes.extents_m[key]) for k, _ in others])
        normal, direction, middle = (np.repeat(a, count, axis=0) for a in (fits.normal, fits.direction, fits.middle))
        offset, turn = (np.repeat(a, count) for a in (fits.offset, fits.direction_sigma_rad))
        along = ((points - middle) * direction).sum(axis=1)
        near = np.abs((points * normal).sum(axis=1) - offset) < 4.0 * np.hypot(sigma, turn * along)
        ends = ((fits.ends - fits.middle[:, None]) @ fits.direction[:, :, None])[..., 0]
        low = np.minimum(np.minimum.reduceat(along, start), ends.min(axis=1))
        high = np.maximum(np.maximum.reduceat(along, start), ends.max(axis=1))
        of_it = (np.add.reduceat(near.astype(np.float64), start) > 0.9 * count) & (high - low < reach)
        for k in np.flatnonzero(of_it).tolist():
            found.setdefault((others[k][0], key), []).append(others[k][1])
    return found


def _joined(pieces: list[ScanLine]) -> ScanLine:
    if len(pieces) == 1:
        return pieces[0]
    angle = np.concatenate([p.angle_rad for p in pieces])
    order = np.argsort(angle, kind="stable")
    intensity = None
    if all(p.intensity is not None for p in pieces):
        intensity = np.concatenate([p.intensity for p in pieces if p.intensity is not None])[order]
    return ScanLine(
        angle[order],
        np.concatenate([p.range_m for p in pieces])[order],
        np.concatenate([p.sigma_m for p in pieces])[order],
        intensity,
    )
