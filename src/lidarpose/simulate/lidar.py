"""A 2D LiDAR in a scene: ranges with noise, beams without return, mixed pixels where a beam's spot meets an edge."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.scan import Scan
from lidarpose.simulate.turntable_scene import Hits, Scene

# Sub-beams across a spot, in units of its sigma, and their shares of a Gaussian beam's energy.
_SPOT = np.linspace(-2.0, 2.0, 9)
_SPOT_SHARE = np.exp(-0.5 * _SPOT**2) / np.exp(-0.5 * _SPOT**2).sum()


@dataclass(frozen=True)
class LidarBehaviour:
    """What a LiDAR does beyond measuring a distance.

    Attributes
    ----------
    spot_sigma_m, divergence_rad
        Half-width (sigma) of the beam where it leaves, and how fast it widens. Zero: no mixed pixels.
    dropout_share
        Share of beams that are lost for no reason.
    least_echo
        Echoes weaker than this (albedo times cosine of incidence over squared metres) are lost.
    largest_range_m
        Beyond it nothing is measured.
    black_sigma_factor, black_bias_m, offset_m
        More noise on the darkest surfaces, a bias there, and an offset of all ranges.
    sweeps
        Sweeps in one scan.
    """

    spot_sigma_m: float = 0.001
    divergence_rad: float = 0.0003
    dropout_share: float = 0.003
    least_echo: float = 0.002
    largest_range_m: float = 5.5
    black_sigma_factor: float = 1.0
    black_bias_m: float = 0.0
    offset_m: float = 0.0
    sweeps: int = 1

    @staticmethod
    def ideal(sweeps: int = 1) -> LidarBehaviour:
        """No spot and nothing lost: every range is that of a mathematical ray."""
        return LidarBehaviour(0.0, 0.0, 0.0, 0.0, np.inf, sweeps=sweeps)


def scan_scene(
    scene: Scene,
    T_camera_lidar: Pose,
    beam_angle_rad: FloatArray,
    range_sigma_m: float,
    behaviour: LidarBehaviour,
    rng: np.random.Generator,
) -> Scan:
    """One scan from one pose of the LiDAR: NaN where there is no return; intensity 0 there."""
    echo, ranges, mixed, darkness = _echoes(scene, T_camera_lidar, beam_angle_rad, behaviour)
    sweeps = behaviour.sweeps
    sigma = range_sigma_m * (1.0 + (behaviour.black_sigma_factor - 1.0) * darkness) * np.where(mixed, 3.0, 1.0)
    truth = ranges + behaviour.offset_m + behaviour.black_bias_m * darkness
    shape = (sweeps, len(beam_angle_rad))
    measured = truth + sigma * rng.standard_normal(shape)
    lost = (echo < behaviour.least_echo) | ~np.isfinite(ranges) | (ranges > behaviour.largest_range_m)
    lost = lost | (rng.random(shape) < behaviour.dropout_share)
    intensity = np.round(1000.0 * echo * (1.0 + 0.02 * rng.standard_normal(shape)) * np.minimum(ranges, 1e3) ** 2, 1)
    sweep: IntArray | None = np.repeat(np.arange(sweeps), len(beam_angle_rad)) if sweeps > 1 else None
    return Scan(
        np.tile(beam_angle_rad, sweeps),
        np.where(lost, np.nan, measured).ravel(),
        np.where(lost, 0.0, np.maximum(intensity, 0.0)).ravel(),
        sweep,
    )


def lit_range(scene: Scene, T_camera_lidar: Pose, angle_rad: FloatArray) -> FloatArray:
    """How far (N,) light gets at angles (N,) before it meets something; inf into the open."""
    return scene.cast(T_camera_lidar.translation, _directions(T_camera_lidar, angle_rad)).distance


def _directions(T_camera_lidar: Pose, angle_rad: FloatArray) -> FloatArray:
    x, y = T_camera_lidar.rotation[:, 0], T_camera_lidar.rotation[:, 1]
    return np.asarray(np.cos(angle_rad)[:, None] * x + np.sin(angle_rad)[:, None] * y)


def _echoes(
    scene: Scene, T_camera_lidar: Pose, angle_rad: FloatArray, behaviour: LidarBehaviour
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """For each beam: echo strength, range, whether its spot lies on surfaces apart, and darkness (1 on black).

    A spot on one surface is measured at its middle. A spot on several gives the mean of their ranges, each with the
    share of the light that comes back from it, as a phase-measuring LiDAR does.
    """
    origin = T_camera_lidar.translation
    directions = _directions(T_camera_lidar, angle_rad)
    middle = scene.cast(origin, directions)
    echo, albedo = _strength(scene, middle, directions)
    ranges, mixed = middle.distance.copy(), np.zeros(len(angle_rad), dtype=bool)
    near = np.minimum(middle.distance, 3.0)
    half_width = behaviour.spot_sigma_m / near + behaviour.divergence_rad
    if behaviour.spot_sigma_m > 0.0 or behaviour.divergence_rad > 0.0:
        spread = [_directions(T_camera_lidar, angle_rad + k * half_width) for k in _SPOT]
        hits = [scene.cast(origin, d) for d in spread]
        surface = np.stack([h.surface for h in hits])
        mixed = np.any(surface != surface[0], axis=0)
        share = np.stack(
            [
                w * np.where(h.surface >= 0, _strength(scene, h, d)[0], 0.0)
                for w, h, d in zip(_SPOT_SHARE, hits, spread, strict=True)
            ]
        )
        distance = np.stack([np.where(np.isfinite(h.distance), h.distance, 0.0) for h in hits])
        echo = np.where(mixed, share.sum(axis=0), echo)
        mean = (share * distance).sum(axis=0) / np.maximum(share.sum(axis=0), 1e-12)
        ranges = np.where(mixed, mean, ranges)
        # Across a fold the spot is merely bent; it takes a step in depth to make a measurement worse.
        mixed &= np.ptp(distance, axis=0) > 0.01
    darkness = np.clip((0.85 - albedo) / (0.85 - 0.07), 0.0, 1.0)
    return echo, ranges, mixed, darkness


def _strength(scene: Scene, hits: Hits, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Echo (N,): albedo times cosine of incidence over the squared distance, none from glass; and the albedo (N,)."""
    normals = np.array([s.normal for s in scene.surfaces])[hits.surface]
    matt = ~np.array([s.glass for s in scene.surfaces])[hits.surface] & (hits.surface >= 0)
    albedo = scene.albedo(hits)
    cosine = np.abs((normals * directions).sum(axis=1))
    return np.where(matt, albedo * cosine / hits.distance**2, 0.0), albedo
