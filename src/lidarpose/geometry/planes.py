"""Planes in space as unit normal and offset, ``normal . x = offset``.

Unlike eq. (4) of the turntable paper this holds for planes through the origin (the camera) too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray, as_float_array, cross3
from lidarpose.geometry.lines import Line3, unit_form
from lidarpose.geometry.se3 import Pose


@dataclass(frozen=True, eq=False)
class Plane:
    """The plane ``normal . x = offset``; `normal` (3,) is unit, `offset` in metres."""

    normal: FloatArray
    offset: float

    def __post_init__(self) -> None:
        normal, offset = unit_form(as_float_array(self.normal, (3,), "normal"), self.offset)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "offset", offset)

    @staticmethod
    def from_pose(T_a_panel: Pose) -> Plane:
        """The x-y plane of a panel's frame, in frame a (turntable paper, eq. (3))."""
        normal = T_a_panel.rotation[:, 2]
        return Plane(normal, float(normal @ T_a_panel.translation))

    def distance(self, points: ArrayLike) -> FloatArray:
        """Signed distances (...) of points (..., 3)."""
        return np.asarray(np.asarray(points) @ self.normal - self.offset)

    def project(self, points: ArrayLike) -> FloatArray:
        """Feet (..., 3) of the perpendiculars from points (..., 3)."""
        return np.asarray(points) - self.distance(points)[..., None] * self.normal

    def flipped(self) -> Plane:
        return Plane(-self.normal, -self.offset)

    def intersect_rays(self, directions: ArrayLike, origin: ArrayLike = (0.0, 0.0, 0.0)) -> FloatArray:
        """Points (..., 3) where rays from `origin` along `directions` (..., 3) meet the plane; inf where parallel."""
        d = np.asarray(directions, dtype=np.float64)
        o = np.asarray(origin, dtype=np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            s = (self.offset - o @ self.normal) / (d @ self.normal)
            return np.asarray(o + s[..., None] * d)

    def intersect_plane(self, other: Plane) -> Line3:
        """Common line, its direction along ``cross(normal, other.normal)``. Raises ValueError if parallel."""
        direction = cross3(self.normal, other.normal)
        squared = float(direction @ direction)
        if squared < 1e-18:
            raise ValueError("parallel planes have no common line")
        # The common line's point nearest to the origin (Goldman, "Intersection of two planes", Graphics Gems).
        point = self.offset * cross3(other.normal, direction) + other.offset * cross3(direction, self.normal)
        return Line3(point / squared, direction)


def intersect_three_planes(planes: tuple[Plane, Plane, Plane]) -> FloatArray:
    """Common point (3,) of three planes. Raises ValueError where their normals lie in one plane."""
    normals = np.stack([p.normal for p in planes])
    if np.linalg.svd(normals, compute_uv=False)[-1] < 1e-9:
        raise ValueError("three planes along one direction have no single common point")
    return np.asarray(np.linalg.solve(normals, [p.offset for p in planes]))


def fit_plane(points: ArrayLike, weights: ArrayLike | None = None) -> Plane:
    """Total least squares plane through points (N, 3), N >= 3, with optional weights (N,).

    Raises
    ------
    ValueError
        If fewer than three points carry weight, or they lie on one line.
    """
    x = np.asarray(points, dtype=np.float64)
    w = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    if np.count_nonzero(w > 0) < 3:
        raise ValueError("a plane needs three points")
    mean = w @ x / w.sum()
    d = (x - mean) * np.sqrt(w)[:, None]
    values, vectors = np.linalg.eigh(d.T @ d)
    if values[1] <= 1e-14 * values[2]:
        raise ValueError("points on one line determine no plane")
    normal = vectors[:, 0]
    return Plane(normal, float(normal @ mean))
