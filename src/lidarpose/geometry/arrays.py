"""Array types shared by the whole package, and the few checks that everyone needs."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

FloatArray = NDArray[np.floating[Any]]
"""Floats, float64 wherever the package makes them."""
BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]


def as_float_array(values: ArrayLike, shape: tuple[int | None, ...], name: str) -> FloatArray:
    """Return `values` as a read-only float64 copy of the given shape (None: any length), or raise ValueError."""
    array = np.array(values, dtype=np.float64)
    if array.ndim != len(shape) or any(n is not None and n != m for n, m in zip(shape, array.shape, strict=False)):
        wanted = "x".join("N" if n is None else str(n) for n in shape)
        raise ValueError(f"{name} has shape {array.shape}, expected {wanted}")
    array.setflags(write=False)
    return array


def unit(vectors: ArrayLike) -> FloatArray:
    """Vectors (..., n) scaled to length 1; raises ValueError where one has no direction."""
    array = np.asarray(vectors, dtype=np.float64)
    if array.ndim == 1:  # most calls, and several times as fast as the general way
        single = math.sqrt(array @ array)
        if not single > 0.0:
            raise ValueError("a vector of length zero has no direction")
        return np.asarray(array / single)
    length = np.linalg.norm(array, axis=-1, keepdims=True)
    if not np.all(length > 0.0):
        raise ValueError("a vector of length zero has no direction")
    return np.asarray(array / length)


def cross3(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product (3,) of two single vectors (3,); for these numpy's own spends its time on axes."""
    (p, q, r), (x, y, z) = a.tolist(), b.tolist()
    return np.array([q * z - r * y, r * x - p * z, p * y - q * x])


def inverse_2x2(matrices: FloatArray) -> FloatArray:
    """Inverses (..., 2, 2) of matrices; numpy's own take ten times as long for so small ones."""
    (a, b), (c, d) = np.moveaxis(matrices, (-2, -1), (0, 1))
    adjugate = np.stack([np.stack([d, -b], axis=-1), np.stack([-c, a], axis=-1)], axis=-2)
    return np.asarray(adjugate / (a * d - b * c)[..., None, None])


def angle_between(a: ArrayLike, b: ArrayLike) -> Any:
    """Angle in [0, pi] between vectors (..., 3), accurate near 0 and pi where arccos is not (Kahan)."""
    a_unit, b_unit = unit(a), unit(b)
    return 2.0 * np.arctan2(
        np.linalg.norm(a_unit - b_unit, axis=-1),
        np.linalg.norm(a_unit + b_unit, axis=-1),
    )


def wrap_angle(angle_rad: ArrayLike) -> Any:
    """Angles folded into [-pi, pi)."""
    return (np.asarray(angle_rad, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi


def perpendicular_pair(direction: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Two unit vectors u, v with (u, v, direction) right-handed; `direction` is (3,), need not be unit."""
    x, y, z = np.asarray(direction, dtype=np.float64).tolist()
    length = math.sqrt(x * x + y * y + z * z)
    if not length > 0.0:
        raise ValueError("a vector of length zero has no direction")
    w = x, y, z = x / length, y / length, z / length
    # The cross product with the axis that is least along the direction, written out.
    least = min(range(3), key=lambda k: abs(w[k]))
    p, q, r = ((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))[least]
    across = math.sqrt(p * p + q * q + r * r)
    p, q, r = p / across, q / across, r / across
    return np.array([p, q, r]), np.array([y * r - z * q, z * p - x * r, x * q - y * p])
