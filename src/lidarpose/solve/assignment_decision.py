"""Which of several solutions is right: by the motion of all places, by the ends of the lines, or by the user's word.

The rival is mostly the mirrored solution, with both lines exchanged at every place.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from lidarpose.errors import AmbiguousError, InputError
from lidarpose.geometry.arrays import FloatArray, IntArray, angle_between, unit
from lidarpose.geometry.se3 import Pose, exp_se3, log_se3
from lidarpose.model.observation import PlaceFeatures
from lidarpose.solve.assignment_candidates import FOLD_SLACK_M, LEAST_STRIPE_COVERED, Candidate, Pool
from lidarpose.solve.assignment_solutions import Solution, is_same, rms_misfit, support_of
from lidarpose.solve.line_pair import FittedLines, fit_line_pairs
from lidarpose.solve.panel_pose import PanelPose
from lidarpose.solve.single_pose import rotations_and_centres

# What a panel's pose may be wrong by beyond twice its stated deviation, because neither boards nor lenses are perfect,
# before one solution is held for better than another.
PANEL_TURN_RAD = 3e-4
PANEL_SHIFT_M = 2e-4
# A rival whose places are off by this much needs no closer look.
FAR_OFF_RAD = 0.005
# Places that the closer look takes.
LOOKED_AT = 10
# It beats it too where the lines' ends agree so much better with the stripes' ends (difference of chi-squared).
LEAST_ENDS_GAIN = 30.0
# A piece that detection has broken off a line, at a step from black squares to white ones, lies so near to it.
PIECE_OFF_M = 0.006
PIECE_GAP_M = 0.05
# A rival with candidates at fewer of the places that the best explains cannot be compared with it.
LEAST_SHARED = 0.5
# How unequally the ends of stripes may be cut off on both panels, by detection or by margins.
ENDS_BIAS_M = 0.015
HINT = "--first-panel"
BY_HINT = f"the order given by {HINT}"


@dataclass(frozen=True, eq=False)
class Decision:
    """The solution taken, what decided, the evidence, and what speaks against it where the user's word decided."""

    solution: Solution
    decided_by: str
    figures: dict[str, float]
    against: str | None = None


@dataclass(frozen=True)
class _Margin:
    """When one solution beats another: its residuals are smaller by a ratio at least, and that is no chance.

    The logarithm of the ratio of two equal deviations with n degrees of freedom scatters by sqrt(1/n) (more for small
    n): `deviations` times that. Residuals below the floor (of a stated sigma) count as the floor.
    """

    ratio: float
    deviations: float
    floor: float


# Residuals far below the stated sigma are rounding, not evidence.
BETTER = _Margin(ratio=2.0, deviations=5.0, floor=0.02)
# What the user states outweighs evidence that is not far beyond what would decide without his word.
AGAINST_STATED = _Margin(ratio=5.0, deviations=7.5, floor=1.0)


def decide(
    pool: Pool,
    solutions: list[Solution],
    places: Sequence[PlaceFeatures],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    first_panel: int | None,
) -> Decision:
    """The solution that the evidence is for, or the user's word. Raises where nothing decides."""
    best = solutions[0]
    solutions = [best, *(s for s in solutions[1:] if not is_same(best, s))]
    figures = {"solutions": float(len(solutions)), "rms_sigmas": rms_misfit(best.misfit, support_of(best))}
    look = partial(_rms_with_panels, pool, places, panel_poses)
    rivals = [s for s in solutions[1:] if not _beaten_by_motion(pool, best, s, look, BETTER)]
    if len(solutions) > 1:
        figures["rival_rms_sigmas"] = min(rms_misfit(s.misfit, support_of(best)) for s in solutions[1:])
    decided_by = "the motion of all places" if len(solutions) > 1 else "no rival"
    if rivals:
        gains = [_ends_gain(pool, places, best, s) for s in rivals]
        figures["ends_gain"] = min(gains)
        if min(gains) < -LEAST_ENDS_GAIN:  # a rival's ends agree better, and its motion is no worse
            best, rivals = rivals[int(np.argmin(gains))], [best, *rivals]
            rivals = [s for s in rivals if s is not best]
            gains = [_ends_gain(pool, places, best, s) for s in rivals]
        rivals = [s for s, gain in zip(rivals, gains, strict=True) if gain < LEAST_ENDS_GAIN]
        decided_by = "the ends of the lines"
    if first_panel is not None:
        beaten = [s for s in solutions if s is not best and s not in rivals]
        stated = _by_hint(pool, [best, *rivals, *beaten], places, first_panel, look, decided_by)
        figures["rms_sigmas"] = rms_misfit(stated.misfit, support_of(stated))
        told = BY_HINT if rivals or stated in beaten else decided_by
        return Decision(stated, told, figures, _against(stated, solutions[0], stated in beaten, decided_by))
    if rivals:
        raise AmbiguousError(
            "Nothing in the data tells which scan line lies on which panel: two mirrored solutions fit equally well",
            remedy=f"Say it with {HINT} 1 or {HINT} 2 (the panel that the scan line of smaller beam angle lies on), "
            "or tilt the board or shift one panel's end so that the two are no mirror images, and record again",
            misfit_sigmas=figures["rms_sigmas"],
        )
    return Decision(best, decided_by, figures)


def _against(stated: Solution, best: Solution, is_beaten: bool, decided_by: str) -> str | None:
    """What speaks for another order than the one stated: evidence that would do, or residuals that are smaller."""
    if is_beaten:
        return decided_by
    ours, theirs = (rms_misfit(s.misfit, support_of(s)) for s in (best, stated))
    return "residuals less than half as large" if theirs > BETTER.ratio * max(ours, AGAINST_STATED.floor) else None


def _by_hint(
    pool: Pool,
    solutions: Sequence[Solution],
    places: Sequence[PlaceFeatures],
    first_panel: int,
    look: Callable[[Solution, IntArray], float],
    decided_by: str,
) -> Solution:
    """The first of the solutions, the best before its rivals and these before what is beaten, that has the order told.

    The user stands beside the rig: he is contradicted by a motion that fits far worse, and never by the lines' ends.
    """
    best = solutions[0]
    for s in solutions:
        agrees = _share_with_hint(pool, s, places, first_panel) > 0.5
        if agrees and (s is best or not _beaten_by_motion(pool, best, s, look, AGAINST_STATED)):
            return s
    raise InputError(
        HINT,
        f"contradicted by {decided_by}: the line of smaller beam angle does not lie on panel {first_panel + 1}",
        remedy="Leave the option out, or check that the panels are in the session's order",
    )


def _share_with_hint(pool: Pool, solution: Solution, places: Sequence[PlaceFeatures], first_panel: int) -> float:
    votes = []
    for c in solution.chosen[solution.chosen >= 0]:
        candidate = pool.candidates[c]
        first, second = (places[candidate.place].lines[k] for k in candidate.lines)
        smaller = 0 if np.mean(first.angle_rad) < np.mean(second.angle_rad) else 1
        votes.append(smaller == first_panel)
    return float(np.mean(votes)) if votes else 0.0


def _beaten_by_motion(
    pool: Pool,
    best: Solution,
    rival: Solution,
    look: Callable[[Solution, IntArray], float],
    needed: _Margin,
) -> bool:
    """Whether the rival's places fit one motion so much worse that neither chance nor the panels' poses explain it.

    Both are judged by the places that both explain or might: a candidate that a rival lacks, because detection broke a
    line, is no evidence against it.
    """
    support = support_of(best)
    both = np.flatnonzero(support & (rival.chosen >= 0))
    if len(both) < max(3, LEAST_SHARED * support.sum()):
        return True
    ours, theirs = (float(np.sqrt(np.mean(s.misfit[both] ** 2))) for s in (best, rival))
    smallest = np.median([np.linalg.eigvalsh(c.sample.rotation_covariance())[0] for c in pool.candidates])
    if theirs * np.sqrt(smallest) >= FAR_OFF_RAD:
        return _is_smaller(ours, theirs, len(both), needed)
    both = both[np.unique(np.linspace(0, len(both) - 1, LOOKED_AT).astype(int))]
    theirs = look(rival, both)
    # A closer look only ever lowers the misfit: if the rival is beaten without one at the best, it is with one.
    ours = float(np.sqrt(np.mean(best.misfit[both] ** 2)))
    return _is_smaller(ours, theirs, len(both), needed) or _is_smaller(look(best, both), theirs, len(both), needed)


def _is_smaller(ours: float, theirs: float, places: int, needed: _Margin) -> bool:
    """Whether one root mean square misfit is smaller than another by more than chance explains.

    An F test of sorts: the ratio is free of the unknown factor by which all noise is larger than stated.
    """
    ratio = theirs / max(ours, needed.floor)
    freedom = max(6 * places - 10, 1)
    by_chance = needed.deviations / np.sqrt(freedom) * (1.0 + 5.0 / freedom)
    return bool(ratio > needed.ratio and np.log(ratio) > by_chance)


def _rms_with_panels(
    pool: Pool,
    places: Sequence[PlaceFeatures],
    panel_poses: Mapping[str, Sequence[PanelPose]],
    solution: Solution,
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
    candidates = [pool.candidates[c] for c in chosen]
    moved = _moved_by_panels(candidates, [panel_poses[places[k].placement] for k in which])
    for k, c, candidate, by_panel in zip(which, chosen, candidates, moved, strict=True):
        to_motion = solution.motion.pose_jacobian(pool.angle_rad[c])
        pose = solution.motion.pose(pool.angle_rad[c])
        back = pose.inverse().adjoint()
        root = np.linalg.cholesky(pool.information[c]).T
        e = back @ candidate.sample.pose.minus(pose)
        by_panels = np.zeros((6, 12 * len(names)))
        at = 12 * names.index(places[k].placement)
        by_panels[:, at : at + 12] = back @ by_panel
        rows.append(root @ np.hstack([-back @ to_motion, by_panels]))
        right.append(root @ e)
    prior = np.hstack([np.zeros((12 * len(names), 10)), np.eye(12 * len(names))])
    A = np.vstack([*rows, prior])
    b = np.concatenate([*right, np.zeros(len(prior))])
    rest = b - A @ np.linalg.lstsq(A, b, rcond=1e-12)[0]
    return float(np.sqrt(rest @ rest / (6 * len(which))))


def _moved_by_panels(candidates: Sequence[Candidate], poses: Sequence[Sequence[PanelPose]]) -> FloatArray:
    """How samples move (C, 6, 12), as left perturbation, for one deviation of each panel's pose in each direction."""
    panels = [_panels_moved(candidate, own) for candidate, own in zip(candidates, poses, strict=True)]
    R, t = _samples_on(candidates, np.stack([p[0] for p in panels]), np.stack([p[1] for p in panels]))
    back = np.swapaxes(R[:, :1], -1, -2)
    turn = R[:, 1:] @ back
    shift = t[:, 1:] - (turn @ t[:, :1, :, None])[..., 0]
    return np.asarray(np.swapaxes(log_se3(turn, shift), 1, 2) / _SMALL_SHARE)


_SMALL_SHARE = 0.1


def _panels_moved(candidate: Candidate, poses: Sequence[PanelPose]) -> tuple[FloatArray, FloatArray]:
    """Planes of both panels as they are and moved in twelve ways: normals (13, 2, 3), offsets (13, 2)."""
    normals, offsets = np.empty((13, 2, 3)), np.empty((13, 2))
    for key in (0, 1):
        T = poses[key].T_camera_panel
        middle = Pose(np.eye(3), candidate.stripes.E_camera).adjoint()
        slack = np.diag([PANEL_SHIFT_M**2] * 3 + [PANEL_TURN_RAD**2] * 3)
        spread = np.linalg.cholesky(4.0 * poses[key].covariance + middle @ slack @ middle.T)
        normal = T.rotation[:, 2]
        normals[:, key], offsets[:, key] = normal, normal @ T.translation
        turn, shift = exp_se3(_SMALL_SHARE * spread.T)
        own = slice(1 + 6 * key, 7 + 6 * key)
        normals[own, key] = turn @ normal
        offsets[own, key] = (normals[own, key] * (turn @ T.translation + shift)).sum(axis=1)
    return normals, offsets


def _samples_on(
    candidates: Sequence[Candidate], normals: FloatArray, offsets: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Rotations (C, K, 3, 3) and centres (C, K, 3) of samples on panels that stand a little differently, K ways."""
    C, K = offsets.shape[:2]
    light_normal, light_offset = np.empty((C, K, 3)), np.empty((C, K))
    for c, candidate in enumerate(candidates):
        points = np.concatenate(
            [
                offsets[c, :, key, None, None] / (normals[c, :, key] @ rays.T)[..., None] * rays
                for key, rays in enumerate(candidate.rays_camera)
            ],
            axis=1,
        )
        weights = np.concatenate(candidate.stripes.light_plane.weights)
        mean = weights @ points / weights.sum()
        d = (points - mean[:, None]) * np.sqrt(weights)[:, None]
        light_normal[c] = np.linalg.eigh(np.swapaxes(d, 1, 2) @ d)[1][:, :, 0]
        light_offset[c] = (light_normal[c] * mean).sum(axis=1)
    old = np.array([c.stripes.directions_camera for c in candidates])[:, None]
    directions = unit(np.cross(light_normal[:, :, None], normals))
    directions = directions * np.where((directions * old).sum(axis=-1) > 0.0, 1.0, -1.0)[..., None]
    three = np.concatenate([normals, light_normal[:, :, None]], axis=2)
    right = np.concatenate([offsets, light_offset[..., None]], axis=2)
    E = np.linalg.solve(three, right[..., None])[..., 0]
    alpha = angle_between(directions[:, :, 0], directions[:, :, 1]).ravel()
    which = np.repeat(np.arange(C), K)
    first, second = (FittedLines.of([c.fits[side] for c in candidates]).take(which) for side in (0, 1))
    R, t = rotations_and_centres(E.reshape(-1, 3), directions.reshape(-1, 2, 3), fit_line_pairs(first, second, alpha))
    return R.reshape(C, K, 3, 3), t.reshape(C, K, 3)


def _ends_gain(pool: Pool, places: Sequence[PlaceFeatures], best: Solution, rival: Solution) -> float:
    """By how much chi-squared of the lines' ends, against the stripes' ends, is smaller for the best than the rival.

    Only the difference between both panels counts: detection may well cut off stripes and lines, but alike on both. An
    unknown inequality of that is allowed for, the same at all places. What one place alone says does not count: the
    gain is what is left without the place that says most.
    """
    both = np.flatnonzero((best.chosen >= 0) & (rival.chosen >= 0))
    if len(both) < 2:
        return 0.0
    chosen = [[pool.candidates[s.chosen[p]] for p in both] for s in (best, rival)]
    ends = np.array([[_ends_with_pieces(places[c.place], c) for c in own] for own in chosen])
    stripes = np.array([[c.stripes.extents_m for c in own] for own in chosen])
    spacing = float(np.median([c.spacing_m for c in chosen[0]]))
    # Where neither order covers the stripes, a piece of a line is lost, and its end is not the panel's.
    common = np.minimum(ends, stripes)[..., 1] - np.maximum(ends, stripes)[..., 0]
    whole = (common > LEAST_STRIPE_COVERED[0] * np.ptp(stripes, axis=-1)).all(axis=2).any(axis=0)
    if whole.sum() < 2:
        return 0.0
    off = (ends - stripes)[:, whole]
    differences = off[:, :, 0] - off[:, :, 1]
    # Scatter from place to place, of the better one, never below two beams.
    scatter = [float(np.median(np.abs(d - np.median(d, axis=0)))) * 1.4826 for d in differences]
    sigma = max(min(scatter), 2.0 * spacing, 0.003)
    ours, theirs = (_chi2_without_each(d, sigma) for d in differences)
    gains = theirs - ours
    return float(max(gains.min(), 0.0) + min(gains.max(), 0.0))


def _chi2_without_each(differences: FloatArray, sigma: float) -> FloatArray:
    """Chi-squared (1 + N,) of values (N, 2), all and without each place in turn.

    Noise `sigma` and one common unknown bias a column; outlying values are bounded.
    """
    d = np.clip(differences, -0.2, 0.2)
    left_out = np.vstack([np.zeros((1, d.shape[1])), d])
    n = np.array([len(d), *[len(d) - 1] * len(d)])[:, None]
    total, squares = d.sum(axis=0) - left_out, (d**2).sum(axis=0) - left_out**2
    common = ENDS_BIAS_M**2 / (sigma**2 + n * ENDS_BIAS_M**2)
    return np.asarray(((squares - common * total**2) / sigma**2).sum(axis=1))


def _ends_with_pieces(place: PlaceFeatures, candidate: Candidate) -> FloatArray:
    """Where both scan lines end along their panels (2, 2), with the pieces that detection has broken off them."""
    extents = np.array(candidate.extents_m)
    E = candidate.fits[0].line.intersection(candidate.fits[1].line)
    others = [line.points_lidar() for j, line in enumerate(place.lines) if j not in candidate.lines]
    for key, fit in enumerate(candidate.fits):
        outward = unit(fit.middle - E)
        low, high = np.sort((fit.ends - E) @ outward)
        for points in others:
            off = np.abs(points @ fit.line.normal - fit.line.offset)
            near, far = np.sort((points[[0, -1]] - E) @ outward)
            beside = max(near - high, low - far) < PIECE_GAP_M and near > -FOLD_SLACK_M
            if beside and off.max() < PIECE_OFF_M + 3.0 * fit.direction_sigma_rad * max(far - low, high - near):
                extents[key] += [min(near - low, 0.0), max(far - high, 0.0)]
                low, high = min(low, near), max(high, far)
    return extents
