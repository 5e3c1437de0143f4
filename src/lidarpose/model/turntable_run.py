"""A whole turntable calibration: the answer, and everything that a reader needs to judge it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal

from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.observation import LeftOut, TurntableObservations
from lidarpose.model.session import TurntableSession
from lidarpose.model.turntable import TurntableMotion

if TYPE_CHECKING:
    from lidarpose.model.turntable_result import TurntableEstimate

Method = Literal["joint", "paper"]


@dataclass(frozen=True)
class Deviation:
    """Mean and largest deviation of one quantity over the places."""

    mean: float
    largest: float


@dataclass(frozen=True)
class FunctionDeviation:
    """Deviation of a motion from the single places' poses: Table 1 of the turntable paper.

    It says how well the places agree with one motion, not how far the motion is from the truth.
    """

    centre_mm: Deviation
    z_deg: Deviation
    x_deg: Deviation


@dataclass(frozen=True)
class TruthError:
    """Error against a known truth (simulated sessions): over the session's readings, and over the whole turn."""

    arc_centre_mm: Deviation
    arc_rotation_deg: Deviation
    turn_centre_mm: Deviation
    turn_rotation_deg: Deviation


@dataclass(frozen=True, eq=False)
class TurntableRun:
    """What `lidarpose.workflows.turntable.calibrate_turntable` hands back.

    Attributes
    ----------
    session, observations
        What was recorded, and what was found in it.
    samples
        T_camera_lidar of each place by itself, by position (section 1 of the paper); empty where no stripe was seen.
    paper_motion
        The motion by the closed form (section 2 of the paper), or without stripes from boards and scans alone.
    deviation
        Of the reported motion from the samples; None where there are none.
    estimate
        The joint estimate with its evidence; None for method `paper`.
    calibration
        The answer.
    left_out
        Everything that was not used, with its reason.
    notes
        What the user should know, in words.
    """

    method: Method
    session: TurntableSession
    observations: TurntableObservations
    samples: Mapping[str, Pose]
    paper_motion: TurntableMotion
    deviation: FunctionDeviation | None
    calibration: TurntableCalibration
    estimate: TurntableEstimate | None = None
    left_out: tuple[LeftOut, ...] = ()
    notes: tuple[str, ...] = field(default=())
