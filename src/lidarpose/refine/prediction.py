"""How well a session would determine the motion, from geometry alone: before anything is recorded or calibrated."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.camera import Camera
from lidarpose.model.observation import PanelCorners, PlaceObservation, ScanLine, StripePoints, TurntableObservations
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.model.turntable_result import Direction
from lidarpose.refine.observability import PoseSpread, pose_spread, weak_directions, whole_turn
from lidarpose.refine.turntable_estimate import outside_parameters, require_determined
from lidarpose.refine.turntable_joint import at_stated_noise
from lidarpose.refine.turntable_layout import lay_out
from lidarpose.refine.turntable_state import start_state

_SAMPLES = 16


@dataclass(frozen=True)
class ExpectedNoise:
    """What the recording will be like: standard deviations, and the angle between beams (rad)."""

    corner_px: float = 0.1
    stripe_px: float = 0.15
    range_m: float = 0.001
    beam_step_rad: float = float(np.deg2rad(1.0 / 12.0))


@dataclass(frozen=True, eq=False)
class PredictedUncertainty:
    """Covariance (10, 10) of the motion, the pose's standard deviations, and what would be weak, worst first."""

    covariance: FloatArray
    inside: PoseSpread
    around: PoseSpread
    directions: tuple[Direction, ...]


def predict_uncertainty(
    camera: Camera,
    panels: Sequence[Panel],
    panel_poses: Mapping[str, Sequence[Pose]],
    motion: TurntableMotion,
    angles_rad: FloatArray,
    noise: ExpectedNoise | None = None,
    *,
    with_stripe: bool = True,
    placements: Sequence[str] | None = None,
) -> PredictedUncertainty:
    """What a joint estimate would know, from rough poses of the panels, a rough motion and the readings.

    Parameters
    ----------
    panel_poses
        T_camera_panel by placement of the board.
    with_stripe
        False for a laser that the camera does not see.
    placements
        The placement that is seen at each reading; unless given, every placement from all readings.

    Raises
    ------
    UndeterminedError
        If the motion would be left open; the message says which and what to record.
    ValueError
        If `placements` and `angles_rad` differ in number.
    """
    expected = noise or ExpectedNoise()
    corners = {
        name: tuple(_corners(camera, panel, pose, expected) for panel, pose in zip(panels, poses, strict=True))
        for name, poses in panel_poses.items()
    }
    if placements is None:
        stops = [(name, float(angle)) for name in panel_poses for angle in angles_rad]
    else:
        stops = [(name, float(angle)) for name, angle in zip(placements, angles_rad, strict=True)]
    places = [
        _place(camera, panels, name, panel_poses[name], motion, angle, expected, with_stripe) for name, angle in stops
    ]
    observations = TurntableObservations(camera, tuple(panels), corners, tuple(places))
    data = lay_out(observations)
    start = start_state(data, motion, {name: tuple(poses) for name, poses in panel_poses.items()})
    solution = at_stated_noise(data, start)
    outside = outside_parameters(solution)
    require_determined(solution, outside)
    C = outside.covariance[:10, :10]
    ends = np.unique([np.min(angles_rad), data.reference_rad, np.max(angles_rad)])
    return PredictedUncertainty(
        C,
        pose_spread(outside.motion, C, ends),
        pose_spread(outside.motion, C, whole_turn(data.reference_rad)),
        weak_directions(outside.motion, C, data.angles_rad),
    )


def _corners(camera: Camera, panel: Panel, pose: Pose, noise: ExpectedNoise) -> PanelCorners:
    points = panel.corners_panel()
    return PanelCorners(points, camera.project(pose @ points), np.full(len(points), noise.corner_px))


def _place(
    camera: Camera,
    panels: Sequence[Panel],
    placement: str,
    poses: Sequence[Pose],
    motion: TurntableMotion,
    angle_rad: float,
    noise: ExpectedNoise,
    with_stripe: bool,
) -> PlaceObservation:
    stripes, lines = {}, {}
    T_camera_lidar = motion.pose(angle_rad)
    for k, (panel, pose) in enumerate(zip(panels, poses, strict=True)):
        chord = _chord(panel, pose.inverse() @ T_camera_lidar)
        if chord is None:
            continue
        points = pose @ chord
        in_lidar = T_camera_lidar.inverse() @ points
        beam = np.unwrap(np.arctan2(in_lidar[:, 1], in_lidar[:, 0]))
        beams = max(float(np.ptp(beam)) / noise.beam_step_rad, 1.0)
        order = np.argsort(beam)
        ranges = np.linalg.norm(in_lidar[order, :2], axis=1)
        lines[k] = ScanLine(beam[order], ranges, np.full(_SAMPLES, noise.range_m * np.sqrt(_SAMPLES / beams)))
        pixels = camera.project(points)
        length = float(np.linalg.norm(pixels[-1] - pixels[0]))
        if not with_stripe or not np.all(camera.contains(pixels)):
            continue
        tangent = np.gradient(pixels, axis=0)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        normals = np.column_stack([-tangent[:, 1], tangent[:, 0]])
        sigma = noise.stripe_px * np.sqrt(_SAMPLES / max(length, 1.0))
        stripes[k] = StripePoints(pixels, normals, np.full(_SAMPLES, sigma))
    return PlaceObservation(f"{placement}{np.rad2deg(angle_rad):.3f}", angle_rad, stripes, lines, placement)


def _chord(panel: Panel, T_panel_lidar: Pose) -> FloatArray | None:
    """Points (16, 3) on the scan plane's line across the panel's squares, in its frame; None where it misses."""
    normal = T_panel_lidar.rotation[:, 2]
    direction = np.array([-normal[1], normal[0], 0.0])
    size = float(np.linalg.norm(direction))
    if size < 1e-9:
        return None
    direction /= size
    foot = normal[:2] * (normal @ T_panel_lidar.translation) / size**2
    low = np.full(2, -panel.square_m)
    high = np.array([panel.columns, panel.rows]) * panel.square_m
    first, last = -np.inf, np.inf
    for axis in range(2):
        if abs(direction[axis]) < 1e-12:
            if not low[axis] <= foot[axis] <= high[axis]:
                return None
            continue
        ends = sorted((edge - foot[axis]) / direction[axis] for edge in (low[axis], high[axis]))
        first, last = max(first, ends[0]), min(last, ends[1])
    if last - first < 2.0 * panel.square_m:
        return None
    along = np.linspace(first, last, _SAMPLES)
    return np.column_stack([foot[0] + along * direction[0], foot[1] + along * direction[1], np.zeros(_SAMPLES)])
