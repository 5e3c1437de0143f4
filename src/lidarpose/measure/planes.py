"""Planes of a scan: patches of one plane joined, fitted, and compared."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray, angle_between
from lidarpose.geometry.planes import Plane, fit_plane

# Patches are of one plane if their normals agree to within this and each lies on the other's plane.
_SAME_DIRECTION_RAD = np.deg2rad(1.0)
# Residuals are alike over pieces of a plane: so many along each of its axes, and it takes so many to tell anything.
_PIECES = 8
_LEAST_PIECES = 8
# Of planes nearer to parallel than so many standard deviations, noise alone decides which way they lean to each other.
_PARALLEL_SIGMAS = 3.0
# So many points of a plane tell how a calibration moves it.
_MOST_MOVED = 2000

PointShifts = Callable[[IntArray], FloatArray]
"""How points of flat indices (n,) move with a calibration's parameters: (n, 3, p)."""


@dataclass(frozen=True, eq=False)
class MeasuredPlane:
    """A plane through `points` points with residuals of `rms_m`; its normal points to the frame's origin.

    Attributes
    ----------
    index : (points,)
        Which of the points that were given.
    normal_covariance : (3, 3)
        Of the normal, from noise and unevenness alone.
    """

    plane: Plane
    points: int
    rms_m: float
    index: IntArray
    normal_covariance: FloatArray

    @property
    def normal_sigma_rad(self) -> float:
        """Standard deviation of the normal's direction along its worse axis, from noise and unevenness alone."""
        return _worst(self.normal_covariance)


def joined_planes(points: FloatArray, patches: Sequence[IntArray], noise_m: float) -> list[MeasuredPlane]:
    """Planes of patches, indices (k,) of points (n, 3), those of one plane joined; largest first."""
    groups: list[IntArray] = []
    for patch in sorted(patches, key=len, reverse=True):
        for at, group in enumerate(groups):
            if _one_plane(points[group], points[patch], noise_m):
                groups[at] = np.concatenate([group, patch])
                break
        else:
            groups.append(patch)
    return sorted((_measured(points, g) for g in groups), key=lambda p: -p.points)


def plane_angles_deg(planes: Sequence[MeasuredPlane]) -> FloatArray:
    """Angles (n, n) in degrees between planes, 0 to 90."""
    normals = np.stack([p.plane.normal for p in planes])
    between = angle_between(normals[:, None], normals[None])
    return np.asarray(np.rad2deg(np.minimum(between, np.pi - between)))


def plane_angle_sigmas_deg(
    planes: Sequence[MeasuredPlane],
    points: FloatArray,
    shifts: PointShifts | None = None,
    covariance: FloatArray | None = None,
) -> FloatArray:
    """Standard deviations (n, n) in degrees of the angles between planes, 0 on the diagonal.

    Parameters
    ----------
    points : (n, 3)
        What the planes' indices are of.
    shifts, covariance
        How points move with a calibration's parameters, and the covariance (p, p) of these. All planes share its
        errors, which cancel as far as they turn both planes of a pair alike. None: without the calibration's share.
    """
    C: FloatArray = np.zeros((0, 0))
    moved: list[FloatArray] = [np.zeros((3, 0)) for _ in planes]
    if shifts is not None and covariance is not None:
        C, moved = covariance, [_normal_shift(p, points, shifts) for p in planes]
    sigma = np.zeros((len(planes), len(planes)))
    for i, one in enumerate(planes):
        for j, other in enumerate(planes[:i]):
            sigma[i, j] = sigma[j, i] = _angle_sigma(one, other, moved[i], moved[j], C)
    return np.asarray(np.rad2deg(sigma))


def axis_angles_deg(plane: Plane) -> FloatArray:
    """Angles (3,) in degrees of a plane's normal to the frame's x, y and z axes, 0 to 180."""
    return np.asarray(np.rad2deg(angle_between(np.broadcast_to(plane.normal, (3, 3)), np.eye(3))))


def _worst(covariance: FloatArray) -> float:
    return float(np.sqrt(max(float(np.linalg.eigvalsh(covariance)[-1]), 0.0)))


def _angle_sigma(
    one: MeasuredPlane, other: MeasuredPlane, one_by: FloatArray, other_by: FloatArray, C: FloatArray
) -> float:
    n, m = one.plane.normal, other.plane.normal
    if n @ m < 0.0:
        m, other_by = -m, -other_by
    # Of the difference of both normals, whose length is about the angle.
    by = one_by - other_by
    worst = _worst(one.normal_covariance + other.normal_covariance + by @ C @ by.T)
    apart = float(np.arccos(min(float(n @ m), 1.0)))
    if apart < _PARALLEL_SIGMAS * worst:
        return worst
    # From cos(apart) = n . m.
    g, h = -m / np.sin(apart), -n / np.sin(apart)
    along = g @ one_by + h @ other_by
    own = g @ one.normal_covariance @ g + h @ other.normal_covariance @ h
    return float(np.sqrt(max(float(own + along @ C @ along), 0.0)))


def _one_plane(large: FloatArray, small: FloatArray, noise_m: float) -> bool:
    a, b = fit_plane(large), fit_plane(small)
    if min(angle_between(a.normal, b.normal), angle_between(a.normal, -b.normal)) > _SAME_DIRECTION_RAD:
        return False
    return bool(np.abs(a.distance(small)).mean() < 2.0 * noise_m)


def _measured(points: FloatArray, index: IntArray) -> MeasuredPlane:
    mine = points[index]
    plane = fit_plane(mine)
    for _ in range(3):
        # Mixed pixels and neighbours' edges that came along.
        plane = fit_plane(mine[_near(plane.distance(mine))])
    near = _near(plane.distance(mine))
    kept, index = mine[near], index[near]
    off = plane.distance(kept)
    if plane.offset > 0.0:
        plane = plane.flipped()
    return MeasuredPlane(plane, len(kept), float(np.sqrt(np.mean(off**2))), index, _normal_covariance(kept, off))


def _near(distance: FloatArray) -> FloatArray:
    spread = 1.4826 * float(np.median(np.abs(distance)))
    return np.asarray(np.abs(distance) <= 4.0 * spread + 1e-9)


def _slopes(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """What the normal turns by, (3, n), for each point's rise above the plane, and the points' places on it (n, 2)."""
    centred = points - points.mean(axis=0)
    axes = np.linalg.eigh(centred.T @ centred)[1][:, :0:-1]
    places = centred @ axes
    return -axes @ (places / np.maximum((places**2).sum(axis=0), 1e-18)).T, places


def _normal_covariance(points: FloatArray, off: FloatArray) -> FloatArray:
    """A sandwich over pieces of the plane (Liang and Zeger, 1986), or noise alone where there are few."""
    slopes, places = _slopes(points)
    lowest, highest = places.min(axis=0), places.max(axis=0)
    cell = np.minimum(_PIECES * (places - lowest) / np.maximum(highest - lowest, 1e-12), _PIECES - 1).astype(np.int64)
    _, piece = np.unique(cell[:, 0] * _PIECES + cell[:, 1], return_inverse=True)
    pieces = int(piece.max()) + 1
    if pieces < _LEAST_PIECES:
        return np.asarray(slopes @ slopes.T * float(np.mean(off**2)))
    scores = np.stack([np.bincount(piece, row * off, pieces) for row in slopes])
    return np.asarray(scores @ scores.T * (pieces / (pieces - 3.0)))


def _normal_shift(plane: MeasuredPlane, points: FloatArray, shifts: PointShifts) -> FloatArray:
    """The normal's derivative (3, p) by a calibration's parameters."""
    index = plane.index[:: max(1, len(plane.index) // _MOST_MOVED)]
    rise = np.einsum("a,nap->np", plane.plane.normal, shifts(index))
    return np.asarray(_slopes(points[index])[0] @ rise)
