"""How sure the LiDAR's pose is over the turn, in the millimetres and degrees that people read."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import UncertainPose, skew
from lidarpose.model.calibration import uncertain_pose_at
from lidarpose.model.turntable_run import TurntableRun

DISTANCES_M = (1.5, 3.0)
STEP_DEG = 2.5
# Weights below this count as left out.
LEAST_WEIGHT = 0.05
_AZIMUTHS = np.deg2rad(np.arange(-180.0, 180.0, 15.0))


@dataclass(frozen=True, eq=False)
class TurnNumbers:
    """Standard deviations at readings (M,) over the recorded arc and over a whole turn around it.

    Attributes
    ----------
    reading_deg : (M,)
        Ascending; the middle of the arc lies in the middle.
    centre_mm, rotation_deg : (M,)
        Of the LiDAR's centre and orientation: roots of the summed variances over the three axes.
    point_mm
        By distance in metres: (M,) of a scanned point there in the worst direction of the scan plane, from the pose
        alone (the ranges' own noise comes on top).
    inside : (M,)
        Whether the reading lies within the recorded arc.
    """

    reading_deg: FloatArray
    centre_mm: FloatArray
    rotation_deg: FloatArray
    point_mm: dict[float, FloatArray]
    inside: FloatArray

    def worst(self, values: FloatArray) -> tuple[float, float]:
        """Largest value inside the recorded arc, and over the whole turn."""
        return float(values[self.inside].max()), float(values.max())


def turn_numbers(run: TurntableRun) -> TurnNumbers | None:
    """The standard deviations over the turn; None where the calibration knows no covariance."""
    uncertain = uncertain_pose_of(run)
    if uncertain is None:
        return None
    low, high = arc_deg(run)
    middle = 0.5 * (low + high)
    half = max(180.0, 0.5 * (high - low))
    around = middle + np.linspace(-half, half, 2 * round(half / STEP_DEG) + 1)
    reading = np.union1d(around, [low, high])
    poses = [uncertain(float(a)) for a in np.deg2rad(reading)]
    return TurnNumbers(
        reading,
        np.array([1e3 * np.sqrt(max(np.trace(p.centre_covariance()), 0.0)) for p in poses]),
        np.array([np.rad2deg(np.sqrt(max(np.trace(p.rotation_covariance()), 0.0))) for p in poses]),
        {d: _points_mm(poses, d) for d in DISTANCES_M},
        np.asarray((reading >= low) & (reading <= high)),
    )


def uncertain_pose_of(run: TurntableRun) -> Callable[[float], UncertainPose] | None:
    """The pose with its covariance as a function of the reading in rad, or None where no covariance is known."""
    if run.estimate is not None:
        return run.estimate.uncertain_pose
    calibration = run.calibration
    names, covariance = calibration.parameter_names, calibration.parameter_covariance
    if covariance is None:
        return None
    return lambda angle_rad: uncertain_pose_at(calibration.motion, names, covariance, angle_rad)


def arc_deg(run: TurntableRun) -> tuple[float, float]:
    """Smallest and largest reading of the session."""
    readings = [np.rad2deg(place.turntable_angle_rad) for place in run.session.places]
    return float(min(readings)), float(max(readings))


def used_positions(run: TurntableRun, *, wholly: bool = False) -> set[str]:
    """Places of which some line (`wholly`: every kind of line on every panel) has a weight in the estimate.

    Without an estimate, the places that have a sample pose.
    """
    if run.estimate is None:
        return set(run.samples)
    counts: dict[str, int] = {}
    for group in run.estimate.residuals:
        if group.position is not None and bool(np.any(group.weights > LEAST_WEIGHT)):
            counts[group.position] = counts.get(group.position, 0) + 1
    kinds = len({g.kind for g in run.estimate.residuals if g.position is not None})
    least = kinds * len(run.observations.panels) if wholly else 1
    return {position for position, count in counts.items() if count >= least}


def _points_mm(poses: Sequence[UncertainPose], distance_m: float) -> FloatArray:
    """Standard deviations (P,) of a point at a distance, each in the worst of the scan plane's directions, mm."""
    beams = np.column_stack([np.cos(_AZIMUTHS), np.sin(_AZIMUTHS), np.zeros(len(_AZIMUTHS))])
    points = np.stack([p.pose @ (distance_m * beams) for p in poses])
    J = np.concatenate([np.broadcast_to(np.eye(3), (*points.shape, 3)), -skew(points)], axis=3)
    covariance = np.stack([p.covariance for p in poses])
    variance = ((J @ covariance[:, None]) * J).sum(axis=(2, 3))
    return np.asarray(1e3 * np.sqrt(np.maximum(variance.max(axis=1), 0.0)))
