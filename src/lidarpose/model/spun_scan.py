"""A spun 2D LiDAR calibrated from what it sees: returns on flat surfaces, and the estimate they give."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Quality, TurntableCalibration
from lidarpose.model.turntable_result import ExtraParameter


@dataclass(frozen=True, eq=False)
class FlatReturns:
    """Returns on flat surfaces, as the instrument gave them; surfaces are numbered from 0, none is missing.

    Attributes
    ----------
    reading_rad, beam_rad, range_m : (n,)
        The turntable's reading, the beam's angle, the range.
    sweep, surface : (n,)
        Which sweep a return is of, and which surface it lies on.
    left_out_rad : (n,) or None
        By how much further the table would be turned at the return if it moved during sweeps the other way than the
        readings have it: on and on where they are of whole sweeps, not at all where each beam has its own.
    """

    reading_rad: FloatArray
    beam_rad: FloatArray
    range_m: FloatArray
    sweep: IntArray
    surface: IntArray
    left_out_rad: FloatArray | None = None

    def __len__(self) -> int:
        return len(self.range_m)

    @property
    def surfaces(self) -> int:
        """How many."""
        return int(self.surface.max()) + 1 if len(self) else 0


@dataclass(frozen=True, eq=False)
class FlatSurface:
    """A surface of the estimate.

    Attributes
    ----------
    plane
        In the table's frame.
    returns, used
        On it, and of these with more than half of the full weight.
    sigma_m
        Robust spread of the ranges along the beam.
    pull
        By how many standard deviations (root mean square) it disagrees with the others about what is estimated.
    """

    plane: Plane
    returns: int
    used: int
    sigma_m: float
    pull: float


@dataclass(frozen=True)
class ReadingJump:
    """Two sweeps between which the table turned by something else than its readings say.

    Attributes
    ----------
    sweeps
        Their numbers in the recording, from 0.
    stated_rad, seen_rad
        By how much by the readings, and by what the beams saw.
    """

    sweeps: tuple[int, int]
    stated_rad: float
    seen_rad: float


@dataclass(frozen=True, eq=False)
class MountingEstimate:
    """How a LiDAR sits on its turntable, from the flatness of what it sees.

    Attributes
    ----------
    T_table_lidar
        In the table's frame: z along the axis, the foot of the LiDAR's centre at height 0. The turn about z is as in
        the start: nothing in the scene tells it.
    reading_origin_rad
        The reading about which a factor on readings is counted.
    extras
        Further parameters, estimated or tested.
    parameter_names, covariance
        "rx_rad", "ry_rad" (left rotation of T_table_lidar, its translation held), "x_m", "y_m" (its translation), then
        the extra parameters that were estimated.
    noise_covariance
        Of the same, without what bent surfaces, missing parameters and an unknown turn during the sweeps add.
    surfaces
        Those that were used.
    bending_m
        What parts of the surfaces are off by beyond their noise: root mean square over all parts.
    reading_scatter_rad
        What single sweeps' readings seem to be off by beyond their noise: root mean square.
    jumps
        Of the readings, the largest first.
    bend_m
        Standard deviation of smooth shapes that the surfaces have, each a root mean square over its surface.
    turning
        How much of a turn during the sweeps the readings leave out, and its standard deviation: 0 where the table moves
        as they have it, 1 where the other way; None where that cannot be asked.
    spread_factor
        By how much more the surfaces disagree with each other than their patches say; the covariance is widened by it
        where it is above 1.
    """

    T_table_lidar: Pose
    reading_origin_rad: float
    extras: tuple[ExtraParameter, ...]
    parameter_names: tuple[str, ...]
    covariance: FloatArray
    noise_covariance: FloatArray
    surfaces: tuple[FlatSurface, ...]
    bending_m: float
    reading_scatter_rad: float
    jumps: tuple[ReadingJump, ...]
    bend_m: float
    turning: tuple[float, float] | None
    spread_factor: float
    converged: bool
    quality: Quality

    @property
    def extra_values(self) -> Mapping[str, float]:
        """Of the extra parameters that were estimated."""
        return {e.name: e.value for e in self.extras if e.estimated}


@dataclass(frozen=True, eq=False)
class SurfacePoints:
    """The returns of an estimate as it puts them.

    Attributes
    ----------
    points : (n, 3)
        In the table's frame.
    surface : (n,)
        Which of the estimate's surfaces a return lies on.
    off_m : (n,)
        Its distance from that plane, positive along the normal.
    """

    points: FloatArray
    surface: IntArray
    off_m: FloatArray


@dataclass(frozen=True, eq=False)
class MountingRun:
    """A whole self-calibration: the file's content and the evidence.

    `returns` is how many were looked at, `seen` those of them that lie on the surfaces, for a report.
    """

    calibration: TurntableCalibration
    estimate: MountingEstimate
    returns: int
    rounds: int
    seen: SurfacePoints | None = None
