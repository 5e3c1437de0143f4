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
    step = _numbers_apart(points)
    if step is not None and pays(SAVED_S_PER_POINT * len(points), "detect.target_kernels"):
        from lidarpose.detect.target_kernels import points_in_box

        # Nothing beyond the last point's z, which may be where the memory ends.
        shape, strides = (max(step * (len(points) - 1) + 3, 0),), (points.itemsize,)
        flat = points.reshape(-1) if step == 3 else np.lib.stride_tricks.as_strided(points, shape, strides)
        return np.asarray(points_in_box(flat, step, len(points), middle, half))
    # The farther the box lies out along an axis for its size, the fewer points share that coordinate.
    first, second, third = np.argsort(-np.abs(middle) / half).tolist()

    def near(some: NDArray[np.floating], axis: int) -> BoolArray:
        x = some[:, axis] - middle[axis]
        return np.asarray(np.abs(x, out=x) < half[axis])

    # Positions are found quickly where few are asked for: that is why two coordinates are looked at together.
    with np.errstate(invalid="ignore"):
        chosen = np.flatnonzero(near(points, first) & near(points, second))
        # Points that stand apart would all be put together before some of them are taken.
        few = points.take(chosen, axis=0) if points.flags.c_contiguous else points[chosen]
        return few.take(np.flatnonzero(near(few, third)), axis=0)


def _numbers_apart(points: NDArray[np.floating]) -> int | None:
    """How many numbers there are from one point to the next, as rows of a file have them; None where that is no whole
    number, or coordinates are not side by side."""
    apart, rest = divmod(points.strides[0], points.itemsize)
    side_by_side = points.strides[1] == points.itemsize and points.flags.aligned
    return apart if side_by_side and not rest and apart >= 3 else None
