"""Circles in the plane and in space, and their fits."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray, as_float_array, perpendicular_pair, unit


@dataclass(frozen=True, eq=False)
class Circle2:
    """A circle in the plane: `centre` (2,) and `radius`, in metres."""

    centre: FloatArray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", as_float_array(self.centre, (2,), "centre"))

    def distance(self, points: ArrayLike) -> FloatArray:
        """Signed distances (...) of points (..., 2), positive outside."""
        return np.asarray(np.linalg.norm(np.asarray(points) - self.centre, axis=-1) - self.radius)


@dataclass(frozen=True, eq=False)
class Circle3:
    """A circle in space: `centre` (3,), unit `normal` (3,) of its plane, `radius`, in metres."""

    centre: FloatArray
    normal: FloatArray
    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "centre", as_float_array(self.centre, (3,), "centre"))
        object.__setattr__(self, "normal", as_float_array(unit(self.normal), (3,), "normal"))


def fit_circle2(points: ArrayLike) -> Circle2:
    """Taubin's algebraic circle fit through points (N, 2), N >= 3.

    Far less biased on short arcs than the plain algebraic fit. Source: Taubin (1991) in the SVD form of Chernov,
    *Circular and Linear Regression* (2010), section 5.9.

    Raises
    ------
    ValueError
        If there are fewer than three points, or they lie on a line or on one spot.
    """
    x = np.asarray(points, dtype=np.float64)
    if len(x) < 3:
        raise ValueError("a circle needs three points")
    mean = x.mean(axis=0)
    d = x - mean
    spread = np.sqrt((d**2).sum(axis=1).mean())
    if not spread > 0.0:
        raise ValueError("coinciding points determine no circle")
    d = d / spread
    z = (d**2).sum(axis=1)
    # With z scaled so, Taubin's constraint becomes the unit norm of the singular vector.
    columns = np.column_stack([(z - z.mean()) / (2.0 * np.sqrt(z.mean())), d])
    a, b, c = np.linalg.svd(columns, full_matrices=False)[2][-1]
    a = a / (2.0 * np.sqrt(z.mean()))
    if abs(a) < 1e-12:
        raise ValueError("points on a line determine no circle")
    centre = -np.array([b, c]) / (2.0 * a)
    # The algebraic offset is -a * mean(z); the radius follows from completing the square.
    radius = np.sqrt(centre @ centre + z.mean())
    return Circle2(mean + spread * centre, float(spread * radius))


def fit_circle3(points: ArrayLike, normal: ArrayLike) -> Circle3:
    """Circle through points (N, 3) in a plane of known unit `normal` (3,): the plane's offset is the mean one."""
    x = np.asarray(points, dtype=np.float64)
    w = unit(normal)
    u, v = perpendicular_pair(w)
    flat = fit_circle2(np.column_stack([x @ u, x @ v]))
    centre = flat.centre[0] * u + flat.centre[1] * v + (x @ w).mean() * w
    return Circle3(centre, w, flat.radius)
