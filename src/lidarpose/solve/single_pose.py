"""The LiDAR's pose at one place, from two lines in both frames (turntable paper, section 1.5)."""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import FloatArray, cross3
from lidarpose.geometry.se3 import Pose, UncertainPose, nearest_rotation
from lidarpose.solve.light_plane import LightPlane, StripePair
from lidarpose.solve.line_pair import LinePair

# Components of a small motion in the LiDAR's own frame: out of the scan plane, and within it.
ACROSS = [2, 3, 4]
WITHIN = [0, 1, 5]


def single_pose(stripes: StripePair, lines: LinePair) -> UncertainPose:
    """T_camera_lidar from the two stripes in the camera frame and the two scan lines in the LiDAR frame.

    Eq. (13) gives an exact rotation only where both angles agree, so it is projected on the nearest one; eq. (14)
    takes E in the camera frame. The lines' order decides: exchanging them gives the mirrored solution.

    The covariance (of the left perturbation) is the light plane's across the scan plane and the scan lines' within it;
    the panels' poses count as known, since an error of theirs is common to all places.
    """
    in_lidar = _frame(np.column_stack([lines.directions_lidar, np.zeros(2)]))
    in_camera = _frame(stripes.directions_camera)
    rotation = nearest_rotation(in_camera @ np.linalg.inv(in_lidar))
    pose = Pose(rotation, stripes.E_camera - rotation @ np.array([*lines.E_lidar, 0.0]))
    own = np.zeros((6, 6))
    own[np.ix_(ACROSS, ACROSS)] = _across(stripes.light_plane, pose)
    own[np.ix_(WITHIN, WITHIN)] = lines.covariance
    Ad = pose.adjoint()
    return UncertainPose(pose, Ad @ own @ Ad.T)


def _across(light: LightPlane, pose: Pose) -> FloatArray:
    """Covariance (3, 3) of (tz, rx, ry) in the LiDAR's own frame, from that of the light plane."""
    middle, u, v = pose.inverse() @ light.pivot, *(pose.rotation.T @ light.basis.T).T
    n = pose.rotation.T @ light.plane.normal
    # The normal turns by w = cross(n, change of n); the plane's shift is given at the pivot, wanted at the LiDAR.
    turns = np.column_stack([cross3(n, u), cross3(n, v), np.zeros(3)])[:2]
    shift = np.array([0.0, 0.0, n[2]]) - np.array([middle[1], -middle[0]]) @ turns
    J = np.vstack([shift, turns])
    return np.asarray(J @ light.covariance @ J.T)


def _frame(directions: FloatArray) -> FloatArray:
    """Columns (3, 3): both directions and their cross product."""
    return np.column_stack([directions[0], directions[1], cross3(directions[0], directions[1])])
