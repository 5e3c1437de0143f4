"""A place whose world coordinates are off by so much that its returns no longer fit the estimate.

The joint estimate takes the world's coordinates for exact at first, and what does not fit has no say: of a place that
is off by more than the ranges' noise, faces lose their returns, and nothing is left to contradict. So where faces lose
returns the corners are estimated with the world's coordinates left free, and held against them place by place: if all
others agree once one place is left out, it is that place (leave-one-out residuals, Cook and Weisberg, Residuals and
Influence in Regression, 1982).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.se3 import Pose, nearest_rotation, skew
from lidarpose.model.corner_result import CornerPlaceFaces
from lidarpose.refine.corner_model import (
    CornerFit,
    CornerOptions,
    corner_covariances,
    fit_corner_model,
)
from lidarpose.refine.face_systems import some_residuals

# A turn of the target: far beyond chance (three degrees of freedom) and large enough to matter.
TURN_STATISTIC, TURN_DEG = 30.0, 0.2
# Of a face's returns, so many are no farther off than this where the estimate fits them.
FITTING_SHARE, FITTING_SIGMAS = 0.85, 3.0
# World coordinates held no better than this are free.
FREE_M = 0.1
# Off by less, a place stays in the estimate, which says how much it is off.
LEAST_M = 0.004
# Leaving one place out is believed in from this chance on that noise does as much.
CHANCE = 1e-3
# Twice the log likelihood by which it has to be better than leaving out any other.
CLEARLY = 20.0
FEWEST_PLACES = 4
STEPS = 8


@dataclass(frozen=True, eq=False)
class SlippedPlace:
    """The place that the others disagree with, among those of the estimate, and what its coordinates lack by the others
    (3,), metres."""

    place: int
    off: FloatArray


def loses_returns(fit: CornerFit, places: Sequence[CornerPlaceFaces]) -> bool:
    """Whether the returns of any face do not fit the estimate that was made from them."""
    corners = fit.state.corners(fit.world)
    for place, corner in zip(places, corners, strict=True):
        for j, returns in place.faces.items():
            off = np.abs(some_residuals(returns, fit.state.normals[j], corner))
            if np.count_nonzero(off < FITTING_SIGMAS * fit.range_sigma_m) < FITTING_SHARE * len(off):
                return True
    return False


def free_fit(places: Sequence[CornerPlaceFaces], fit: CornerFit, settled: float) -> CornerFit | None:
    """A joint estimate again, the world's coordinates all but free, so that each place's corner is its returns' own;
    None where that determines nothing."""
    options = CornerOptions(FREE_M, fit.options.estimate_scale)
    try:
        return fit_corner_model(places, fit.state, fit.range_sigma_m, options, settled=settled)
    except UndeterminedError:
        return None


def slipped_place(free: CornerFit, world_sigma_m: float = 0.0) -> SlippedPlace | None:
    """The one place that disagrees with all others, if leaving it out explains what disagrees and leaving out no other
    does; four places in a plane do not tell which of them is too high.

    Parameters
    ----------
    free
        What `free_fit` found.
    world_sigma_m
        How well the world's coordinates are measured, as stated.
    """
    from scipy.special import fdtrc

    world, corners = free.world, free.state.corners(free.world)
    covariances = corner_covariances(free) + world_sigma_m**2 * np.eye(3)
    count = len(world)
    if count < FEWEST_PLACES:
        return None
    together = _misfit(world, corners, covariances, np.ones(count, dtype=bool))[0]
    left = [_misfit(world, corners, covariances, np.arange(count) != k) for k in range(count)]
    misfits = np.array([misfit for misfit, _ in left])
    first, second = np.argsort(misfits)[:2]
    freedom = 3 * count - 9
    noise = max(float(misfits[first]) / freedom, 1.0)
    ratio = (together - float(misfits[first])) / (3.0 * noise)
    off = left[first][1] @ corners[first] - world[first]
    if fdtrc(3.0, float(freedom), max(ratio, 0.0)) * count > CHANCE or np.linalg.norm(off) < LEAST_M:
        return None
    if misfits[second] - misfits[first] < CLEARLY * noise or _is_turned(free, int(first)):
        return None
    return SlippedPlace(int(first), off)


def _is_turned(free: CornerFit, place: int) -> bool:
    """Whether the target was turned there: its corner is then off because its faces are."""
    moves, statistic, known = free.discrepancies
    turn_deg = np.degrees(np.linalg.norm(moves[place, 3:]))
    return bool(known[place] and statistic[place] > TURN_STATISTIC and turn_deg > TURN_DEG)


def _misfit(world: FloatArray, corners: FloatArray, covariances: FloatArray, used: BoolArray) -> tuple[float, Pose]:
    """The least sum of squares of what corners (P, 3) miss the world by, over their covariances, and the pose."""
    w, c = world[used], corners[used]
    R = nearest_rotation((w - w.mean(axis=0)).T @ (c - c.mean(axis=0)))
    pose = Pose(R, w.mean(axis=0) - R @ c.mean(axis=0))
    total = np.inf
    for _ in range(STEPS):
        moved = pose @ c
        weight = np.linalg.inv(pose.rotation @ covariances[used] @ pose.rotation.T)
        J = np.stack([np.hstack([np.eye(3), -skew(p)]) for p in moved])
        miss = w - moved
        before, total = total, float(np.einsum("pi,pij,pj->", miss, weight, miss))
        if before - total < 1e-3 * total:
            break
        JtW = J.transpose(0, 2, 1) @ weight
        # Corners on one line leave a turn about it open: the shortest step of all then.
        step = np.linalg.lstsq((JtW @ J).sum(axis=0), (JtW @ miss[..., None]).sum(axis=0)[:, 0], rcond=1e-12)[0]
        pose = Pose.exp(step) @ pose
    return total, pose
