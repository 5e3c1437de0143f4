"""Lines in the plane as unit normal and offset, ``normal . x = offset``; lines in space as point and direction.

No slope and no intercept: nothing is singular where a line is vertical, unlike eqs. (7) to (11) of the turntable paper.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray, as_float_array, unit


def unit_form(normal: FloatArray, offset: float) -> tuple[FloatArray, float]:
    """The same line or plane ``normal . x = offset`` with a unit, read-only normal.

    Raises
    ------
    ValueError
        If the normal is zero.
    """
    length = float(np.linalg.norm(normal))
    if not length > 0.0:
        raise ValueError("a line or plane needs a normal of non-zero length")
    normal = normal / length
    normal.setflags(write=False)
    return normal, float(offset) / length


@dataclass(frozen=True, eq=False)
class Line2:
    """The line ``normal . x = offset`` in the plane; `normal` (2,) is unit, `offset` in metres."""

    normal: FloatArray
    offset: float

    def __post_init__(self) -> None:
        normal, offset = unit_form(as_float_array(self.normal, (2,), "normal"), self.offset)
        object.__setattr__(self, "normal", normal)
        object.__setattr__(self, "offset", offset)

    @property
    def direction(self) -> FloatArray:
        """Unit direction (2,): the normal turned by -90 degrees."""
        return np.array([self.normal[1], -self.normal[0]])

    def distance(self, points: ArrayLike) -> FloatArray:
        """Signed distances (...) of points (..., 2)."""
        return np.asarray(np.asarray(points) @ self.normal - self.offset)

    def project(self, points: ArrayLike) -> FloatArray:
        """Feet (..., 2) of the perpendiculars from points (..., 2)."""
        return np.asarray(points) - self.distance(points)[..., None] * self.normal

    def intersection(self, other: Line2) -> FloatArray:
        """Common point (2,). Raises ValueError where the lines are parallel."""
        system = np.stack([self.normal, other.normal])
        if abs(np.linalg.det(system)) < 1e-12:
            raise ValueError("parallel lines have no common point")
        return np.asarray(np.linalg.solve(system, [self.offset, other.offset]))


@dataclass(frozen=True, eq=False)
class Line3:
    """A line in space: `point` (3,) in metres and unit `direction` (3,)."""

    point: FloatArray
    direction: FloatArray

    def __post_init__(self) -> None:
        object.__setattr__(self, "point", as_float_array(self.point, (3,), "point"))
        object.__setattr__(self, "direction", as_float_array(unit(self.direction), (3,), "direction"))

    def project(self, points: ArrayLike) -> FloatArray:
        """Feet (..., 3) of the perpendiculars from points (..., 3)."""
        along = (np.asarray(points) - self.point) @ self.direction
        return np.asarray(self.point + along[..., None] * self.direction)

    def distance(self, points: ArrayLike) -> FloatArray:
        """Distances (...), not negative, of points (..., 3)."""
        return np.asarray(np.linalg.norm(np.asarray(points) - self.project(points), axis=-1))


def fit_line2(points: ArrayLike, weights: ArrayLike | None = None) -> Line2:
    """Total least squares line through points (N, 2), N >= 2, with optional weights (N,).

    Raises
    ------
    ValueError
        If fewer than two points carry weight, or all coincide.
    """
    x = np.asarray(points, dtype=np.float64)
    w = np.ones(len(x)) if weights is None else np.asarray(weights, dtype=np.float64)
    if np.count_nonzero(w > 0) < 2:
        raise ValueError("a line needs two points")
    mean = w @ x / w.sum()
    d = (x - mean) * np.sqrt(w)[:, None]
    scatter = d.T @ d
    if scatter.trace() <= 0.0:
        raise ValueError("coinciding points determine no line")
    # In closed form: twice the direction's angle is that of (difference of variances, twice the covariance).
    direction = 0.5 * np.arctan2(2.0 * scatter[0, 1], scatter[0, 0] - scatter[1, 1])
    normal = np.array([-np.sin(direction), np.cos(direction)])
    return Line2(normal, float(normal @ mean))
