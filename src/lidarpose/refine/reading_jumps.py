"""Where a table turned by something else than its readings say: it slipped, it stuck, or sweeps were lost.

From one sweep to the next the range along a beam that stays on its surface, or on a parallel one, changes with the
table's turn alone. Each beam so tells the step; a jump is a step that nearly all of them agree about.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray, wrap_angle
from lidarpose.geometry.robust import MAD_TO_SIGMA, mad_sigma
from lidarpose.model.spun_scan import FlatReturns, ReadingJump
from lidarpose.refine.flatness import Solution

LEAST_BEAMS = 20
# Beams count by how much a turn changes their range; jumps rest on so many that count alike.
LEAST_ALIKE = 10.0
PARALLEL_RAD = np.radians(8.0)
# Ranges that do not change with the turn tell nothing of it (m/rad).
LEAST_SLOPE_M = 1e-3
# A jump is so much, so many standard deviations of a step, and agreed about by this share of what beams tell.
LEAST_JUMP_RAD = np.radians(0.5)
LEAST_SIGMAS = 6.0
AGREED = 0.7
# Ranges bend between two sweeps: less than this share of a step is not told from that.
LEAST_SHARE = 0.1
# Of a median of normal values, over that of their mean.
_MEDIAN_SIGMA = 1.2533


@dataclass(frozen=True, eq=False)
class _Step:
    sweeps: tuple[int, int]
    stated: float
    seen: float
    sigma: float
    alike: float
    agreed: float


def reading_jumps(solution: Solution, returns: FlatReturns) -> tuple[tuple[ReadingJump, ...], float]:
    """The jumps of a recording, the largest first, and what all readings scatter by (rad, robust).

    Both are of what is seen beside the readings, compared with the typical step, which a factor spoils alike.
    """
    steps = _steps(solution, returns)
    if len(steps) < 5:
        return (), 0.0
    excess = np.array([wrap_angle(s.seen - s.stated) for s in steps])
    excess = excess - np.median(excess)
    scatter = mad_sigma(excess, centred=True)
    least = LEAST_SHARE * float(np.median([abs(s.stated) for s in steps]))
    found = [
        (abs(x), s)
        for x, s in zip(excess, steps, strict=True)
        if abs(x) > max(LEAST_JUMP_RAD, least, LEAST_SIGMAS * float(np.hypot(s.sigma, scatter)))
        and s.alike >= LEAST_ALIKE
        and s.agreed >= AGREED
    ]
    jumps = tuple(ReadingJump(s.sweeps, s.stated, s.seen) for _, s in sorted(found, key=lambda f: -f[0]))
    noise = float(np.median([s.sigma for s in steps]))
    # A step holds the errors of two readings.
    beyond = float(np.sqrt(max(scatter**2 - noise**2, 0.0) / 2.0))
    return jumps, beyond if beyond > least else 0.0


def _steps(solution: Solution, returns: FlatReturns) -> list[_Step]:
    """Between neighbouring sweeps with beams enough in common."""
    slopes = solution.line.by_reading
    normals = np.stack([p.normal for p in solution.state.planes])
    parallel = np.abs(normals @ normals.T) > np.cos(PARALLEL_RAD)
    usable = np.flatnonzero(solution.line.usable)
    usable = usable[np.lexsort((returns.beam_rad[usable], returns.sweep[usable]))]
    numbers, first = np.unique(returns.sweep[usable], return_index=True)
    rows = np.split(usable, first[1:])
    steps = []
    for k in range(len(rows) - 1):
        a, b = _in_common(returns, rows[k], rows[k + 1])
        slope = 0.5 * (slopes[a] + slopes[b])
        keep = parallel[returns.surface[a], returns.surface[b]] & (np.abs(slope) > LEAST_SLOPE_M)
        if np.count_nonzero(keep) < LEAST_BEAMS:
            continue
        a, b, slope = a[keep], b[keep], slope[keep]
        weight = (slope / solution.sigma[returns.surface[a]]) ** 2
        told = (returns.range_m[b] - returns.range_m[a]) / slope
        turned = (1.0 + solution.state.extras[0]) * (returns.reading_rad[b] - returns.reading_rad[a])
        steps.append(_step((int(numbers[k]), int(numbers[k + 1])), told, float(np.median(turned)), weight))
    return steps


def _in_common(returns: FlatReturns, one: IntArray, other: IntArray) -> tuple[IntArray, IntArray]:
    """Returns of the same beams in two sweeps."""
    _, i, j = np.intersect1d(returns.beam_rad[one], returns.beam_rad[other], assume_unique=True, return_indices=True)
    return one[i], other[j]


def _step(sweeps: tuple[int, int], told: FloatArray, stated: float, weight: FloatArray) -> _Step:
    seen = _weighted_median(told, weight)
    alike = float(weight.sum() ** 2 / (weight**2).sum())
    spread = MAD_TO_SIGMA * _weighted_median(np.abs(told - seen), weight)
    sigma = max(_MEDIAN_SIGMA * spread / np.sqrt(alike), float(np.sqrt(2.0 / weight.sum())))
    near = np.abs(told - seen) < 0.5 * abs(seen - stated)
    return _Step(sweeps, stated, seen, sigma, alike, float(weight[near].sum() / weight.sum()))


def _weighted_median(values: FloatArray, weight: FloatArray) -> float:
    order = np.argsort(values)
    running = np.cumsum(weight[order])
    return float(values[order][np.searchsorted(running, 0.5 * running[-1])])
