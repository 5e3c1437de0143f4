"""What the joint estimate of a turntable session hands back: the answer with all of its evidence."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import Quality, TurntableCalibration, uncertain_pose_at
from lidarpose.model.observation import LeftOut
from lidarpose.model.turntable import TurntableMotion

Kind = Literal["corners", "stripes", "ranges"]
KINDS: tuple[Kind, ...] = ("corners", "stripes", "ranges")


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise of one kind of measurement, as the residuals show it.

    Attributes
    ----------
    count, used
        Measurements offered (a corner counts twice), and those with a weight above zero.
    stated_sigma
        Median standard deviation as stated with the observations; px or m.
    factor
        By how much the stated standard deviations have to be multiplied.
    sigma
        Their product: the scatter from one measurement to the next; px or m.
    place_sigma
        Standard deviation of what a whole line (a stripe or a scan line at one place) is off by beyond that scatter;
        0 where the data show no such part.
    neighbour_factor
        Variance inflation because what a line (or corner) is off by resembles that of its neighbours, and because the
        variance of whole lines was estimated from few; 1 where neither is so.
    redundancy
        Measurements less the parameters they paid for.
    rows_as_one
        How many neighbouring measurements of a line are worth one, since their errors resemble each other; 1 where they
        do not.
    """

    count: int
    used: int
    stated_sigma: float
    factor: float
    sigma: float
    place_sigma: float
    redundancy: float
    neighbour_factor: float = 1.0
    rows_as_one: float = 1.0


@dataclass(frozen=True, eq=False)
class ResidualGroup:
    """Residuals of one kind on one panel at one place (corners: of one board placement), measured minus predicted.

    Attributes
    ----------
    values : (N,)
        px for corners (x and y in turn) and stripes, m for ranges.
    weights : (N,)
        From 1 (fully used) to 0 (left out).
    sigma : (N,)
        Estimated standard deviations, same unit as `values`.
    """

    kind: Kind
    placement: str
    panel: int
    position: str | None
    turntable_angle_rad: float | None
    values: FloatArray
    weights: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class Direction:
    """A combination of the motion's parameters, and how well the data determine it where it matters most.

    `sigma_mm`, `sigma_deg`: the standard deviation of position and orientation that this direction alone causes at the
    reading `angle_deg`, where it causes most.
    """

    name: str
    sigma_mm: float
    sigma_deg: float
    angle_deg: float
    parameters: tuple[float, ...]
    remedy: str = ""


@dataclass(frozen=True)
class ExtraParameter:
    """A further parameter: estimated, or tested with what it would be if it were estimated.

    Attributes
    ----------
    name
        "range_offset_m" and the like; see `lidarpose.refine.turntable_parameters.EXTRAS`.
    value, sigma
        Estimate and standard deviation in the unit of the name; for one that was only tested, of one linear step.
    estimated
        Whether it is part of the estimate.
    observable
        Whether the data can tell it from the other parameters.
    suggested
        Whether the residuals call for it.
    note
        In words, where there is something to say.
    """

    name: str
    value: float
    sigma: float
    estimated: bool
    observable: bool
    suggested: bool = False
    note: str = ""


@dataclass(frozen=True, eq=False)
class TurntableEstimate:
    """The joint estimate of a turntable session.

    Attributes
    ----------
    motion
        The LiDAR's motion, in the fixed frames.
    panel_poses
        By placement: T_camera_panel of each panel (None for a panel that was not used).
    parameter_names, parameter_covariance
        The ten numbers of the motion first, then the extra parameters that were estimated, then each panel's left
        perturbation; covariance (n, n) in m and rad.
    noise
        By kind, of the kinds present.
    residuals
        By kind, placement, panel and place.
    left_out
        What was not used at all, or only with a small weight, each with its reason.
    cost, converged, iterations
        Half the weighted sum of squares in units of the estimated noise, and how the solver got there.
    condition_number
        Of the information matrix scaled to a unit diagonal.
    directions
        Of the ten numbers, weakest first.
    extras
        Further parameters, estimated or tested.
    findings
        Contradictions and alternatives that were found, in words for the user.
    quality
        The verdict, its reasons and figures.
    """

    motion: TurntableMotion
    panel_poses: Mapping[str, tuple[Pose | None, ...]]
    parameter_names: tuple[str, ...]
    parameter_covariance: FloatArray
    noise: Mapping[Kind, NoiseEstimate]
    residuals: tuple[ResidualGroup, ...]
    left_out: tuple[LeftOut, ...]
    cost: float
    converged: bool
    iterations: int
    condition_number: float
    directions: tuple[Direction, ...]
    extras: tuple[ExtraParameter, ...]
    quality: Quality
    findings: tuple[str, ...] = ()
    extra_values: Mapping[str, float] = field(default_factory=dict)

    @property
    def motion_covariance(self) -> FloatArray:
        """Covariance (10, 10) of `lidarpose.model.turntable.PARAMETER_NAMES`."""
        return self.parameter_covariance[:10, :10]

    def uncertain_pose(self, turntable_angle_rad: float) -> UncertainPose:
        """T_camera_lidar with its covariance at a reading of the turntable."""
        return uncertain_pose_at(self.motion, self.parameter_names, self.parameter_covariance, turntable_angle_rad)

    def calibration(self, provenance: Mapping[str, Any] | None = None) -> TurntableCalibration:
        """What goes into the calibration file."""
        beams = BeamCorrection.from_extras(self.extra_values)
        return TurntableCalibration(
            self.motion, self.parameter_covariance, self.parameter_names, self.quality, provenance or {}, beams
        )
