"""Where a LiDAR's light sheet and its beams meet a panel, by clipping and by ray and plane.

All in the panel's frame (z = 0 on the panel), from the LiDAR's pose in that frame: nothing here is shared with the
estimators.
"""

from __future__ import annotations

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.simulate.board_pattern import Plate


def chord_on_plate(T_panel_lidar: Pose, plate: Plate) -> FloatArray | None:
    """The ends (2, 3) of the line in which the LiDAR's x-y plane crosses a plate; None where it misses.

    The outline is walked edge by edge: where the signed distance from the sheet changes its sign, there is an end.
    """
    normal = T_panel_lidar.rotation[:, 2]
    corners = plate.outline()
    height = (corners - T_panel_lidar.translation) @ normal
    ends = []
    for k in range(4):
        a, b = height[k], height[(k + 1) % 4]
        if (a < 0.0) != (b < 0.0):
            share = a / (a - b)
            ends.append((1.0 - share) * corners[k] + share * corners[(k + 1) % 4])
    return np.array(ends) if len(ends) == 2 else None


def beams_to_panel(T_panel_lidar: Pose, angle_rad: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Ranges (N,) and points (N, 3) where beams meet the panel's plane; inf or negative where they do not."""
    cosine, sine = np.cos(angle_rad), np.sin(angle_rad)
    R = T_panel_lidar.rotation
    directions = cosine[:, None] * R[:, 0] + sine[:, None] * R[:, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        ranges = -T_panel_lidar.translation[2] / directions[:, 2]
        return ranges, T_panel_lidar.translation + ranges[:, None] * directions


def beam_on_panel(T_panel_lidar: Pose, ends: FloatArray, beam_angle_rad: FloatArray) -> bool:
    """Whether the LiDAR's field of view covers a chord (2, 3) given in the panel's frame."""
    x, y, _ = (T_panel_lidar.inverse() @ ends).T
    middle = 0.5 * (beam_angle_rad[0] + beam_angle_rad[-1])
    half = 0.5 * (beam_angle_rad[-1] - beam_angle_rad[0])
    off = np.angle(np.exp(1j * (np.arctan2(y, x) - middle)))
    return bool(np.all(np.abs(off) <= half))
