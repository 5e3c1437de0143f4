"""Flat patches in a grid of beams: seeds where small windows are flat, grown as far as the plane goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import ndimage

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.planes import Plane, fit_plane

_WINDOW = 7
_TOLERANCE_IN_SIGMA = 4.0


@dataclass(frozen=True, eq=False)
class Patch:
    """A connected flat region of the grid.

    Attributes
    ----------
    plane
        Through its points, in the camera frame.
    rows, columns
        The box of the grid that it was looked for in; it is larger than the patch where the grid allows.
    mask
        Which beams of the box are on it.
    """

    plane: Plane
    rows: slice
    columns: slice
    mask: BoolArray

    @property
    def count(self) -> int:
        return int(np.count_nonzero(self.mask))


def find_patches(points: FloatArray, sigma: float, *, smallest: int = 60) -> list[Patch]:
    """Flat patches of at least `smallest` points in a grid of points (N, M, 3), NaN without return; largest first.

    Parameters
    ----------
    sigma
        Range noise, metres.
    """
    seeds = _flat_windows(points, sigma)
    taken = np.zeros(points.shape[:2], dtype=bool)
    patches = []
    for i, j in seeds:
        if taken[i, j]:
            continue
        patch = _grow(points, int(i), int(j), _TOLERANCE_IN_SIGMA * sigma)
        if patch is None:
            taken[i, j] = True
            continue
        # Outliers inside the patch are no seeds of others.
        taken[patch.rows, patch.columns] |= ndimage.binary_dilation(patch.mask, iterations=2)
        if patch.count >= smallest:
            patches.append(patch)
    return sorted(patches, key=lambda p: -p.count)


def _flat_windows(points: FloatArray, sigma: float) -> IntArray:
    """Centres (n, 2) of windows of points that lie on a plane to within noise; the flattest first."""
    N, M = points.shape[:2]
    if N < _WINDOW or M < _WINDOW:
        return np.zeros((0, 2), dtype=np.int64)
    half = _WINDOW // 2
    step = 3
    rows = np.arange(half, N - half, step)
    columns = np.arange(half, M - half, step)
    windows = np.lib.stride_tricks.sliding_window_view(points, (_WINDOW, _WINDOW), axis=(0, 1))
    found: list[IntArray] = []
    rms: list[FloatArray] = []
    for i in np.array_split(rows, max(1, len(rows) * len(columns) // 20000)):
        x = np.asarray(windows[i - half][:, columns - half]).reshape(len(i), len(columns), 3, -1)
        seen = np.isfinite(x[:, :, 0])
        # Beams without return are left out of a window; three quarters of it must be there.
        full = seen.mean(axis=-1) > 0.75
        x, seen = x[full], seen[full]
        count = seen.sum(axis=-1)
        x = np.where(seen[:, None], x, 0.0)
        x = np.where(seen[:, None], x - (x.sum(axis=-1) / count[:, None])[..., None], 0.0)
        values = np.linalg.eigvalsh(x @ np.swapaxes(x, -1, -2) / count[:, None, None])
        spread = np.sqrt(np.maximum(values[:, 0], 0.0))
        where = np.stack(np.meshgrid(i, columns, indexing="ij"), -1)[full]
        flat = spread < 1.5 * sigma
        found.append(where[flat])
        rms.append(spread[flat])
    order = np.argsort(np.concatenate(rms), kind="stable")
    return np.asarray(np.concatenate(found)[order])


def _grow(points: FloatArray, i: int, j: int, tolerance: float) -> Patch | None:
    """The patch around a seed: widen the box and refit until the patch no longer reaches the box's border."""
    N, M = points.shape[:2]
    half = _WINDOW // 2
    seed = points[i - half : i + half + 1, j - half : j + half + 1].reshape(-1, 3)
    seed = seed[np.isfinite(seed[:, 0])]
    plane = fit_plane(seed)
    reach = _WINDOW
    count = 0
    while True:
        rows, columns = slice(max(0, i - reach), min(N, i + reach + 1)), slice(max(0, j - reach), min(M, j + reach + 1))
        box = points[rows, columns]
        mask = np.zeros(box.shape[:2], dtype=bool)
        for _ in range(3):
            mask = _connected(np.abs(plane.distance(box)) <= tolerance, i - rows.start, j - columns.start)
            if np.count_nonzero(mask) < len(seed) // 2:
                return None
            plane = fit_plane(box[mask])
        whole = rows == slice(0, N) and columns == slice(0, M)
        grown = int(np.count_nonzero(mask))
        if whole or (grown == count) or not _touches_border(mask):
            return Patch(plane, rows, columns, mask)
        count, reach = grown, int(1.6 * reach) + 1


def _touches_border(mask: BoolArray) -> bool:
    margin = 3
    inner = np.zeros_like(mask)
    inner[margin:-margin, margin:-margin] = True
    return bool((mask & ~inner).any())


def _connected(mask: BoolArray, i: int, j: int) -> BoolArray:
    """The connected part of a mask that holds (i, j) or most of the seed window around it."""
    labels, _ = ndimage.label(mask)
    half = _WINDOW // 2
    near = labels[max(0, i - half) : i + half + 1, max(0, j - half) : j + half + 1]
    near = near[near > 0]
    if near.size == 0:
        return np.zeros_like(mask)
    return np.asarray(labels == np.bincount(near).argmax())
