"""Planes of a scan: patches of one plane joined, fitted, and compared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, angle_between
from lidarpose.geometry.planes import Plane, fit_plane

# Patches are of one plane if their normals agree to within this and each lies on the other's plane.
_SAME_DIRECTION_RAD = np.deg2rad(1.0)


@dataclass(frozen=True, eq=False)
class MeasuredPlane:
    """A plane through `points` points with residuals of `rms_m`; its normal points to the frame's origin.

    `normal_sigma_rad` is the standard deviation of the normal's direction along its worse axis, from the noise alone.
    """

    plane: Plane
    points: int
    rms_m: float
    normal_sigma_rad: float


def joined_planes(patches: Sequence[FloatArray], noise_m: float) -> list[MeasuredPlane]:
    """Planes of patches (k, 3) each, those of one plane joined; largest first."""
    groups: list[FloatArray] = []
    for points in sorted(patches, key=len, reverse=True):
        for index, group in enumerate(groups):
            if _one_plane(group, points, noise_m):
                groups[index] = np.concatenate([group, points])
                break
        else:
            groups.append(points)
    return sorted((_measured(g) for g in groups), key=lambda p: -p.points)


def plane_angles_deg(planes: Sequence[MeasuredPlane]) -> FloatArray:
    """Angles (n, n) in degrees between planes, 0 to 90."""
    normals = np.stack([p.plane.normal for p in planes])
    between = angle_between(normals[:, None], normals[None])
    return np.asarray(np.rad2deg(np.minimum(between, np.pi - between)))


def axis_angles_deg(plane: Plane) -> FloatArray:
    """Angles (3,) in degrees of a plane's normal to the frame's x, y and z axes, 0 to 180."""
    return np.asarray(np.rad2deg(angle_between(np.broadcast_to(plane.normal, (3, 3)), np.eye(3))))


def _one_plane(large: FloatArray, small: FloatArray, noise_m: float) -> bool:
    a, b = fit_plane(large), fit_plane(small)
    if min(angle_between(a.normal, b.normal), angle_between(a.normal, -b.normal)) > _SAME_DIRECTION_RAD:
        return False
    return bool(np.abs(a.distance(small)).mean() < 2.0 * noise_m)


def _measured(points: FloatArray) -> MeasuredPlane:
    plane = fit_plane(points)
    for _ in range(3):
        distance = plane.distance(points)
        spread = 1.4826 * float(np.median(np.abs(distance)))
        # Mixed pixels and neighbours' edges that came along.
        plane = fit_plane(points[np.abs(distance) <= 4.0 * spread + 1e-9])
    distance = plane.distance(points)
    kept = points[np.abs(distance) <= 4.0 * 1.4826 * float(np.median(np.abs(distance))) + 1e-9]
    rms = float(np.sqrt(np.mean(plane.distance(kept) ** 2)))
    width = np.sqrt(max(float(np.linalg.eigvalsh(np.cov(kept.T))[1]), 1e-18))
    if plane.offset > 0.0:
        plane = plane.flipped()
    return MeasuredPlane(plane, len(kept), rms, rms / (width * np.sqrt(len(kept))))
