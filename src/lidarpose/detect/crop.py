"""What lies in a box, out of frame after frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.compiled import pays

# By how much kernels are done sooner, on one core.
SAVED_S_PER_POINT = 1e-9


def inside_box(points: NDArray[np.floating], low: FloatArray, high: FloatArray) -> NDArray[np.floating]:
    """Points (M, 3) of (N, 3) in a box, those without return left out: most fall out by two coordinates alone."""
    middle, half = (x.astype(points.dtype) for x in (0.5 * (low + high), 0.5 * (high - low)))
    # The farther the box lies out along an axis for its size, the fewer points share that coordinate.
    first, second, third = np.argsort(-np.abs(middle) / half).tolist()
    if points.flags.c_contiguous and pays(SAVED_S_PER_POINT * len(points), "detect.target_kernels"):
        from lidarpose.detect.target_kernels import points_in_box

        order = np.array([first, second, third])
        return np.asarray(points_in_box(points, order, middle, half))

    def near(some: NDArray[np.floating], axis: int) -> BoolArray:
        x = some[:, axis] - middle[axis]
        return np.asarray(np.abs(x, out=x) < half[axis])

    # Positions are found quickly where few are asked for: that is why two coordinates are looked at together.
    with np.errstate(invalid="ignore"):
        few = points.take(np.flatnonzero(near(points, first) & near(points, second)), axis=0)
        return few.take(np.flatnonzero(near(few, third)), axis=0)
