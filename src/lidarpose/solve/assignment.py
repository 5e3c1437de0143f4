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

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import permutations

import numpy as np

from lidarpose.errors import InputError, UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, angle_between
from lidarpose.geometry.planes import Plane, fit_plane, intersect_three_planes
from lidarpose.geometry.se3 import Pose, UncertainPose, log_so3, rotation_z
from lidarpose.model.camera import Camera
from lidarpose.model.observation import LeftOut, PlaceFeatures, PlaceObservation, ScanLine, StripePoints
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.assignment_blind import choose_without_stripes
from lidarpose.solve.light_plane import StripeOnPanel, StripePair, stripe_pair, stripes_on_panel
from lidarpose.solve.line_pair import FittedLine, fit_line_pair, fit_scan_line, free_directions
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.single_pose import single_pose
from lidarpose.solve.turntable_function import (
    fit_by_readings,
    information_in_own_frame,
    motion_of_pair,
    require_readings,
    wide_pairs,
)

LEAST_STRIPE_POINTS = 5
# Points of a stripe that the choice is made from.
STRIPE_POINTS = 150
# How far the lines' angle may differ from the stripes' beyond five sigma.
ALPHA_SLACK_RAD = np.deg2rad(1.0)
# A line may reach this far over the fold: noise of E, and a fold that is not sharp.
FOLD_SLACK_M = 0.03
# Shares of a stripe that its scan line covers, and of a scan line that its stripe covers, at least.
LEAST_STRIPE_COVERED = 0.5
LEAST_LINE_COVERED = 0.35
# Pairs of places whose motions are tried.
PAIRS = 24
REFINED = 6
# A place supports a motion up to this many of its own sigmas (times what the other places show).
SUPPORT_SIGMAS = 6.0
# Residuals of this size are no evidence against a place: panels and cameras are never quite what the model says.
SLACK_SIGMAS = 20.0
# One solution beats another where its residuals are this much smaller at least, and that is no chance: the logarithm of
# the ratio of two equal deviations with n degrees of freedom scatters by sqrt(1/n) (more for small n).
LEAST_RATIO = 2.0
LEAST_DEVIATIONS = 5.0
# What a panel's pose may be wrong by beyond twice its stated deviation, because neither boards nor lenses are perfect,
# before one solution is held for better than another.
PANEL_TURN_RAD = 3e-4
PANEL_SHIFT_M = 2e-4
# A rival whose places are off by this much needs no closer look.
FAR_OFF_RAD = 0.005
# Places that the closer look takes.
LOOKED_AT = 10
# ... or where the lines' ends agree so much better with the stripes' ends (difference of chi-squared).
LEAST_ENDS_GAIN = 30.0
# How unequally the ends of stripes may be cut off on both panels, by detection or by margins.
ENDS_BIAS_M = 0.015

HINT = "--first-panel"


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
    """

    places: tuple[PlaceObservation, ...]
    left_out: tuple[LeftOut, ...]
    motion: TurntableMotion
    decided_by: str
    figures: Mapping[str, float]
    stripe_pairs: Mapping[str, StripePair] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class _Candidate:
    """One place's hypothesis: `lines` are the indices of the scan lines on panel 0 and panel 1."""

    place: int
    lines: tuple[int, int]
    sample: UncertainPose
    extents_m: FloatArray
    spacing_m: float
    fits: tuple[FittedLine, FittedLine]
    stripes: StripePair
    rays_camera: tuple[FloatArray, FloatArray]


@dataclass(frozen=True, eq=False)
class _Pool:
    """All candidates of all places as arrays."""

    candidates: tuple[_Candidate, ...]
    place: IntArray
    angle_rad: FloatArray
    rotation: FloatArray
    translation: FloatArray
    information: FloatArray
    places: int

    def misfits(self, T_w: Pose, T_m: Pose) -> FloatArray:
        """Distance (C,) of each candidate from a motion, in its own sigmas."""
        turned = T_w.rotation @ rotation_z(self.angle_rad)
        back = np.swapaxes(turned @ T_m.rotation, -1, -2)
        shift = self.translation - (turned @ T_m.translation + T_w.translation)
        e = np.concatenate([(back @ shift[..., None])[..., 0], log_so3(back @ self.rotation)], axis=1)
        return np.asarray(np.sqrt(np.einsum("na,nab,nb->n", e, self.information, e) / 6.0))


@dataclass(frozen=True, eq=False)
class _Solution:
    """A choice of one candidate a place (-1: none), the motion through them, their misfits (inf where none)."""

    chosen: IntArray
    motion: TurntableMotion
    misfit: FloatArray


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
    reasons: dict[int, str] = {}
    candidates: list[_Candidate] = []
    on_panels = _stripes_on_panels(camera, panel_poses, places)
    for k, place in enumerate(places):
        try:
            candidates += _candidates(panel_poses[place.placement], k, place, on_panels.get(k))
        except ValueError as reason:
            reasons[k] = str(reason)
    angles = np.array([p.turntable_angle_rad for p in places])
    usable = sorted({c.place for c in candidates})
    _require_places(angles[usable], places, reasons)
    pool = _pool(candidates, angles)
    solutions = _solutions(pool)
    if not solutions:
        raise UndeterminedError(
            "No turning motion explains the places: no choice of scan lines fits the stripes and the readings",
            remedy="Check that the readings in positions.csv are in degrees and belong to their scans and images, "
            "and that the board did not move",
            details=_details(places, reasons),
        )
    best, decided_by, figures = _decide(pool, solutions, places, panel_poses, first_panel)
    return _assignment(pool, best, places, reasons, decided_by, figures)


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


# --- one place -----------------------------------------------------------------------------------------------------


def _candidates(
    poses: Sequence[PanelPose],
    index: int,
    place: PlaceFeatures,
    on_panels: tuple[StripeOnPanel, StripeOnPanel] | None,
) -> list[_Candidate]:
    """Ordered pairs of a place's lines that may be the board. Raises ValueError with the reason if there is none."""
    panels = [Plane.from_pose(p.T_camera_panel) for p in poses]
    if on_panels is None:
        missing = next(key for key in (0, 1) if not _has_stripe(place, key))
        raise ValueError(f"no usable stripe on panel {missing + 1}")
    stripes = stripe_pair((panels[0], panels[1]), on_panels)
    rays = (on_panels[0].rays_camera, on_panels[1].rays_camera)
    if len(place.lines) < 2:
        raise ValueError(f"the scan shows {len(place.lines)} straight lines; the board needs two")
    fits = [fit_scan_line(line, robust=False) for line in place.lines]
    found = []
    for i, j in _plausible_pairs(fits, stripes):
        lines = fit_line_pair(fits[i], fits[j], stripes.alpha_rad)
        sample = single_pose(stripes, lines)
        centre = sample.pose.translation
        # The panels show their faces to the camera, at the origin: the LiDAR must stand on the same side.
        if all(plane.distance(centre) * -plane.offset > 0.0 for plane in panels):
            spacing = max(_spacing(place.lines[i]), _spacing(place.lines[j]))
            found.append(_Candidate(index, (i, j), sample, lines.extents_m, spacing, (fits[i], fits[j]), stripes, rays))
    if not found:
        raise ValueError("no two lines of the scan match the two stripes in angle, length and side")
    return found


def _has_stripe(place: PlaceFeatures, key: int) -> bool:
    return key in place.stripes and len(place.stripes[key]) >= LEAST_STRIPE_POINTS


def _stripes_on_panels(
    camera: Camera, panel_poses: Mapping[str, Sequence[PanelPose]], places: Sequence[PlaceFeatures]
) -> dict[int, tuple[StripeOnPanel, StripeOnPanel]]:
    """Both stripes of each place, by the place's index, where it has both; those of one panel together."""
    found: dict[int, tuple[StripeOnPanel, StripeOnPanel]] = {}
    for placement, poses in panel_poses.items():
        lit = [k for k, p in enumerate(places) if p.placement == placement and _has_stripe(p, 0) and _has_stripe(p, 1)]
        if lit:
            first, second = (
                stripes_on_panel(camera, poses[key].T_camera_panel, [_thinned(places[k].stripes[key]) for k in lit])
                for key in (0, 1)
            )
            found.update(zip(lit, zip(first, second, strict=True), strict=True))
    return found


def _thinned(stripe: StripePoints) -> StripePoints:
    """Some of a stripe's points: enough for a choice."""
    if len(stripe) <= STRIPE_POINTS:
        return stripe
    some = np.unique(np.linspace(0, len(stripe) - 1, STRIPE_POINTS).astype(int))
    return StripePoints(stripe.pixels[some], stripe.normals[some], stripe.sigma_px[some])


def _plausible_pairs(fits: list[FittedLine], stripes: StripePair) -> list[tuple[int, int]]:
    return [(i, j) for i, j in permutations(range(len(fits)), 2) if _plausible(fits[i], fits[j], stripes)]


def _plausible(first: FittedLine, second: FittedLine, stripes: StripePair) -> bool:
    """Angle, gap at the fold and lengths of two lines against the stripes' (all as loose as sensors and edges are)."""
    cosine = abs(float(first.line.direction @ second.line.direction))
    sigma = float(np.hypot(first.direction_sigma_rad, second.direction_sigma_rad))
    slack = 5.0 * sigma + ALPHA_SLACK_RAD
    # Cheap first: the lines' directions without their senses.
    if abs(np.arccos(min(cosine, 1.0)) - min(stripes.alpha_rad, np.pi - stripes.alpha_rad)) > slack:
        return False
    try:
        directions = free_directions(first, second)
    except ValueError:
        return False
    alpha = float(np.arccos(np.clip(directions[0] @ directions[1], -1.0, 1.0)))
    if abs(alpha - stripes.alpha_rad) > slack:
        return False
    E = first.line.intersection(second.line)
    for fit, direction, (near, far) in zip((first, second), directions, stripes.extents_m, strict=True):
        low, high = np.sort((fit.ends - E) @ direction)
        common = min(high, far) - max(low, near)
        if low < -FOLD_SLACK_M - 0.1 * (high - low):
            return False
        if common < LEAST_STRIPE_COVERED * (far - near) or common < LEAST_LINE_COVERED * (high - low):
            return False
    return True


def _spacing(line: ScanLine) -> float:
    """Typical distance of neighbouring points of a scan line."""
    return float(np.median(np.linalg.norm(np.diff(line.points_lidar(), axis=0), axis=1)))


def _require_places(angles: FloatArray, places: Sequence[PlaceFeatures], reasons: Mapping[int, str]) -> None:
    try:
        require_readings(angles)
    except UndeterminedError as error:
        raise UndeterminedError(error.what, remedy=error.remedy, details=_details(places, reasons)) from None


def _details(places: Sequence[PlaceFeatures], reasons: Mapping[int, str]) -> tuple[str, ...]:
    return tuple(f"position {places[k].position}: {reason}" for k, reason in sorted(reasons.items()))


# --- all places ----------------------------------------------------------------------------------------------------


def _pool(candidates: list[_Candidate], angles: FloatArray) -> _Pool:
    samples = [c.sample for c in candidates]
    information = information_in_own_frame([s.pose for s in samples], [s.covariance for s in samples])
    place = np.array([c.place for c in candidates])
    return _Pool(
        tuple(candidates),
        place,
        angles[place],
        np.stack([c.sample.pose.rotation for c in candidates]),
        np.stack([c.sample.pose.translation for c in candidates]),
        information,
        len(angles),
    )


def _solutions(pool: _Pool) -> list[_Solution]:
    """Motions that explain three places or more, best first, with the exchanged choice of each beside it."""
    scored = sorted(_hypotheses(pool), key=lambda item: item[0])
    found: list[_Solution] = []
    starts: set[bytes] = set()
    for _, chosen, start in scored:
        if len(starts) >= REFINED:
            break
        if chosen.tobytes() in starts:
            continue
        starts.add(chosen.tobytes())
        _add(found, _refined(pool, chosen, start))
    for solution in found:
        _add(found, _refined(pool, _exchanged(pool, solution.chosen), rechoose=False))
    return sorted(found, key=lambda s: _score(s.misfit))


def _add(found: list[_Solution], solution: _Solution | None) -> None:
    if solution is not None and not any(np.array_equal(s.chosen, solution.chosen) for s in found):
        found.append(solution)


def _is_same(a: _Solution, b: _Solution) -> bool:
    """Whether two solutions make the same choice at most places: then they are one, but for some bad places."""
    both = (a.chosen >= 0) & (b.chosen >= 0)
    return bool(both.any() and np.mean(a.chosen[both] == b.chosen[both]) > 0.5)


def _score(misfit: FloatArray) -> float:
    """Mean bounded misfit of the places: 0 fits, 1 does not."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.where(np.isfinite(misfit), misfit**2 / (misfit**2 + SLACK_SIGMAS**2), 1.0)))


def _hypotheses(pool: _Pool) -> list[tuple[float, IntArray, TurntableMotion]]:
    """Motions through two candidates of two places: each one's score and what it makes every place choose."""
    present = np.unique(pool.place)
    angle_of = {int(p): pool.angle_rad[pool.place == p][0] for p in present}
    pairs = wide_pairs(np.array([angle_of[int(p)] for p in present]), PAIRS)
    scored: list[tuple[float, IntArray, TurntableMotion]] = []
    for i, j in pairs:
        for a in np.flatnonzero(pool.place == present[i]):
            for b in np.flatnonzero(pool.place == present[j]):
                if not _turn_agrees(pool, int(a), int(b)):
                    continue
                both = [int(a), int(b)]
                motion = motion_of_pair(pool.angle_rad[both], pool.rotation[both], pool.translation[both])
                chosen, misfit = _choose(pool, pool.misfits(*motion))
                scored.append((_score(misfit), chosen, TurntableMotion.from_any_frame(*motion)))
    return scored


def _turn_agrees(pool: _Pool, a: int, b: int) -> bool:
    """Whether the LiDAR turned between two candidates by as much as the table did."""
    turned = float(np.linalg.norm(log_so3(pool.rotation[b] @ pool.rotation[a].T)))
    table = abs(float((pool.angle_rad[b] - pool.angle_rad[a] + np.pi) % (2.0 * np.pi) - np.pi))
    sigma = np.sqrt(sum(np.trace(pool.candidates[k].sample.rotation_covariance()) for k in (a, b)))
    return bool(abs(turned - table) < np.deg2rad(1.0) + 6.0 * float(sigma))


def _choose(pool: _Pool, misfits: FloatArray) -> tuple[IntArray, FloatArray]:
    """Each place's candidate of least misfit (-1 where it has none), and that misfit."""
    chosen: IntArray = np.full(pool.places, -1, dtype=np.int64)
    misfit = np.full(pool.places, np.inf)
    for c in np.argsort(-misfits):  # the least comes last and stays
        chosen[pool.place[c]] = c
        misfit[pool.place[c]] = misfits[c]
    return chosen, misfit


def _refined(
    pool: _Pool, chosen: IntArray, start: TurntableMotion | None = None, *, rechoose: bool = True
) -> _Solution | None:
    """The motion through all chosen candidates, and what every place chooses then; None if it falls apart."""
    solution: _Solution | None = None
    for _ in range(5):
        have = chosen[chosen >= 0]
        try:
            fitted = fit_by_readings(
                list(pool.angle_rad[have]),
                [pool.candidates[c].sample.pose for c in have],
                [pool.candidates[c].sample.covariance for c in have],
                start=start,
            )
        except UndeterminedError:
            return solution
        misfits = pool.misfits(fitted.motion.T_camera_turntable, fitted.motion.T_turntable_lidar)
        if rechoose:
            again, misfit = _choose(pool, misfits)
        else:
            again, misfit = chosen, np.where(chosen >= 0, misfits[chosen], np.inf)
        solution = _Solution(again, fitted.motion, misfit)
        start = fitted.motion
        if np.array_equal(again, chosen):
            break
        chosen = again
    return solution


def _exchanged(pool: _Pool, chosen: IntArray) -> IntArray:
    """The choice with both lines exchanged at every place (-1 where that is no candidate)."""
    index = {(c.place, c.lines): k for k, c in enumerate(pool.candidates)}
    out = np.full_like(chosen, -1)
    for place, c in enumerate(chosen):
        if c >= 0:
            i, j = pool.candidates[c].lines
            out[place] = index.get((place, (j, i)), -1)
    return out


# --- the decision --------------------------------------------------------------------------------------------------


def _decide(
    pool: _Pool,
    solutions: list[_Solution],
    places: Sequence[PlaceFeatures],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    first_panel: int | None,
) -> tuple[_Solution, str, dict[str, float]]:
    """The solution that the evidence is for, what decided, and the figures. Raises where nothing decides."""
    best = solutions[0]
    solutions = [best, *(s for s in solutions[1:] if not _is_same(best, s))]
    figures = {"solutions": float(len(solutions)), "rms_sigmas": _rms(best.misfit, _support(best))}
    look = partial(_rms_with_panels, pool, places, panel_poses)
    rivals = [s for s in solutions[1:] if not _beaten_by_motion(pool, best, s, look)]
    if len(solutions) > 1:
        figures["rival_rms_sigmas"] = min(_rms(s.misfit, _support(best)) for s in solutions[1:])
    decided_by = "the motion of all places" if len(solutions) > 1 else "no rival"
    if rivals:
        gains = [_ends_gain(pool, best, s) for s in rivals]
        figures["ends_gain"] = min(gains)
        if min(gains) < -LEAST_ENDS_GAIN:  # a rival's ends agree better, and its motion is no worse
            best, rivals = rivals[int(np.argmin(gains))], [best, *rivals]
            rivals = [s for s in rivals if s is not best]
            gains = [_ends_gain(pool, best, s) for s in rivals]
        rivals = [s for s, gain in zip(rivals, gains, strict=True) if gain < LEAST_ENDS_GAIN]
        decided_by = "the ends of the lines"
    if first_panel is not None:
        return _by_hint(pool, best, rivals, places, first_panel, decided_by), _told(rivals, decided_by), figures
    if rivals:
        raise UndeterminedError(
            "Nothing in the data tells which scan line lies on which panel: two mirrored solutions fit equally well",
            remedy=f"Say it with {HINT} 1 or {HINT} 2 (the panel that the scan line of smaller beam angle lies on), "
            "or tilt the board or shift one panel's end so that the two are no mirror images, and record again",
        )
    return best, decided_by, figures


def _told(rivals: list[_Solution], decided_by: str) -> str:
    return f"the order given by {HINT}" if rivals else decided_by


def _by_hint(
    pool: _Pool,
    best: _Solution,
    rivals: list[_Solution],
    places: Sequence[PlaceFeatures],
    first_panel: int,
    decided_by: str,
) -> _Solution:
    agreeing = [s for s in (best, *rivals) if _share_with_hint(pool, s, places, first_panel) > 0.5]
    if not agreeing:
        raise InputError(
            HINT,
            f"{decided_by} contradict it: the line of smaller beam angle does not lie on panel {first_panel + 1}",
            remedy="Leave the option out, or check that the panels are in the session's order",
        )
    return agreeing[0]


def _share_with_hint(pool: _Pool, solution: _Solution, places: Sequence[PlaceFeatures], first_panel: int) -> float:
    votes = []
    for c in solution.chosen[solution.chosen >= 0]:
        candidate = pool.candidates[c]
        first, second = (places[candidate.place].lines[k] for k in candidate.lines)
        smaller = 0 if np.mean(first.angle_rad) < np.mean(second.angle_rad) else 1
        votes.append(smaller == first_panel)
    return float(np.mean(votes)) if votes else 0.0


def _support(solution: _Solution) -> BoolArray:
    """The places that the solution explains."""
    finite = np.isfinite(solution.misfit)
    typical = float(np.median(solution.misfit[finite]))
    return np.asarray(finite & (solution.misfit < SUPPORT_SIGMAS * max(1.0, typical)))


def _rms(misfit: FloatArray, support: BoolArray) -> float:
    """Root mean square misfit of as many places as the support has, the best ones; infinite if there are fewer."""
    n = int(support.sum())
    least = np.sort(misfit)[:n]
    return float(np.sqrt(np.mean(least**2))) if n and np.isfinite(least).all() else float("inf")


def _beaten_by_motion(
    pool: _Pool, best: _Solution, rival: _Solution, look: Callable[[_Solution, IntArray], float]
) -> bool:
    """Whether the rival's places fit one motion so much worse that neither chance nor the panels' poses explain it."""
    support = _support(best)
    ours, theirs = _rms(best.misfit, support), _rms(rival.misfit, support)
    if not np.isfinite(theirs):
        return True
    smallest = np.median([np.linalg.eigvalsh(c.sample.rotation_covariance())[0] for c in pool.candidates])
    both = np.flatnonzero(support & (rival.chosen >= 0))
    if len(both) < 3 or theirs * np.sqrt(smallest) < FAR_OFF_RAD:
        both = both[np.unique(np.linspace(0, len(both) - 1, LOOKED_AT).astype(int))]
        ours, theirs = look(best, both), look(rival, both)
    else:
        both = np.flatnonzero(support)
    # Residuals far below the stated sigma are rounding, not evidence.
    ratio = theirs / max(ours, 0.02)
    freedom = max(6 * len(both) - 10, 1)
    needed = LEAST_DEVIATIONS / np.sqrt(freedom) * (1.0 + 5.0 / freedom)
    return bool(ratio > LEAST_RATIO and np.log(ratio) > needed)


def _rms_with_panels(
    pool: _Pool,
    places: Sequence[PlaceFeatures],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    solution: _Solution,
    which: IntArray,
) -> float:
    """Root mean square misfit, in sigmas, of some places once the panels' poses may give way within their uncertainty.

    An error of a panel's pose moves all samples together. The right solution hardly shows it, a mirrored one does, so
    without this the panels' noise would decide between solutions that are equally good. One linear least squares
    problem: motion and panels, with the panels' prior.
    """
    names = sorted({places[k].placement for k in which})
    chosen = solution.chosen[which]
    rows, right = [], []
    for k, c in zip(which, chosen, strict=True):
        candidate = pool.candidates[c]
        poses = panel_poses[places[k].placement]
        to_motion = solution.motion.pose_jacobian(pool.angle_rad[c])
        back = solution.motion.pose(pool.angle_rad[c]).inverse().adjoint()
        root = np.linalg.cholesky(pool.information[c]).T
        e = back @ candidate.sample.pose.minus(solution.motion.pose(pool.angle_rad[c]))
        by_panels = np.zeros((6, 12 * len(names)))
        at = 12 * names.index(places[k].placement)
        by_panels[:, at : at + 12] = back @ _moved_by_panels(candidate, poses)
        rows.append(root @ np.hstack([-back @ to_motion, by_panels]))
        right.append(root @ e)
    prior = np.hstack([np.zeros((12 * len(names), 10)), np.eye(12 * len(names))])
    A = np.vstack([*rows, prior])
    b = np.concatenate([*right, np.zeros(len(prior))])
    rest = b - A @ np.linalg.lstsq(A, b, rcond=1e-12)[0]
    return float(np.sqrt(rest @ rest / (6 * len(which))))


def _moved_by_panels(candidate: _Candidate, poses: Sequence[PanelPose]) -> FloatArray:
    """How a sample moves (6, 12), as left perturbation, for one deviation of each panel's pose in each direction."""
    T = [poses[key].T_camera_panel for key in (0, 1)]
    reference = _sample_on(candidate, (T[0], T[1]))
    columns = []
    for key in (0, 1):
        middle = Pose(np.eye(3), candidate.stripes.E_camera).adjoint()
        slack = np.diag([PANEL_SHIFT_M**2] * 3 + [PANEL_TURN_RAD**2] * 3)
        spread = np.linalg.cholesky(4.0 * poses[key].covariance + middle @ slack @ middle.T)
        for direction in 0.1 * spread.T:
            moved = list(T)
            moved[key] = Pose.exp(direction) @ T[key]
            columns.append(_sample_on(candidate, (moved[0], moved[1])).minus(reference) / 0.1)
    return np.stack(columns, axis=1)


def _sample_on(candidate: _Candidate, T_camera_panel: tuple[Pose, Pose]) -> Pose:
    """The sample as it were if the panels stood a little differently."""
    planes = (Plane.from_pose(T_camera_panel[0]), Plane.from_pose(T_camera_panel[1]))
    points = np.vstack([p.intersect_rays(r) for p, r in zip(planes, candidate.rays_camera, strict=True)])
    stripes = candidate.stripes
    light = fit_plane(points, np.concatenate(stripes.light_plane.weights))
    directions = []
    for plane, old in zip(planes, stripes.directions_camera, strict=True):
        direction = light.intersect_plane(plane).direction
        directions.append(direction if direction @ old > 0.0 else -direction)
    moved = replace(
        stripes,
        light_plane=replace(stripes.light_plane, plane=light),
        E_camera=intersect_three_planes((*planes, light)),
        directions_camera=np.stack(directions),
        alpha_rad=float(angle_between(*directions)),
    )
    return single_pose(moved, fit_line_pair(*candidate.fits, moved.alpha_rad)).pose


def _ends_gain(pool: _Pool, best: _Solution, rival: _Solution) -> float:
    """By how much chi-squared of the lines' ends, against the stripes' ends, is smaller for the best than the rival.

    Only the difference between both panels counts: detection may well cut off stripes and lines, but alike on both. An
    unknown inequality of that is allowed for, the same at all places.
    """
    both = np.flatnonzero((best.chosen >= 0) & (rival.chosen >= 0))
    if len(both) == 0:
        return 0.0
    chi2 = []
    spacing = float(np.median([pool.candidates[best.chosen[p]].spacing_m for p in both]))
    for solution in (best, rival):
        chosen = [pool.candidates[solution.chosen[p]] for p in both]
        off = np.stack([c.extents_m - c.stripes.extents_m for c in chosen])
        chi2.append(off[:, 0] - off[:, 1])
    # Scatter from place to place, of the better one, never below two beams.
    scatter = [float(np.median(np.abs(d - np.median(d, axis=0)))) * 1.4826 for d in chi2]
    sigma = max(min(scatter), 2.0 * spacing, 0.003)
    values = [_chi2_with_bias(d[:, 0], sigma) + _chi2_with_bias(d[:, 1], sigma) for d in chi2]
    return values[1] - values[0]


def _chi2_with_bias(differences: FloatArray, sigma: float) -> float:
    """Chi-squared of values (N,) with noise `sigma` and one common unknown bias; outlying values are bounded."""
    d = np.clip(differences, -0.2, 0.2)
    total, n = float(d.sum()), len(d)
    common = ENDS_BIAS_M**2 / (sigma**2 + n * ENDS_BIAS_M**2)
    return (float(d @ d) - common * total**2) / sigma**2


# --- the result ----------------------------------------------------------------------------------------------------


def _assignment(
    pool: _Pool,
    best: _Solution,
    places: Sequence[PlaceFeatures],
    reasons: dict[int, str],
    decided_by: str,
    figures: dict[str, float],
) -> Assignment:
    support = _support(best)
    assigned = []
    stripe_pairs = {}
    for k, place in enumerate(places):
        if not support[k]:
            reasons.setdefault(k, "its scan lines do not fit the motion of the other places")
            continue
        candidate = pool.candidates[best.chosen[k]]
        lines = {key: _whole(place, candidate, key) for key in (0, 1)}
        assigned.append(
            PlaceObservation(place.position, place.turntable_angle_rad, place.stripes, lines, place.placement)
        )
        if all(len(place.stripes[key]) <= STRIPE_POINTS for key in (0, 1)):
            stripe_pairs[place.position] = candidate.stripes
    angles = np.array([p.turntable_angle_rad for p in assigned])
    _require_places(angles, places, reasons)
    left_out = tuple(LeftOut(f"position {places[k].position}", reason) for k, reason in sorted(reasons.items()))
    return Assignment(tuple(assigned), left_out, best.motion, decided_by, figures, stripe_pairs)


def _whole(place: PlaceFeatures, candidate: _Candidate, key: int) -> ScanLine:
    """The scan line of a panel with the pieces that detection may have split off it."""
    chosen = place.lines[candidate.lines[key]]
    fit = candidate.fits[key]
    length = float(np.ptp(candidate.stripes.extents_m[key]))
    pieces = [chosen]
    for k, other in enumerate(place.lines):
        if k in candidate.lines:
            continue
        points = other.points_lidar()
        along = (points - fit.middle) @ fit.line.direction
        near = np.abs(fit.line.distance(points)) < 4.0 * np.hypot(other.sigma_m, fit.direction_sigma_rad * along)
        if near.mean() > 0.9 and np.ptp(np.concatenate([along, (fit.ends - fit.middle) @ fit.line.direction])) < length:
            pieces.append(other)
    if len(pieces) == 1:
        return chosen
    return _joined(pieces)


def _joined(pieces: list[ScanLine]) -> ScanLine:
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
