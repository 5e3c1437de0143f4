"""Does the answer depend on a few places? Parts of the arc are left out, one linear step each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.refine.joint_equations import Moments, lines_of, reduced_moments
from lidarpose.refine.least_squares import add_lines, covariance_and_condition
from lidarpose.refine.turntable_estimate import OutsideParameters
from lidarpose.refine.turntable_joint import Solution
from lidarpose.refine.turntable_parameters import N_GLOBAL, N_MOTION
from lidarpose.refine.turntable_state import motion_map


@dataclass(frozen=True)
class Stability:
    """How far the pose inside the arc moves when a part of the places is left out.

    `ratio`: that move, in units of the standard deviation that it should have.
    """

    shift_mm: float
    turn_deg: float
    ratio: float
    without: str


def leave_places_out(solution: Solution, outside: OutsideParameters, parts: int = 4) -> Stability | None:
    """The part of the arc without which the pose at the arc's middle would change most unexpectedly.

    The difference of an estimate and one from a part of its data has the difference of their covariances (Hausman,
    1978). None where there are too few places to leave any out.
    """
    data = solution.data
    order = np.argsort(data.angles_rad, kind="stable")
    if len(order) < 5:
        return None
    reduced = {kind: reduced_moments(m, solution.noise.lines[kind]) for kind, m in solution.moments.items()}
    to_motion = motion_map(solution.state, outside.motion, data.reference_rad)
    to_pose = outside.motion.pose_jacobian(data.reference_rad) @ to_motion
    worst: Stability | None = None
    for block in np.array_split(order, min(parts, len(order))):
        gone = np.isin(np.arange(len(order)), block)
        change, expected = _without(solution, reduced, gone)
        xi = to_pose @ change[:N_MOTION]
        ratio = stability_ratio(xi, to_pose @ expected[:N_MOTION, :N_MOTION] @ to_pose.T)
        if worst is None or ratio > worst.ratio:
            centre = outside.motion.pose(data.reference_rad).translation
            shift = xi[:3] + np.cross(xi[3:], centre)
            angles = np.rad2deg(data.angles_rad[gone])
            worst = Stability(
                float(1e3 * np.linalg.norm(shift)),
                float(np.rad2deg(np.linalg.norm(xi[3:]))),
                ratio,
                f"the places from {angles.min():.2f} to {angles.max():.2f} degrees",
            )
    return worst


def _without(solution: Solution, reduced: Moments, gone: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Change of the active parameters without some places, and the covariance that it should have."""
    n = N_GLOBAL + 6 * len(solution.data.slots)
    information, gradient = np.zeros((n, n)), np.zeros(n)
    for kind, residuals in solution.at.lines.items():
        lines = lines_of(solution.data, kind)
        mine = gone[lines.place]
        add_lines(
            reduced[kind][mine], residuals.to_parameters[mine], lines.slot[mine], N_GLOBAL, (information, gradient)
        )
    use = np.asarray(solution.active)
    left = solution.equations.information[np.ix_(use, use)] - information[np.ix_(use, use)]
    covariance, _, _ = covariance_and_condition(left)
    change = covariance @ (solution.equations.gradient[use] - gradient[use])
    change = change - solution.covariance @ solution.equations.gradient[use]
    return change, covariance - solution.covariance


def stability_ratio(change: FloatArray, expected: FloatArray) -> float:
    """Size of a change (6,) of the pose in units of what its covariance (6, 6) lets expect, per degree of freedom."""
    values, vectors = np.linalg.eigh(expected)
    keep = values > 1e-9 * max(float(values[-1]), 1e-300)
    if not keep.any():
        return 0.0
    along = vectors[:, keep].T @ change
    return float(np.sqrt((along**2 / values[keep]).sum() / keep.sum()))
