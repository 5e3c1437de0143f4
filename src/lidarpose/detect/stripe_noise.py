"""What the noise of a stripe image depends on: reading (r), shots (g) and speckle (s), learnt from a fit's residuals.

The variance of a pixel is r^2 + g * level + (s * signal)^2.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np

from lidarpose.detect.stripe_search import KERNELS
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import MAD_TO_SIGMA

# Pixels that the noise is learnt from, at least (and fewer than twice as many), the bins they are sorted into, and how
# many there must be in each.
NOISE_SAMPLES, _NOISE_BINS, _LEAST_IN_BIN = 1200, 8, 12


@dataclass(frozen=True, eq=False)
class Samples:
    """Residual, level and signal (B, 3, M) of some pixels of each band; the first `counts` (B,) of each row are any."""

    values: FloatArray
    counts: IntArray

    @staticmethod
    def of(good: FloatArray, tables: Sequence[FloatArray]) -> Samples:
        """Evenly picked among the good pixels of tables (P, B, N) of residual, level and signal."""
        found = np.zeros((good.shape[1], 3, 2 * NOISE_SAMPLES), np.float32)
        counts = np.zeros(len(found), np.intp)
        for b in range(len(found)):
            some = np.flatnonzero(good[:, b])
            some = some[:: max(len(some) // NOISE_SAMPLES, 1)]
            counts[b] = len(some)
            for k, table in enumerate(tables):
                found[b, k, : len(some)] = table[:, b].ravel()[some]
        return Samples(found, counts)

    @property
    def per_bin(self) -> IntArray:
        """How many pixels (B,) of each band go into a bin."""
        return self.counts // _NOISE_BINS

    def by_signal(self) -> IntArray:
        """Order (B, M) of each band's pixels by the signal, of as many as fill the bins."""
        used = np.arange(self.values.shape[2]) < _NOISE_BINS * self.per_bin[:, None]
        return np.argsort(np.where(used, self.values[:, 2], np.inf), axis=1)


def learn_noise(samples: Samples, before: FloatArray) -> FloatArray:
    """Variance (B, 3) as r^2 + g * level + s^2 * signal^2 (all >= 0), from residuals sorted into bins by the signal;
    that from `before` where the pixels are too few."""
    noise = np.array(before, dtype=np.float64)
    learnt = samples.per_bin >= _LEAST_IN_BIN
    if not learnt.any():
        return noise
    if pays(0.0, KERNELS):
        from lidarpose.detect import stripe_profile_kernels

        order = samples.by_signal()
        stripe_profile_kernels.learn_noise(samples.values, samples.per_bin, learnt, order, _NOISE_BINS, noise)
        return noise
    variance, by_level, by_signal = _noise_bins(Samples(samples.values[learnt], samples.counts[learnt]))
    design = np.stack([np.ones_like(variance), by_level, by_signal], axis=-1)
    noise[learnt] = not_negative(design / variance[..., None], np.ones_like(variance))
    noise[learnt, 0] = np.maximum(noise[learnt, 0], 0.05)
    return noise


def _noise_bins(samples: Samples) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Variance, mean level and mean squared signal (B, bins) of the bands' pixels."""
    size = samples.per_bin[:, None, None]
    place = np.arange(int(size.max()))
    inside = place < size
    shape = (len(size), _NOISE_BINS, len(place))
    at = np.where(inside, np.arange(_NOISE_BINS)[:, None] * size + place, 0).reshape(len(size), -1)
    at = np.take_along_axis(samples.by_signal(), at, axis=1)
    residual, level, signal = (np.take_along_axis(samples.values[:, k], at, axis=1).reshape(shape) for k in range(3))
    # Medians are deaf to what does not belong; a sixth of the freedom went into the fit.
    error = np.sort(np.where(inside, np.abs(residual), np.inf), axis=2)
    middle = np.take_along_axis(error, size // 2, axis=2)[..., 0].astype(np.float64)
    variance = np.maximum(1.2 * (MAD_TO_SIGMA * middle) ** 2, 0.05)
    level, signal = (np.where(inside, x, 0.0).astype(np.float64) for x in (level, signal))
    by_level, by_signal = (x.sum(axis=2) / size[..., 0] for x in (level, signal**2))
    return variance, by_level, by_signal


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
