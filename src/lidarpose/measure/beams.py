"""Beams in one frame: where they start, where they point, how far they reach. What all measuring works from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.planes import Plane
from lidarpose.geometry.se3 import Pose, exp_so3, rotation_z
from lidarpose.measure.assemble import beam_origins_and_directions
from lidarpose.measure.point_sigma import shifting_parameters
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion

# Of every parameter of a calibration: small against their standard deviations, large against rounding.
_STEP = 1e-5


@dataclass(frozen=True, eq=False)
class Beams:
    """Beams on a grid of sweeps and beam angles, in the camera frame.

    Attributes
    ----------
    origin, direction : (N, M, 3)
        Starts, metres, and unit directions.
    range_m : (N, M)
        NaN where there is no return.
    light : (N, M) or None
        Intensity, in any unit that is proportional to the light.
    """

    origin: FloatArray
    direction: FloatArray
    range_m: FloatArray
    light: FloatArray | None = None

    @property
    def points(self) -> FloatArray:
        """(N, M, 3), NaN where there is no return."""
        return np.asarray(self.origin + self.range_m[..., None] * self.direction)

    def at(self, index: IntArray | BoolArray) -> Beams:
        """Some beams as a flat list (n, 3), by flat index or mask."""
        flat = index.ravel()
        return Beams(
            np.asarray(self.origin).reshape(-1, 3)[flat],
            self.direction.reshape(-1, 3)[flat],
            self.range_m.reshape(-1)[flat],
            None if self.light is None else self.light.reshape(-1)[flat],
        )


def beams_of(recording: SweepRecording, motion: TurntableMotion) -> Beams:
    """All beams of a recording in the camera frame, in double precision."""
    origin, direction = beam_origins_and_directions(motion, recording)
    if origin.ndim == 2:
        origin = np.broadcast_to(origin[:, None], direction.shape)
    r = np.asarray(recording.range_m, dtype=np.float64)
    light = None if recording.intensity is None else np.asarray(recording.intensity, dtype=np.float64)
    return Beams(origin, direction, np.where(recording.has_return(), r, np.nan), light)


def chosen_beams(
    recording: SweepRecording, calibration: TurntableCalibration, index: IntArray, change: FloatArray | None = None
) -> Beams:
    """Beams (n,) of flat indices in the camera frame, after a small change (p,) of the calibration's parameters.

    Parameters
    ----------
    recording, calibration
        Angles and ranges put right by the calibration, and the calibration as it is in the file.
    change
        In the order of `lidarpose.measure.point_sigma.shifting_parameters`; None for none.
    """
    names = shifting_parameters(calibration)
    change = np.zeros(len(names)) if change is None else change
    further = dict(zip(names[10:], change[10:].tolist(), strict=True))
    motion, own = calibration.motion, calibration.beams
    i, j = np.divmod(index, recording.beams)
    readings = recording.turntable_angle_deg
    angle = np.deg2rad(np.asarray(readings[i, j] if recording.has_reading_per_beam else readings[i], dtype=np.float64))
    angle = angle + further.get("encoder_scale", 0.0) * (angle - motion.reading_origin_rad) / motion.reading_scale
    theta = recording.beam_angle_rad[j] * (1.0 + further.get("beam_angle_scale", 0.0) / own.angle_scale)
    R_tl = exp_so3(change[7:10]) @ motion.T_turntable_lidar.rotation
    T_ct = Pose.exp(change[:6]) @ motion.T_camera_turntable
    turn = rotation_z(angle)
    d = np.stack([np.cos(theta), np.sin(theta), np.zeros_like(theta)], -1) @ R_tl.T
    direction = T_ct.rotate((turn @ d[..., None])[..., 0])
    origin = T_ct @ (turn[..., 0] * (motion.radius_m + change[6]))
    r = np.asarray(recording.range_m.reshape(-1)[index], dtype=np.float64)
    stated = own.range_scale * np.where((r > 0.0) & (r < np.inf), r, np.nan)
    r = (stated - further.get("range_offset_m", 0.0)) / (own.range_scale + further.get("range_scale", 0.0))
    return Beams(origin, direction, r)


MovedBeams = Callable[[FloatArray, IntArray], Beams]
"""The beams of flat indices under a small change (p,) of the calibration's parameters."""


def calibration_sigmas(sizes: Callable[[FloatArray], FloatArray], covariance: FloatArray) -> FloatArray:
    """Standard deviations (m,) of sizes by a calibration's covariance (p, p), by central differences.

    `sizes` gives them (m,) under a small change (p,) of the calibration's parameters.
    """
    steps = _STEP * np.eye(len(covariance))
    gradient = np.stack([(sizes(step) - sizes(-step)) / (2.0 * _STEP) for step in steps])
    return np.asarray(np.sqrt(np.maximum(np.einsum("ke,kl,le->e", gradient, covariance, gradient), 0.0)))


def range_noise(range_m: FloatArray) -> float:
    """Noise of single ranges (N, M) from second differences along the sweeps, metres; NaN if there are too few.

    Along a plane the range bends so little from beam to beam that noise alone is left; edges are outliers to the
    median. Differences of neighbours without a return are left out.
    """
    bend = range_m[:, :-2] - 2.0 * range_m[:, 1:-1] + range_m[:, 2:]
    bend = bend[np.isfinite(bend)]
    if bend.size < 30:
        return float("nan")
    # A second difference holds 1 + 4 + 1 variances.
    return float(1.4826 * np.median(np.abs(bend)) / np.sqrt(6.0))


def plane_ranges(plane: Plane, beams: Beams) -> FloatArray:
    """Ranges at which beams meet a plane; NaN where they run along it or away from it."""
    with np.errstate(divide="ignore", invalid="ignore"):
        r = (plane.offset - beams.origin @ plane.normal) / (beams.direction @ plane.normal)
    return np.where(np.isfinite(r) & (r > 0.0), r, np.nan)


def fit_plane_to_ranges(plane: Plane, beams: Beams, sigma: float) -> tuple[Plane, FloatArray, float, BoolArray]:
    """The plane that fits ranges best: noise lies along the beam, which a fit of distances would turn into a bias.

    Parameters
    ----------
    plane
        A first estimate.
    beams
        Beams on it, as a list.
    sigma
        Noise of a range; residuals beyond four of them are left out.

    Returns
    -------
    plane, covariance (3, 3) of (two tilts about the estimate's own axes at its point nearest to the beams' mean,
    offset), rms of the residuals in metres, and which beams were used (n,).
    """
    for _ in range(4):
        J, residual, frame = _plane_design(plane, beams)
        use = np.isfinite(residual) & (np.abs(residual) < 4.0 * max(sigma, 1e-9))
        if np.count_nonzero(use) < 6:
            raise ValueError("too few beams on the plane")
        step = np.linalg.lstsq(J[use], residual[use], rcond=None)[0]
        plane = moved_plane(plane, frame, step)
    J, residual, _ = _plane_design(plane, beams)
    use = np.isfinite(residual) & (np.abs(residual) < 4.0 * max(sigma, 1e-9))
    rms = float(np.sqrt(np.mean(residual[use] ** 2)))
    covariance = np.linalg.inv(J[use].T @ J[use]) * max(rms, 1e-9) ** 2
    return plane, np.asarray(covariance), rms, use


def plane_frame(plane: Plane, points: FloatArray) -> FloatArray:
    """Rows: an origin on the plane below the mean of points (n, 3), and two unit axes in it, (3, 3)."""
    from lidarpose.geometry.arrays import perpendicular_pair

    u, v = perpendicular_pair(plane.normal)
    return np.stack([plane.project(points.mean(axis=0)), u, v])


def moved_plane(plane: Plane, frame: FloatArray, step: FloatArray) -> Plane:
    """The plane tilted by step[0], step[1] (slopes along the frame's axes) and shifted by step[2] along its normal."""
    origin, u, v = frame
    normal = plane.normal - step[0] * u - step[1] * v
    normal = normal / np.linalg.norm(normal)
    return Plane(normal, float(normal @ (origin + step[2] * plane.normal)))


def _plane_design(plane: Plane, beams: Beams) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Derivative (n, 3) of the predicted ranges by `moved_plane`'s step, measured minus predicted, and the frame."""
    predicted = plane_ranges(plane, beams)
    hit = beams.origin + predicted[:, None] * beams.direction
    frame = plane_frame(plane, hit[np.isfinite(predicted)])
    cosine = beams.direction @ plane.normal
    local = (hit - frame[0]) @ frame[1:].T
    J = np.column_stack([local, np.ones(len(local))]) / cosine[:, None]
    return J, beams.range_m - predicted, frame
