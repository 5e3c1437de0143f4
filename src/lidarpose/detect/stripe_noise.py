"""What the noise of a stripe image depends on: reading (r), shots (g) and speckle (s), learnt from a fit's residuals.

The variance of a pixel is r^2 + g * level + (s * signal)^2.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import product

import numpy as np

from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.robust import MAD_TO_SIGMA

# Pixels that the noise is learnt from, at least (and fewer than twice as many), and the bins they are sorted into.
NOISE_SAMPLES, _NOISE_BINS = 1200, 8


def sampled(good: FloatArray) -> Iterator[tuple[int, IntArray]]:
    """Each band b of a table (P, B, N) of good pixels, and flat indices (M,) into its [:, b] of some of them."""
    for b in range(good.shape[1]):
        some = np.flatnonzero(good[:, b])
        yield b, some[:: max(len(some) // NOISE_SAMPLES, 1)]


def learn_noise(samples: Sequence[tuple[FloatArray, ...]], before: FloatArray) -> FloatArray:
    """Variance as r^2 + g * level + s^2 * signal^2 (all >= 0), from residuals sorted into bins by the signal.

    `samples` are residual, level and signal (M,) of some pixels of each band.
    """
    bins = [_noise_bins(*found) for found in samples]
    learnt = np.array([b for b, found in enumerate(bins) if found is not None], dtype=np.intp)
    noise = before.copy()
    if len(learnt):
        variance, by_level, by_signal = np.stack([found for found in bins if found is not None], axis=1)
        design = np.stack([np.ones_like(variance), by_level, by_signal], axis=-1)
        noise[learnt] = not_negative(design / variance[..., None], np.ones_like(variance))
        noise[learnt, 0] = np.maximum(noise[learnt, 0], 0.05)
    return noise


def _noise_bins(residual: FloatArray, level: FloatArray, signal: FloatArray) -> FloatArray | None:
    """Variance, mean level and mean squared signal (3, bins) of one band's pixels; None if they are too few."""
    if len(signal) < 12 * _NOISE_BINS:
        return None
    some = np.argsort(signal[: len(signal) // _NOISE_BINS * _NOISE_BINS])
    error, level, signal = (x[some].reshape(_NOISE_BINS, -1) for x in (np.abs(residual), level, signal))
    # Medians are deaf to what does not belong; a sixth of the freedom went into the fit.
    middle = error.shape[1] // 2
    variance = np.maximum(1.2 * (MAD_TO_SIGMA * np.partition(error, middle, axis=1)[:, middle]) ** 2, 0.05)
    return np.stack([variance, level.mean(axis=1), (signal**2).mean(axis=1)])


def not_negative(design: FloatArray, goal: FloatArray) -> FloatArray:
    """Least squares (B, k) with no unknown below zero, k small, for design (B, M, k) and goal (B, M).

    The best of all choices of the unknowns that are zero.
    """
    count = design.shape[-1]
    free = np.array(list(product((0.0, 1.0), repeat=count)))[:, None]
    scale = np.maximum(np.linalg.norm(design, axis=1), 1e-30)
    A = design / scale[:, None]
    normal, right = A.swapaxes(1, 2) @ A, (A.swapaxes(1, 2) @ goal[..., None])[..., 0]
    # Unknowns that are held at zero get the equation x = 0; the tiny part keeps equal columns solvable.
    both = free[..., None] * free[..., None, :]
    systems = normal * both + np.eye(count) * (1.0 - free[..., None] + 1e-12)
    found = np.linalg.solve(systems, (right * free)[..., None])[..., 0]
    rest = ((np.einsum("bmk,cbk->cbm", A, found) - goal) ** 2).sum(axis=-1)
    rest = np.where(found.min(axis=-1) >= 0.0, rest, np.inf)
    best = np.argmin(rest, axis=0)
    return np.asarray(found[best, np.arange(len(best))] / scale)
