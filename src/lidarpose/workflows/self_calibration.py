"""A sweep recording calibrates its own rig: flat surfaces are looked for, the mounting is refined on them, and again.

Surfaces that a wrong mounting bends are found in pieces at first; as the mounting gets better the pieces grow together
and tell more.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from lidarpose.detect.cloud_planes import PlaneSearch, segment_planes
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.se3 import Pose, log_so3
from lidarpose.measure.cloud_beams import recording_of_ideal_cloud
from lidarpose.model.calibration import Quality
from lidarpose.model.cloud import Cloud
from lidarpose.model.plane_patch import PlanePatch
from lidarpose.model.recording import SweepRecording
from lidarpose.model.spun_scan import FlatReturns, MountingEstimate, MountingRun, SurfacePoints
from lidarpose.model.turntable import TurntableMotion
from lidarpose.refine.flatness import EXTRA_NAMES, points_in_table
from lidarpose.refine.mounting import mounting_calibration, refine_mounting, require_told
from lidarpose.refine.mounting_verdict import LARGEST_BEND_FACTOR, MountingOptions

# Enough for a tenth of a millimetre on a wall; a search for planes in more takes its time.
MOST_RETURNS = 120_000
MOST_ROUNDS = 10
MOST_SURFACES = 30
# Pieces of less than this share of all returns tell little and may be clutter.
LEAST_SHARE = 0.004
LEAST_RETURNS = 150
# Pieces that spread this much wider than the typical return's surface are no surfaces.
WIDEST_SPREAD = 2.5
# Settled is what moves by less than this share of its standard deviation.
SETTLED = 0.5
# Surfaces that bend by less than this share of what they did are flatter, and not by chance.
FLATTER = 0.5


def axis_in_fan(axis_beam_rad: float) -> Pose:
    """T_table_lidar of a LiDAR on the axis, whose fan holds the axis: the beam of this angle points along it."""
    c, s = np.cos(axis_beam_rad), np.sin(axis_beam_rad)
    z = np.array([c, s, 0.0])
    # The beam a right angle behind the axis' one points along the table's x.
    x = np.array([s, -c, 0.0])
    return Pose(np.stack([x, np.cross(z, x), z]), np.zeros(3))


def recording_of_cloud(cloud: Cloud, axis_beam_rad: float, name: str, *, half_turn: bool = False) -> SweepRecording:
    """The recording behind a cloud that was put together as if the LiDAR sat as in `axis_in_fan`.

    With `half_turn` it turned by half a turn and saw to both sides; without, it saw to one side only.

    Raises
    ------
    UndeterminedError
        If the points are not those of a fan of beams that turns about z.
    """
    whole = cloud.finite()
    points = whole.points.astype(np.float64)
    light = whole.fields.get("intensity")
    away = np.linalg.norm(points, axis=1) > 0.0
    motion = TurntableMotion(Pose.identity(), axis_in_fan(axis_beam_rad))
    light = None if light is None else np.asarray(light, dtype=np.float64)[away]
    found = recording_of_ideal_cloud(points[away], motion, light, half_turn=half_turn) if away.any() else None
    if found is None:
        raise UndeterminedError(
            "The cloud's points are not those of one fan of beams that turns about z",
            remedy="Give the cloud as the scanner's own software made it, neither moved nor thinned, or the recording.",
        )
    return replace(found, name=name)


def calibrate_by_flatness(
    recording: SweepRecording,
    T_table_lidar: Pose,
    options: MountingOptions | None = None,
    *,
    provenance: Mapping[str, Any] | None = None,
    step: Callable[[], None] | None = None,
) -> MountingRun:
    """Where a LiDAR sits on its turntable, from a recording of a room.

    Parameters
    ----------
    recording
        Sweeps of flat surfaces on several sides; the more of the turn the better.
    T_table_lidar
        Roughly how the LiDAR is mounted (`axis_in_fan`, or from drawings): some degrees and centimetres.
    step
        Called after each round.

    Raises
    ------
    UndeterminedError
        If too few surfaces are found, or they do not tell the mounting.
    """
    options = options or MountingOptions()
    if recording.has_reading_per_beam:
        options = replace(options, sweeps_stated=True, reading_a_beam=True)
    returns = _all_returns(recording)
    origin_rad = 0.5 * float(returns.reading_rad.min() + returns.reading_rad.max())
    estimate, flat, rounds = _settled(returns, T_table_lidar, options, origin_rad, step)
    require_told(estimate, options)
    if returns.left_out_rad is not None and estimate.quality.figures["bend_factor"] > LARGEST_BEND_FACTOR:
        # Surfaces that bend: perhaps they are flat to a table that moved during the sweeps the other way.
        moved = replace(returns, reading_rad=returns.reading_rad + returns.left_out_rad, left_out_rad=None)
        try:
            other, *_ = _settled(moved, T_table_lidar, replace(options, sweeps_stated=True), origin_rad)
            estimate = _against_other_rig(estimate, other, options)
        except UndeterminedError:
            pass
    calibration = replace(mounting_calibration(estimate), provenance=dict(provenance or {}))
    return MountingRun(calibration, estimate, len(returns), rounds, _as_seen(flat, estimate))


def _settled(
    returns: FlatReturns,
    T_table_lidar: Pose,
    options: MountingOptions,
    origin_rad: float,
    step: Callable[[], None] | None = None,
) -> tuple[MountingEstimate, FlatReturns, int]:
    """Surfaces and mounting in turn until they agree; the returns on the surfaces, and after how many rounds."""
    pose, extras = T_table_lidar, np.zeros(len(EXTRA_NAMES))
    before: FloatArray | None = None
    rounds = 0
    while True:
        rounds += 1
        flat = _flat_returns(returns, pose, extras, origin_rad)
        estimate = refine_mounting(flat, pose, options, extras=extras, origin_rad=origin_rad)
        pose = estimate.T_table_lidar
        extras = np.array([estimate.extra_values.get(name, 0.0) for name in EXTRA_NAMES])
        if step is not None:
            step()
        now = _as_numbers(estimate)
        if before is not None and _moved(now - before, estimate) < SETTLED:
            return estimate, flat, rounds
        if rounds == MOST_ROUNDS:
            return _unsettled(estimate), flat, rounds
        before = now


def _against_other_rig(
    estimate: MountingEstimate, other: MountingEstimate, options: MountingOptions
) -> MountingEstimate:
    """Doubtful, and as uncertain as both rigs are apart, where the surfaces are flatter to the other one."""
    if other.bend_m > FLATTER * estimate.bend_m or other.bending_m > FLATTER * estimate.bending_m:
        return estimate
    apart = np.zeros(len(estimate.covariance))
    turned = log_so3(other.T_table_lidar.rotation @ estimate.T_table_lidar.rotation.T)
    # A turn about the axis is the choice of the frame, and small here.
    apart[:2], apart[2:4] = turned[:2], (other.T_table_lidar.translation - estimate.T_table_lidar.translation)[:2]
    for k, name in enumerate(estimate.parameter_names[4:], start=4):
        apart[k] = other.extra_values[name] - estimate.extra_values[name]
    quality = estimate.quality
    moved, remedy = (
        ("stood still during each sweep", "leave out --never-stops")
        if options.reading_a_beam
        else ("turned on during the sweeps", "give --never-stops")
    )
    reason = (
        f"the surfaces are flat as if the table {moved} (bulges of {1e3 * other.bend_m:.2g} mm in place of "
        f"{1e3 * estimate.bend_m:.2g}): {remedy}"
    )
    covariance = estimate.covariance + np.outer(apart, apart)
    sigma = np.sqrt(np.diag(covariance))
    figures = {
        **quality.figures,
        "sigma_tilt_deg": float(np.degrees(sigma[:2].max())),
        "sigma_shift_mm": float(1e3 * sigma[2:4].max()),
    }
    return replace(estimate, covariance=covariance, quality=Quality("doubtful", (reason, *quality.reasons), figures))


def _as_seen(flat: FlatReturns, estimate: MountingEstimate) -> SurfacePoints:
    extras = np.array([estimate.extra_values.get(name, 0.0) for name in EXTRA_NAMES])
    points = points_in_table(
        estimate.T_table_lidar, extras, estimate.reading_origin_rad, flat.reading_rad, flat.beam_rad, flat.range_m
    )
    planes = [surface.plane for surface in estimate.surfaces]
    normals, offsets = np.stack([p.normal for p in planes]), np.array([p.offset for p in planes])
    off_m = (points * normals[flat.surface]).sum(axis=1) - offsets[flat.surface]
    return SurfacePoints(points, flat.surface, off_m)


def _all_returns(recording: SweepRecording) -> FlatReturns:
    """Every return, or those of evenly chosen sweeps where there are many; all on surface 0."""
    returned = recording.has_return()
    total = int(np.count_nonzero(returned))
    if total < LEAST_RETURNS:
        raise UndeterminedError(f"The recording holds {total} returns", remedy="Record a room.")
    every = max(1, round(total / MOST_RETURNS))
    chosen = np.zeros(recording.sweeps, dtype=bool)
    chosen[::every] = True
    sweep, beam = np.nonzero(returned & chosen[:, None])
    reading = recording.turntable_angle_rad
    if recording.has_reading_per_beam:
        of_return = reading[sweep, beam]
    else:
        of_return = reading[sweep]
    ranges = np.asarray(recording.range_m)[sweep, beam].astype(np.float64)
    left_out = _left_out(recording)
    return FlatReturns(
        of_return,
        recording.beam_angle_rad[beam],
        ranges,
        sweep,
        np.zeros(len(sweep), dtype=np.int64),
        None if left_out is None else left_out[sweep, beam],
    )


def _left_out(recording: SweepRecording) -> FloatArray | None:
    """By how much further (N, M) each beam would find the table if that moved during sweeps as the readings do not say.

    It turns on evenly to the next reading, the mirror once a sweep (as in
    `lidarpose.measure.assemble.readings_between`), or stands still at the first beam's reading where each beam has its
    own. None where both are the same.
    """
    reading = recording.turntable_angle_rad
    if recording.has_reading_per_beam:
        left_out = reading[:, :1] - reading
    elif len(reading) < 2:
        return None
    else:
        beam = recording.beam_angle_rad
        steps = np.append(np.diff(reading), reading[-1] - reading[-2])
        left_out = steps[:, None] * np.abs(beam - beam[0]) / (2.0 * np.pi)
    return left_out if np.abs(left_out).max() > 0.0 else None


def _flat_returns(returns: FlatReturns, pose: Pose, extras: FloatArray, origin_rad: float) -> FlatReturns:
    points = points_in_table(pose, extras, origin_rad, returns.reading_rad, returns.beam_rad, returns.range_m)
    least = max(LEAST_RETURNS, int(LEAST_SHARE * len(points)))
    found = segment_planes(points, PlaneSearch(max_planes=60, min_points=least, from_sensor=True))
    patches = _surfaces_among(found)
    index: IntArray = np.concatenate([p.indices for p in patches]) if patches else np.zeros(0, dtype=np.int64)
    surface = np.repeat(np.arange(len(patches)), [len(p) for p in patches])
    left_out = None if returns.left_out_rad is None else returns.left_out_rad[index]
    return FlatReturns(
        returns.reading_rad[index],
        returns.beam_rad[index],
        returns.range_m[index],
        returns.sweep[index],
        surface,
        left_out,
    )


def _surfaces_among(patches: tuple[PlanePatch, ...]) -> list[PlanePatch]:
    """The largest patches, those left out that spread much wider than the typical return's patch does."""
    if not patches:
        return []
    sigma = np.array([p.sigma_m for p in patches])
    typical = float(np.median(np.repeat(sigma, [len(p) for p in patches])))
    kept = [p for p in patches if p.sigma_m <= WIDEST_SPREAD * typical]
    return sorted(kept, key=len, reverse=True)[:MOST_SURFACES]


def _as_numbers(estimate: MountingEstimate) -> FloatArray:
    values = [estimate.extra_values[name] for name in estimate.parameter_names[4:]]
    return np.concatenate([estimate.T_table_lidar.rotation.ravel(), estimate.T_table_lidar.translation[:2], values])


def _moved(change: FloatArray, estimate: MountingEstimate) -> float:
    """The largest change of tilt, shift and extra parameters over its standard deviation by noise."""
    sigma = np.sqrt(np.diag(estimate.noise_covariance))
    tilt = np.linalg.norm(change[:9]) / np.sqrt(2.0) / max(float(sigma[:2].max()), 1e-12)
    rest = np.abs(change[9:]) / np.maximum(np.concatenate([[sigma[2:4].max()] * 2, sigma[4:]]), 1e-12)
    return float(max(tilt, rest.max()))


def _unsettled(estimate: MountingEstimate) -> MountingEstimate:
    quality = estimate.quality
    reason = "surfaces and mounting did not settle on each other: what is found flat changes with the mounting"
    return replace(
        estimate,
        converged=False,
        quality=replace(quality, verdict="doubtful", reasons=(*quality.reasons, reason)),
    )
