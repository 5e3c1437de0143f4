"""Motions that many places agree on: a choice of one candidate a place, and the turning motion through them.

Motions through two candidates of two places are tried, and the best refined on all that they explain (a search in the
manner of RANSAC, but without chance).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.se3 import log_so3
from lidarpose.model.turntable import TurntableMotion
from lidarpose.solve.assignment_candidates import Pool
from lidarpose.solve.turntable_function import (
    Motions,
    fit_by_readings,
    motions_of_pairs,
    wide_pairs,
)

# Pairs of places whose motions are tried.
PAIRS = 24
REFINED = 6
# Weights of a motion that many places fit settle in eight steps; those of a wrong one never do.
REWEIGHED = 12
# A place supports a motion up to this many of its own sigmas (times what the other places show).
SUPPORT_SIGMAS = 6.0
# Residuals of this size are no evidence against a place: panels and cameras are never quite what the model says.
SLACK_SIGMAS = 20.0


@dataclass(frozen=True, eq=False)
class Solution:
    """A choice of one candidate a place (-1: none), the motion through them, their misfits (inf where none)."""

    chosen: IntArray
    motion: TurntableMotion
    misfit: FloatArray


def solutions_of(pool: Pool) -> list[Solution]:
    """Motions that explain three places or more, best first, with the exchanged choice of each beside it."""
    scored = sorted(_hypotheses(pool), key=lambda item: item[0])
    found: list[Solution] = []
    starts: set[bytes] = set()
    for _, chosen, start in scored:
        if len(starts) >= REFINED:
            break
        if chosen.tobytes() in starts:
            continue
        starts.add(chosen.tobytes())
        _add(found, _refined(pool, chosen, start))
    for solution in found:
        exchanged = _exchanged(pool, solution.chosen)
        if not _is_among(found, exchanged):
            _add(found, _refined(pool, exchanged, rechoose=False))
    return sorted(found, key=lambda s: _score(s.misfit))


def _add(found: list[Solution], solution: Solution | None) -> None:
    if solution is not None and not _is_among(found, solution.chosen):
        found.append(solution)


def _is_among(found: list[Solution], chosen: IntArray) -> bool:
    return any(np.array_equal(s.chosen, chosen) for s in found)


def is_same(a: Solution, b: Solution) -> bool:
    """Whether two solutions make the same choice at most places: then they are one, but for some bad places."""
    both = (a.chosen >= 0) & (b.chosen >= 0)
    return bool(both.any() and np.mean(a.chosen[both] == b.chosen[both]) > 0.5)


def support_of(solution: Solution) -> BoolArray:
    """The places that the solution explains."""
    finite = np.isfinite(solution.misfit)
    typical = float(np.median(solution.misfit[finite]))
    return np.asarray(finite & (solution.misfit < SUPPORT_SIGMAS * max(1.0, typical)))


def rms_misfit(misfit: FloatArray, support: BoolArray) -> float:
    """Root mean square misfit of as many places as the support has, the best ones; infinite if there are fewer."""
    n = int(support.sum())
    least = np.sort(misfit)[:n]
    return float(np.sqrt(np.mean(least**2))) if n and np.isfinite(least).all() else float("inf")


def _score(misfit: FloatArray) -> float:
    """Mean bounded misfit of the places: 0 fits, 1 does not."""
    with np.errstate(invalid="ignore"):
        return float(np.mean(np.where(np.isfinite(misfit), misfit**2 / (misfit**2 + SLACK_SIGMAS**2), 1.0)))


def _hypotheses(pool: Pool) -> list[tuple[float, IntArray, TurntableMotion]]:
    """Motions through two candidates of two places: each one's score and what it makes every place choose."""
    present = np.unique(pool.place)
    angle_of = {int(p): pool.angle_rad[pool.place == p][0] for p in present}
    pairs = wide_pairs(np.array([angle_of[int(p)] for p in present]), PAIRS)
    both = [
        (int(a), int(b))
        for i, j in pairs
        for a in np.flatnonzero(pool.place == present[i])
        for b in np.flatnonzero(pool.place == present[j])
    ]
    two = np.array(both, dtype=np.int64).reshape(-1, 2)
    two = two[_turn_agrees(pool, two)]
    if len(two) == 0:
        return []
    motions = motions_of_pairs(pool.angle_rad[two], pool.rotation[two], pool.translation[two])
    scored: list[tuple[float, IntArray, TurntableMotion]] = []
    for k, misfits in enumerate(pool.misfits(motions)):
        chosen, misfit = _choose(pool, misfits)
        scored.append((_score(misfit), chosen, TurntableMotion.from_any_frame(*motions.one(k))))
    return scored


def _turn_agrees(pool: Pool, two: IntArray) -> BoolArray:
    """Whether the LiDAR turned between two candidates (M, 2) by as much as the table did."""
    a, b = two.T
    turned = np.linalg.norm(log_so3(pool.rotation[b] @ np.swapaxes(pool.rotation[a], 1, 2)), axis=1)
    table = np.abs((pool.angle_rad[b] - pool.angle_rad[a] + np.pi) % (2.0 * np.pi) - np.pi)
    variance = np.array([np.trace(c.sample.rotation_covariance()) for c in pool.candidates])
    return np.asarray(np.abs(turned - table) < np.deg2rad(1.0) + 6.0 * np.sqrt(variance[a] + variance[b]))


def _choose(pool: Pool, misfits: FloatArray) -> tuple[IntArray, FloatArray]:
    """Each place's candidate of least misfit (-1 where it has none), and that misfit."""
    chosen: IntArray = np.full(pool.places, -1, dtype=np.int64)
    misfit = np.full(pool.places, np.inf)
    order = np.argsort(-misfits)  # the least comes last and stays
    chosen[pool.place[order]] = order
    misfit[pool.place[order]] = misfits[order]
    return chosen, misfit


def _refined(
    pool: Pool, chosen: IntArray, start: TurntableMotion | None = None, *, rechoose: bool = True
) -> Solution | None:
    """The motion through all chosen candidates, and what every place chooses then; None if it falls apart."""
    solution: Solution | None = None
    for _ in range(5):
        have = chosen[chosen >= 0]
        try:
            fitted = fit_by_readings(
                list(pool.angle_rad[have]),
                [pool.candidates[c].sample.pose for c in have],
                [pool.candidates[c].sample.covariance for c in have],
                start=start,
                most_reweighed=REWEIGHED,
            )
        except UndeterminedError:
            return solution
        misfits = pool.misfits(Motions.of(fitted.motion))[0]
        if rechoose:
            again, misfit = _choose(pool, misfits)
        else:
            again, misfit = chosen, np.where(chosen >= 0, misfits[chosen], np.inf)
        solution = Solution(again, fitted.motion, misfit)
        start = fitted.motion
        if np.array_equal(again, chosen):
            break
        chosen = again
    return solution


def _exchanged(pool: Pool, chosen: IntArray) -> IntArray:
    """The choice with both lines exchanged at every place (-1 where that is no candidate)."""
    index = {(c.place, c.lines): k for k, c in enumerate(pool.candidates)}
    out = np.full_like(chosen, -1)
    for place, c in enumerate(chosen):
        if c >= 0:
            i, j = pool.candidates[c].lines
            out[place] = index.get((place, (j, i)), -1)
    return out
