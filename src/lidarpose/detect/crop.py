"""What lies in a box, out of frame after frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.compiled import pays

# By how much kernels are done sooner, on one core.
SAVED_S_PER_POINT = 2e-9


def inside_box(points: NDArray[np.floating], low: FloatArray, high: FloatArray) -> NDArray[np.floating]:
    """Points (M, 3) of (N, 3) in a box: most fall out by one coordinate alone, those without return too."""
    middle, half = 0.5 * (low + high), 0.5 * (high - low)
    # The farther the box lies out along an axis for its size, the fewer points share that coordinate.
    order = np.argsort(-np.abs(middle) / half)
    if points.flags.c_contiguous and pays(SAVED_S_PER_POINT * len(points), "detect.target_kernels"):
        from lidarpose.detect.target_kernels import points_in_box

        return np.asarray(points_in_box(points, order, middle.astype(points.dtype), half))
    with np.errstate(invalid="ignore"):
        for k in order:
            x = points[:, k] - points.dtype.type(middle[k])
            points = points.take(np.flatnonzero(np.abs(x, out=x) < half[k]), axis=0)
    return points
