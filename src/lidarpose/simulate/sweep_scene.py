"""Sweep recordings of a scene, with beams that have a width.

Each beam is a bundle of rays over its spot; the light that comes back from each surface is the share of rays that meet
it, times its reflectivity. What the instrument makes of a spot on two surfaces (a mixed pixel) is chosen by `Mixing`.
Nothing here knows of the estimators: rays are cast one by one.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, perpendicular_pair
from lidarpose.geometry.se3 import rotation_z
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.surfaces import Surface

Mixing = Literal["mean", "strongest", "first", "random", "dropped"]
"""A spot on two surfaces gives: the mean range weighted by light; the surface with most light; the nearest surface with
any light; any range between the two; nothing."""


@dataclass(frozen=True)
class BeamModel:
    """How beams see.

    Attributes
    ----------
    spot_m
        Diameter of the spot: of the disk of even light, or four standard deviations of the Gaussian one.
    divergence_rad
        Growth of the diameter per metre of range.
    shape
        How light is spread over the spot.
    range_sigma_m
        Noise of a range.
    dropout
        Share of beams that return nothing for no reason.
    farthest_m
        Beyond this nothing returns.
    threshold
        Share of the full light of a white wall below which nothing returns.
    intensity_sigma
        Noise of the intensity, relative to that of a white wall.
    rays
        Rays a spot.
    """

    spot_m: float = 0.001
    divergence_rad: float = 0.0
    shape: Literal["even", "gaussian"] = "even"
    mixing: Mixing = "mean"
    range_sigma_m: float = 0.001
    dropout: float = 0.0
    farthest_m: float = 30.0
    threshold: float = 0.0
    intensity_sigma: float = 0.01
    rays: int = 121


@dataclass(frozen=True, eq=False)
class SweepPlan:
    """Which beams are sent: readings (N,) or (N, M) and beam angles (M,), degrees, and the motion behind them."""

    motion: TurntableMotion
    turntable_angle_deg: FloatArray
    beam_angle_deg: FloatArray
    beam: BeamModel = field(default_factory=BeamModel)


def simulate_sweeps(
    plan: SweepPlan, surfaces: Sequence[Surface], *, seed: int, with_intensity: bool = True
) -> SweepRecording:
    """A recording of the surfaces (given in the camera frame)."""
    rng = np.random.default_rng(seed)
    origins, directions = _beams(plan)
    shape = directions.shape[:-1]
    centre_range, centre_surface = _cast(origins.reshape(-1, 3), directions.reshape(-1, 3), surfaces)
    light = np.where(centre_surface >= 0, _reflectivities(surfaces)[centre_surface], 0.0)
    ranges = centre_range.copy()
    edge = np.flatnonzero(_near_an_edge(centre_surface.reshape(shape), centre_range.reshape(shape)))
    for some in np.array_split(edge, max(1, len(edge) * plan.beam.rays // 2_000_000)):
        bundle = origins.reshape(-1, 3)[some], directions.reshape(-1, 3)[some], centre_range[some]
        ranges[some], light[some] = _spots(*bundle, surfaces, plan.beam, rng)
    ranges = ranges + rng.normal(0.0, plan.beam.range_sigma_m, ranges.shape)
    lost = (rng.uniform(size=ranges.shape) < plan.beam.dropout) | (ranges > plan.beam.farthest_m)
    lost |= ~np.isfinite(ranges) | (light <= plan.beam.threshold)
    light = light + rng.normal(0.0, plan.beam.intensity_sigma, light.shape)
    return SweepRecording(
        "simulated",
        plan.turntable_angle_deg,
        plan.beam_angle_deg,
        np.where(lost, np.nan, ranges).reshape(shape).astype(np.float32),
        np.where(lost, 0.0, light).reshape(shape).astype(np.float32) if with_intensity else None,
        lidar=LidarSpec("simulated", plan.beam.range_sigma_m or None),
    )


def _beams(plan: SweepPlan) -> tuple[FloatArray, FloatArray]:
    """Origins and unit directions (N, M, 3) in the camera frame: T_camera_turntable Rz(reading) T_turntable_lidar."""
    N, M = len(plan.turntable_angle_deg), len(plan.beam_angle_deg)
    reading = np.asarray(plan.turntable_angle_deg, dtype=np.float64)
    if reading.ndim == 1:
        reading = np.repeat(reading[:, None], M, axis=1)
    theta = np.deg2rad(plan.beam_angle_deg)
    d_turntable = plan.motion.T_turntable_lidar.rotate(np.stack([np.cos(theta), np.sin(theta), 0.0 * theta], -1))
    turn = rotation_z(np.deg2rad(reading))
    directions = np.einsum("ij,nmjk,mk->nmi", plan.motion.T_camera_turntable.rotation, turn, d_turntable, optimize=True)
    centres = turn @ plan.motion.T_turntable_lidar.translation
    origins = plan.motion.T_camera_turntable @ centres
    assert origins.shape == (N, M, 3)
    return np.asarray(origins), np.asarray(directions)


def _reflectivities(surfaces: Sequence[Surface]) -> FloatArray:
    return np.array([s.reflectivity for s in surfaces])


def _cast(origins: FloatArray, directions: FloatArray, surfaces: Sequence[Surface]) -> tuple[FloatArray, FloatArray]:
    """Range (n,) to the nearest surface, inf if none, and which surface it is, -1 if none."""
    nearest = np.full(len(directions), np.inf)
    which = np.full(len(directions), -1)
    for index, surface in enumerate(surfaces):
        r = surface.ranges(origins, directions)
        closer = r < nearest
        nearest[closer], which[closer] = r[closer], index
    return nearest, which


def _near_an_edge(surface: FloatArray, ranges: FloatArray) -> BoolArray:
    """(N, M) beams within three beams and three sweeps of a change of surface, or of a fold in one."""
    change = np.zeros(surface.shape, dtype=bool)
    with np.errstate(invalid="ignore"):
        for axis in (0, 1):
            differs = np.diff(surface, axis=axis) != 0
            jump = np.abs(np.diff(ranges, axis=axis))
            differs |= jump > 0.005
            first, last = (slice(None, -1), slice(None)), (slice(1, None), slice(None))
            if axis == 1:
                first, last = first[::-1], last[::-1]
            change[first] |= differs
            change[last] |= differs
    for axis in (0, 1):
        wide = change.copy()
        for shift in range(1, 4):
            ahead = np.roll(change, shift, axis=axis) | np.roll(change, -shift, axis=axis)
            wide |= ahead
        change = wide
    return change


def _spots(
    origins: FloatArray,
    directions: FloatArray,
    centre_range: FloatArray,
    surfaces: Sequence[Surface],
    beam: BeamModel,
    rng: np.random.Generator,
) -> tuple[FloatArray, FloatArray]:
    """Ranges (n,) and light (n,) of beams, cast as bundles of parallel rays."""
    n, k = len(origins), beam.rays
    offsets = _spot_offsets(beam, k, rng, n)
    finite = np.where(np.isfinite(centre_range), centre_range, 1.0)
    width = beam.spot_m + beam.divergence_rad * finite
    starts = np.empty((n, k, 3))
    for row in range(n):
        u, v = perpendicular_pair(directions[row])
        starts[row] = origins[row] + width[row] * (offsets[row, :, :1] * u + offsets[row, :, 1:] * v)
    rays = np.repeat(directions[:, None], k, axis=1)
    r, which = _cast(starts.reshape(-1, 3), rays.reshape(-1, 3), surfaces)
    r, which = r.reshape(n, k), which.reshape(n, k)
    weight = np.where(which >= 0, _reflectivities(surfaces)[which], 0.0) / k
    return _read_out(r, weight, beam.mixing, rng), weight.sum(axis=1)


def _spot_offsets(beam: BeamModel, k: int, rng: np.random.Generator, n: int) -> FloatArray:
    """Where the rays of n spots of diameter 1 lie, (n, k, 2): a sunflower, turned at random from spot to spot."""
    index = np.arange(k) + 0.5
    radius = 0.5 * np.sqrt(index / k) if beam.shape == "even" else 0.25 * np.sqrt(-2.0 * np.log(1.0 - index / k))
    angle = index * np.pi * (3.0 - np.sqrt(5.0)) + rng.uniform(0.0, 2.0 * np.pi, (n, 1))
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], -1)


def _read_out(r: FloatArray, weight: FloatArray, mixing: Mixing, rng: np.random.Generator) -> FloatArray:
    """One range (n,) for each bundle of rays (n, k), inf if nothing comes back."""
    seen = weight > 0.0
    total = np.where(seen.any(axis=1), weight.sum(axis=1), 1.0)
    safe = np.where(seen, r, 0.0)
    mean = np.where(seen.any(axis=1), (weight * safe).sum(axis=1) / total, np.inf)
    near = np.where(seen, r, np.inf).min(axis=1)
    far = np.where(seen, r, -np.inf).max(axis=1)
    # Surfaces apart by more than this are told apart; the slope of one surface within a spot is less.
    mixed = np.isfinite(near) & (far - near > 0.02)
    if mixing == "mean":
        return mean
    on_near = seen & (r < (near + 0.01)[:, None])
    light_near = np.where(on_near, weight, 0.0).sum(axis=1)
    mean_near = np.where(on_near, weight * safe, 0.0).sum(axis=1) / np.where(light_near > 0.0, light_near, 1.0)
    if mixing == "first":
        return np.where(mixed, mean_near, mean)
    if mixing == "strongest":
        rest = total - light_near
        mean_rest = np.where(seen & ~on_near, weight * safe, 0.0).sum(axis=1) / np.where(rest > 0.0, rest, 1.0)
        return np.where(mixed, np.where(light_near >= rest, mean_near, mean_rest), mean)
    if mixing == "random":
        return np.where(mixed, near + rng.uniform(size=len(r)) * (np.where(mixed, far, 0.0) - near), mean)
    return np.where(mixed, np.inf, mean)
