"""Calibrations: results with their evidence."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose, skew
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion

Verdict = Literal["good", "doubtful", "rejected"]


@dataclass(frozen=True)
class Quality:
    """Is this good? A verdict with reasons, and the figures behind it (JSON-able, units in the keys)."""

    verdict: Verdict
    reasons: tuple[str, ...] = ()
    figures: Mapping[str, Any] = field(default_factory=dict, repr=False)

    @property
    def caution(self) -> str | None:
        """What whoever uses the result should know: the verdict and its first reason; None where it is good."""
        if self.verdict == "good":
            return None
        return f"the calibration's verdict is {self.verdict}" + "".join(f": {reason}" for reason in self.reasons[:1])


def uncertain_pose_at(
    motion: TurntableMotion, names: Sequence[str], covariance: FloatArray, turntable_angle_rad: float
) -> UncertainPose:
    """T_camera_lidar with its covariance at a reading, from that (n, n) of the named parameters, motion first."""
    J = motion.pose_jacobian(turntable_angle_rad)
    keep = [*range(len(PARAMETER_NAMES))]
    if "encoder_scale" in names:
        keep.append(list(names).index("encoder_scale"))
        J = np.column_stack([J, motion.pose_by_scale(turntable_angle_rad)])
    return UncertainPose(motion.pose(turntable_angle_rad), J @ covariance[np.ix_(keep, keep)] @ J.T)


@dataclass(frozen=True, eq=False)
class TurntableCalibration:
    """The LiDAR's pose in the camera frame as a function of the turntable's reading.

    Attributes
    ----------
    motion
        The two constant transforms.
    parameter_names, parameter_covariance
        Names, and covariance (n, n) in m and rad, of the estimate's parameters; the first ten are
        `lidarpose.model.turntable.PARAMETER_NAMES`. None where no uncertainty is known.
    quality, provenance
        Verdict and evidence; what is needed to repeat the run.
    beams
        What the LiDAR's own ranges and beam angles are off by, where that was estimated.
    """

    motion: TurntableMotion
    parameter_covariance: FloatArray | None = field(default=None, repr=False)
    parameter_names: tuple[str, ...] = field(default=PARAMETER_NAMES, repr=False)
    quality: Quality | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict, repr=False)
    beams: BeamCorrection = field(default_factory=BeamCorrection)

    @property
    def motion_covariance(self) -> FloatArray | None:
        """Covariance (10, 10) of `PARAMETER_NAMES`, or None."""
        return None if self.parameter_covariance is None else self.parameter_covariance[:10, :10]

    def pose(self, turntable_angle_rad: float) -> Pose:
        """T_camera_lidar at a reading of the turntable."""
        return self.motion.pose(turntable_angle_rad)

    def uncertain_pose(self, turntable_angle_rad: float) -> UncertainPose | None:
        """T_camera_lidar with its covariance at a reading of the turntable; None where no uncertainty is known."""
        if self.parameter_covariance is None:
            return None
        return uncertain_pose_at(self.motion, self.parameter_names, self.parameter_covariance, turntable_angle_rad)

    def axis_sigma(self) -> tuple[float, float] | None:
        """Standard deviations of the radius (m) and of the axis' direction in the camera frame (rad), both tilts."""
        C = self.motion_covariance
        if C is None:
            return None
        across = skew(self.motion.axis_direction_camera)
        return float(np.sqrt(C[6, 6])), float(np.sqrt(np.trace(across @ C[3:6, 3:6] @ across.T)))

    def transform_covariances(self) -> tuple[FloatArray, FloatArray] | None:
        """The 6x6 covariances of ``T_camera_turntable`` and ``T_turntable_lidar``, each by itself."""
        if self.motion_covariance is None:
            return None
        # At T_camera_turntable = identity and reading 0 the pose's perturbation is that of T_turntable_lidar.
        alone = TurntableMotion(Pose.identity(), self.motion.T_turntable_lidar).pose_jacobian(0.0)[:, 6:]
        return self.motion_covariance[:6, :6], np.asarray(alone @ self.motion_covariance[6:, 6:] @ alone.T)


@dataclass(frozen=True, eq=False)
class WorldCalibration:
    """Where a LiDAR (or the camera of a spun 2D LiDAR) is in the world: ``p_world = scale * R @ p + t``.

    Attributes
    ----------
    T_world_source
        The pose; `source` names the frame of the clouds, "lidar" or "camera".
    covariance : (6, 6) or None
        Of the pose's left perturbation, m and rad.
    """

    T_world_source: Pose
    source: Literal["lidar", "camera"] = "lidar"
    scale: float = 1.0
    covariance: FloatArray | None = field(default=None, repr=False)
    parameter_names: tuple[str, ...] = ()
    parameter_covariance: FloatArray | None = None
    quality: Quality | None = None
    provenance: Mapping[str, Any] = field(default_factory=dict, repr=False)


Calibration = TurntableCalibration | WorldCalibration
