"""Sizes from what was scanned: disks and round holes, boxes, planes. No disk, no printing."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.measure.assemble import readings_between
from lidarpose.measure.beams import Beams, MovedBeams, beams_of, chosen_beams, range_noise
from lidarpose.measure.box import BoxMeasurement
from lidarpose.measure.box import measure_box as measure_box_of
from lidarpose.measure.box import with_calibration as box_with_calibration
from lidarpose.measure.cloud_beams import beams_of_cells, beams_of_rings, recording_from_cloud
from lidarpose.measure.disk import RoundMeasurement, measure_round, with_calibration
from lidarpose.measure.outline import Kind, nothing_round
from lidarpose.measure.planes import MeasuredPlane, PointShifts, joined_planes, plane_angle_sigmas_deg
from lidarpose.measure.point_sigma import point_shifts, shifting_covariance
from lidarpose.model.beam_correction import BeamCorrection
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.recording import SweepRecording
from lidarpose.workflows.scanning import in_true_angles, require_times

# Ranges without any noise are still rounded to float32.
_LEAST_NOISE_M = 1e-5
# Coordinates in longer steps hold no shapes. Single precision has 1 mm at 10 km from the origin, 0.5 m in a national
# grid.
_LONGEST_STEP_M = 5e-3


@dataclass(frozen=True, eq=False)
class MeasuringView:
    """What measuring works from.

    Attributes
    ----------
    beams
        A grid of beams in the frame named by `frame`; empty for a cloud that gives none.
    noise_m
        Of a range; NaN where too few beams lie side by side to tell.
    sees_behind
        False if only the object's own points can be trusted: the cloud's viewpoint is not known.
    covariance, moved, shifts
        The covariance of all of the calibration's parameters that move points, the beams of flat indices under a
        change of these, and the derivative of points of flat indices by them.
    remarks
        What a person should know of it.
    from_sensor
        All beams start at the frame's origin. Planes through it are seen edge-on: a ring's points lie in one.
    cloud : (N, 3)
        All points of a cloud that does not tell its beams: the grid may hold one of several.
    """

    beams: Beams
    noise_m: float
    frame: str
    sees_behind: bool = True
    covariance: FloatArray | None = None
    moved: MovedBeams | None = None
    shifts: PointShifts | None = None
    remarks: tuple[str, ...] = ()
    from_sensor: bool = False
    cloud: FloatArray | None = None

    @property
    def grid(self) -> Beams:
        """The beams. Raises UndeterminedError where they are too few to tell their noise."""
        if not np.isfinite(self.noise_m):
            raise UndeterminedError(
                "There are too few returns side by side to measure anything",
                remedy="Record at least eight sweeps with eight beams each on the object; give clouds in the frame of "
                "their sensor.",
            )
        return self.beams

    @property
    def points(self) -> FloatArray:
        """(N, 3), NaN for beams without return."""
        return self.beams.points.reshape(-1, 3) if self.cloud is None else self.cloud


def view_of_recording(recording: SweepRecording, calibration: TurntableCalibration) -> MeasuringView:
    """The beams of a recording in the camera frame.

    Raises
    ------
    UndeterminedError
        If there are too few returns.
    """
    recording = in_true_angles(recording, calibration)

    def moved(change: FloatArray, index: IntArray) -> Beams:
        return chosen_beams(recording, calibration, index, change)

    beams = beams_of(recording, calibration.motion.in_true_angles)
    caution = None if calibration.quality is None else calibration.quality.caution
    remarks: tuple[str, ...] = () if caution is None else (caution,)
    if calibration.motion_covariance is None:
        remarks += (
            "the calibration carries no covariance: its share of standard deviations is not known and left out",
        )
    noise = _noise(beams, recording.lidar.range_sigma_m)
    return MeasuringView(
        beams,
        noise,
        "camera",
        True,
        shifting_covariance(calibration),
        moved,
        lambda index: point_shifts(beams.points.reshape(-1, 3)[index], index, recording, calibration),
        remarks,
    )


def view_of_cloud(cloud: Cloud, calibration: TurntableCalibration | None) -> MeasuringView:
    """Beams recovered from a plain cloud: by the turntable's motion, by the LiDAR's rings, or by directions alone.

    Where they give none, the view holds the points alone, which suffice for planes.

    Raises
    ------
    UndeterminedError
        If there are too few points.
    """
    keep = np.isfinite(cloud.points).all(axis=1) & (np.abs(cloud.points).max(axis=1, initial=0.0) > 1e-6)
    points = cloud.points[keep].astype(np.float64)
    step_m = float(np.median(np.spacing(np.abs(cloud.points[keep])).max(axis=1))) if len(points) else 0.0
    if step_m > _LONGEST_STEP_M:
        raise UndeterminedError(
            f"The cloud lies too far from its origin for single precision: its points come in steps of {step_m:.2g} m",
            remedy="Write it in double precision, or subtract an offset before it is written.",
        )
    light = None
    if "intensity" in cloud.fields:
        light = np.asarray(cloud.fields["intensity"][keep], dtype=np.float64)
    if len(points) < 100:
        raise UndeterminedError("The cloud holds too few points to measure anything", remedy="Give a denser cloud.")
    if calibration is not None:
        # A cloud tells where the table stood and what was met, not what was read.
        calibration = replace(calibration, motion=calibration.motion.in_true_angles, beams=BeamCorrection())
        recording = recording_from_cloud(points, calibration.motion, light)
        if recording is not None:
            view = view_of_recording(recording, calibration)
            return replace(view, remarks=(*view.remarks, "the beams were recovered from the cloud by the calibration"))
    ring = next((cloud.fields[name][keep] for name in ("ring", "line", "channel") if name in cloud.fields), None)
    beams = beams_of_rings(points, ring, light)
    if beams is not None:
        return MeasuringView(beams, _noise(beams, None), cloud.frame or "cloud", from_sensor=True)
    beams = beams_of_cells(points, light)
    if beams is None:
        none = Beams(np.zeros((0, 0, 3)), np.zeros((0, 0, 3)), np.zeros((0, 0)))
        return MeasuringView(none, np.nan, cloud.frame or "cloud", False, cloud=points)
    remark = "the cloud does not tell its beams: sizes are good to about half the distance between points"
    return MeasuringView(beams, _noise(beams, None), cloud.frame or "cloud", False, remarks=(remark,), cloud=points)


def measure_disk(view: MeasuringView, kind: Kind = "disk", *, seed: int = 0) -> list[RoundMeasurement]:
    """Disks (or round holes), the best determined first.

    Source: the turntable paper, section 3.2, with the edge estimated from where beams stop hitting it instead of the
    outermost points.

    Raises
    ------
    UndeterminedError
        If nothing round is found.
    """
    found = measure_round(view.grid, view.noise_m, kind, sees_behind=view.sees_behind, seed=seed)
    if not found:
        raise nothing_round(kind)
    if view.covariance is None or view.moved is None:
        return found
    return [with_calibration(m, view.moved, view.covariance) for m in found]


def measure_box(view: MeasuringView, *, seed: int = 0) -> BoxMeasurement:
    """The box that stands out most: its three edge lengths.

    Raises
    ------
    UndeterminedError
        If no box is found, or an end of an edge is not seen.
    """
    box = measure_box_of(view.grid, view.noise_m, seed=seed)
    if view.covariance is None or view.moved is None:
        return box
    return box_with_calibration(box, view.moved, view.covariance)


def measure_planes(view: MeasuringView, *, least_share: float = 0.002, seed: int = 0) -> list[MeasuredPlane]:
    """The flat patches of a view, those of one plane joined, largest first.

    Parameters
    ----------
    least_share
        Patches with a smaller share of all points are left out.

    Raises
    ------
    UndeterminedError
        If nothing flat is found.
    """
    points = view.points
    seen = np.flatnonzero(np.isfinite(points[:, 0]))
    # Coordinates of a national grid are too long for single precision.
    near = points[seen] if view.cloud is None else points - np.median(points, axis=0)
    search = PlaneSearch(min_points=60, min_share=least_share, seed=seed, bent=True, from_sensor=view.from_sensor)
    patches = segment_planes(near, search)
    noise_m = view.noise_m
    if patches and (view.cloud is not None or not np.isfinite(noise_m)):
        noise_m = float(np.median([p.sigma_m for p in patches]))
    planes = joined_planes(points, [seen[p.indices] for p in patches], noise_m)
    if not planes:
        raise UndeterminedError(
            "Nothing flat was found", remedy="A plane must hold at least 60 points and a five hundredth of all."
        )
    return planes


def plane_angle_sigmas(view: MeasuringView, planes: Sequence[MeasuredPlane]) -> FloatArray:
    """Standard deviations (n, n) in degrees of the angles between measured planes, the calibration's share included."""
    return plane_angle_sigmas_deg(planes, view.points, view.shifts, view.covariance)


def with_readings_between(recording: SweepRecording) -> SweepRecording:
    """The recording with a reading a beam, for a turntable that turned on during the sweeps.

    Raises
    ------
    InputError
        If there are no times.
    """
    require_times(recording)
    return replace(recording, turntable_angle_deg=readings_between(recording))


def _noise(beams: Beams, stated_m: float | None) -> float:
    """Range noise: measured in the beams, as stated where they are too few for that, or NaN."""
    sigma = range_noise(beams.range_m)
    if np.isfinite(sigma):
        return max(sigma, _LEAST_NOISE_M)
    return np.nan if stated_m is None else stated_m
