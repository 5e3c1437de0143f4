"""Whether a table stood still during each sweep, as its readings have it, or turned on, or the other way round.

A table that turns evenly during a sweep moves a beam by its angle times a constant. That is nearly what a lean of the
LiDAR in its fan does: no residual shows it, and the mounting is off by as much. How much of the turning there is, is
one more parameter; nothing and all of it are the two rigs that exist.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.model.spun_scan import FlatReturns, ReadingJump
from lidarpose.refine.bent_surfaces import bend_of, without_plane
from lidarpose.refine.flatness import Solution, patches_of

# The other rig fits worse by this much: twice the logarithm of how much likelier the readings' own rig is.
TOLD_BY = 9.0
# So many standard deviations from what the readings say, and they are wrong.
CONTRADICTED_SIGMAS = 4.0


@dataclass(frozen=True, eq=False)
class SweepTurning:
    """How much there is of a turn that the readings leave out.

    Attributes
    ----------
    share, sigma
        0 is a table as the readings have it, 1 the other kind.
    move : (p,)
        What the estimated parameters change by where it is the other kind.
    """

    share: float
    sigma: float
    move: FloatArray

    @property
    def contradicted(self) -> bool:
        """Whether the scene contradicts the readings."""
        return abs(self.share) > CONTRADICTED_SIGMAS * self.sigma

    @property
    def open(self) -> bool:
        """Whether the scene leaves open which kind it is."""
        return not self.contradicted and 1.0 - 2.0 * self.share < TOLD_BY * self.sigma**2


def sweep_turning(solution: Solution, returns: FlatReturns, free: IntArray) -> SweepTurning | None:
    """One linear step for the share, beside the estimated parameters `free` (p,); None where nothing is left out."""
    if returns.left_out_rad is None:
        return None
    line, weight = solution.line, solution.weight
    by = np.column_stack([line.by_all[:, free], line.by_reading * returns.left_out_rad])
    rows = _without_planes(solution, returns, by)
    information = rows.T @ rows
    p = len(free)
    along = np.linalg.solve(information[:p, :p], information[:p, p])
    if not information[p, p] - along @ information[:p, p] > 1e-9 * information[p, p]:
        return None
    pull = rows * (np.sqrt(weight) * line.residual)[:, None]
    patch, patches = patches_of(returns)
    scores = np.stack([np.bincount(patch, pull[:, j], patches) for j in range(p + 1)], axis=1)
    spread = scores.T @ scores * (patches / max(patches - p - 1 - 3 * returns.surfaces, 1))
    inverse = np.linalg.inv(information)
    variance = float((inverse @ spread @ inverse)[p, p] + bend_of(solution, returns, by).covariance[p, p])
    share = float((inverse @ pull.sum(axis=0))[p])
    return SweepTurning(share, float(np.sqrt(variance)), -along)


def moved_by_jumps(
    solution: Solution, returns: FlatReturns, free: IntArray, jumps: Sequence[ReadingJump]
) -> FloatArray:
    """What each jump of the readings moves the estimated parameters `free` by (J, p), in one linear step."""
    if not jumps:
        return np.zeros((0, len(free)))
    by_reading = solution.line.by_reading
    after = [(j.seen_rad - j.stated_rad) * by_reading * (returns.sweep >= j.sweeps[1]) for j in jumps]
    rows = _without_planes(solution, returns, np.column_stack([solution.line.by_all[:, free], *after]))
    p = len(free)
    information = rows[:, :p].T @ rows
    return np.asarray(-np.linalg.solve(information[:, :p], information[:, p:]).T)


def _without_planes(solution: Solution, returns: FlatReturns, by: FloatArray) -> FloatArray:
    """Weighted derivatives (n, q), without what the planes take up of them."""
    rows = np.zeros_like(by)
    root = np.sqrt(solution.weight)[:, None]
    for k in range(returns.surfaces):
        mine = np.flatnonzero((returns.surface == k) & (solution.weight > 0.0))
        rows[mine] = without_plane(root[mine] * by[mine], root[mine] * solution.line.by_plane[mine])
    return rows
