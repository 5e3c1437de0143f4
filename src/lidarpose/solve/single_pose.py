"""The LiDAR's pose at single places, from two lines in both frames (turntable paper, section 1.5)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, UncertainPose, nearest_rotation, skew
from lidarpose.solve.light_plane import StripePair
from lidarpose.solve.line_pair import LinePairs

# Components of a small motion in the LiDAR's own frame: out of the scan plane, and within it.
ACROSS = np.array([2, 3, 4])
WITHIN = np.array([0, 1, 5])


def single_poses(stripes: Sequence[StripePair], lines: LinePairs) -> list[UncertainPose]:
    """T_camera_lidar of each place from its two stripes in the camera frame and its scan lines in the LiDAR frame.

    Eq. (13) gives an exact rotation only where both angles agree, so it is projected on the nearest one; eq. (14)
    takes E in the camera frame. The lines' order decides: exchanging them gives the mirrored solution.

    The covariance (of the left perturbation) is the light plane's across the scan plane and the scan lines' within it;
    the panels' poses count as known, since an error of theirs is common to all places.
    """
    if not stripes:
        return []
    E = np.array([s.E_camera for s in stripes])
    R, t = rotations_and_centres(E, np.array([s.directions_camera for s in stripes]), lines)
    own = np.zeros((len(R), 6, 6))
    own[:, ACROSS[:, None], ACROSS] = _across(stripes, R, t)
    own[:, WITHIN[:, None], WITHIN] = lines.covariance
    Ad = np.zeros((len(R), 6, 6))
    Ad[:, :3, :3] = Ad[:, 3:, 3:] = R
    Ad[:, :3, 3:] = skew(t) @ R
    covariance = Ad @ own @ np.swapaxes(Ad, 1, 2)
    return [UncertainPose(Pose(*pose), C) for *pose, C in zip(R, t, covariance, strict=True)]


def rotations_and_centres(
    E_camera: FloatArray, directions_camera: FloatArray, lines: LinePairs
) -> tuple[FloatArray, FloatArray]:
    """R (C, 3, 3) and t (C, 3) of T_camera_lidar from E (C, 3) and the stripes' directions (C, 2, 3)."""
    flat = np.concatenate([lines.directions_lidar, np.zeros((len(E_camera), 2, 1))], axis=2)
    R = nearest_rotation(_frames(directions_camera) @ np.linalg.inv(_frames(flat)))
    return R, E_camera - (R[:, :, :2] @ lines.E_lidar[..., None])[..., 0]


def _across(stripes: Sequence[StripePair], R: FloatArray, t: FloatArray) -> FloatArray:
    """Covariances (C, 3, 3) of (tz, rx, ry) in the LiDAR's own frame, from those of the light planes."""
    light = [s.light_plane for s in stripes]
    back = np.swapaxes(R, 1, 2)
    middle = (back @ (np.array([x.pivot for x in light]) - t)[..., None])[..., 0]
    n = (back @ np.array([x.plane.normal for x in light])[..., None])[..., 0]
    u, v = np.moveaxis(np.array([x.basis for x in light]) @ R, 1, 0)
    # The normal turns by w = cross(n, change of n); the plane's shift is given at the pivot, wanted at the LiDAR.
    turns = np.stack([np.cross(n, u), np.cross(n, v), np.zeros_like(n)], axis=2)[:, :2]
    shift = np.array([0.0, 0.0, 1.0]) * n[:, 2:]
    shift = shift - (np.stack([middle[:, 1], -middle[:, 0]], axis=1)[:, None] @ turns)[:, 0]
    J = np.concatenate([shift[:, None], turns], axis=1)
    return np.asarray(J @ np.array([x.covariance for x in light]) @ np.swapaxes(J, 1, 2))


def _frames(directions: FloatArray) -> FloatArray:
    """Columns (C, 3, 3): both directions (C, 2, 3) and their cross product."""
    across = np.cross(directions[:, 0], directions[:, 1])
    return np.stack([directions[:, 0], directions[:, 1], across], axis=2)
