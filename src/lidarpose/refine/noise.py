"""Noise from residuals: a redescending loss that is Gaussian in its core, and scales that stay right under it."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.robust import mad_sigma

CORE = 2.5
"""Residuals up to this many standard deviations count in full ..."""
REJECT = 5.0
"""... and beyond this many not at all; in between the weight falls as a raised cosine."""


def taper_weights(standardised: FloatArray) -> FloatArray:
    """Weights (N,) of residuals in units of sigma, in the manner of Hampel's three-part loss: 99.7 % efficient."""
    size = np.abs(standardised)
    weights = np.ones(size.shape)
    beyond = np.flatnonzero(~(size <= CORE))  # few (or NaN): cosines of all would cost far more
    z = np.minimum((size.flat[beyond] - CORE) / (REJECT - CORE), 1.0)
    weights.flat[beyond] = 0.5 * (1.0 + np.cos(np.pi * z))
    return weights


@cache
def gaussian_moments() -> tuple[float, float, float]:
    """Under a standard normal: the share of weights above zero, E[psi^2] and E[psi'] of `taper_weights`."""
    z = np.linspace(-8.0, 8.0, 160001)
    density = np.exp(-0.5 * z * z) / np.sqrt(2.0 * np.pi) * (z[1] - z[0])
    psi = z * taper_weights(z)
    inside = np.abs(z) < REJECT
    return float(density[inside].sum()), float((density * psi**2).sum()), float((density * np.gradient(psi, z)).sum())


def robust_scale(standardised: FloatArray, parameters: float) -> tuple[float, FloatArray]:
    """Standard deviation of residuals (N,) that should have mean 0 and variance 1, and their weights at that scale.

    Starts from the median absolute deviation; then the mean of psi^2 over what is not rejected is what it would be
    for a normal distribution, less the degrees of freedom that `parameters` took.
    """
    n = len(standardised)
    if n == 0:
        return 1.0, np.zeros(0)
    share, psi_square, _ = gaussian_moments()
    scale = max(mad_sigma(standardised, centred=True), 1e-12)
    for _ in range(6):
        weight = taper_weights(standardised / scale)
        used = np.count_nonzero(weight > 0.0)
        freedom = max(used * (1.0 - parameters / n), 1.0)
        square = float(((weight * standardised) ** 2).sum()) * share / psi_square / freedom
        new = max(float(np.sqrt(square)), 1e-12)
        done = abs(new / scale - 1.0) < 1e-4
        scale = new
        if done:
            break
    return scale, taper_weights(standardised / scale)


def information_correction(standardised: FloatArray, weight: FloatArray) -> float:
    """By what the information of weighted least squares is to be multiplied for the loss that was really used.

    The asymptotic variance of an M-estimate is E[psi^2] / E[psi']^2 (Huber, *Robust Statistics*, section 7.6); weighted
    least squares alone states 1 / E[weight].
    """
    if not len(standardised) or not weight.any():
        return 1.0
    size = np.abs(standardised)
    psi = weight * standardised
    bent = np.flatnonzero((size > CORE) & (size < REJECT))
    z = size[bent]
    slope = weight.copy()
    slope[bent] -= 0.5 * np.pi * z / (REJECT - CORE) * np.sin(np.pi * (z - CORE) / (REJECT - CORE))
    square, bend, mean_weight = float((psi**2).mean()), float(slope.mean()), float(weight.mean())
    if square <= 0.0 or bend <= 0.1:
        return 1.0
    return float(np.clip(bend**2 / (square * mean_weight), 0.3, 1.0))


_NO_LAG, _SURE_LAG = 1.0, 2.0
"""A correlation below the first so many of its standard deviations ends the sum over lags.

Up to the second it counts by its share, or steps would go to and fro for ever."""
_MOST_LAGS = 60


def rows_that_count_as_one(psi: FloatArray, line_of_row: IntArray, parameters: float) -> float:
    """How many neighbouring measurements of a line are worth one, at least 1.

    The variance of a mean of correlated rows exceeds that of independent ones by 1 + 2 (rho_1 + rho_2 + ...) (Bartlett,
    1946). The sum fades out where correlations are not significant. A line of hundreds of rows has enough of
    them to tell this even where lines are few.

    Parameters
    ----------
    psi : (N,)
        Weighted standardised residuals, row after row of each line; zero where a row is not used.
    line_of_row : (N,)
    parameters
        Degrees of freedom that were taken from the rows: they alone make residuals correlate by minus their share.
    """
    used = psi != 0.0
    n = int(np.count_nonzero(used))
    if n <= 2.0 * parameters:
        return 1.0
    square = float((psi * psi).sum()) / n
    taken = parameters / (n - parameters)
    total, share = 0.0, 1.0
    for product, pairs in _sums_at_lags(psi, used, line_of_row):
        if pairs < 20:
            break
        correlation = product / pairs / square + taken
        share *= min(max((correlation * pairs**0.5 - _NO_LAG) / (_SURE_LAG - _NO_LAG), 0.0), 1.0)
        if share == 0.0:
            break
        total += share * correlation
    return 1.0 + 2.0 * total


def _sums_at_lags(values: FloatArray, used: BoolArray, line_of_row: IntArray) -> Iterator[tuple[float, int]]:
    """Sums of values (N,) times those 1, 2, ... rows further on in the same line, and how many of both are used.

    Lines follow one another; between them stand so many zeros that none meets the next.
    """
    line = line_of_row - line_of_row[0]
    lags = min(_MOST_LAGS, int(np.bincount(line).max()))
    at = np.arange(len(values)) + lags * line
    spread, there = np.zeros(int(at[-1]) + 1), np.zeros(int(at[-1]) + 1, dtype=bool)
    spread[at], there[at] = values, used
    for lag in range(1, lags + 1):
        # Not by BLAS, which would wake threads for so long a sum.
        yield float(np.einsum("i,i->", spread[lag:], spread[:-lag])), int(np.count_nonzero(there[lag:] & there[:-lag]))


_SCATTER_BINS = 8
_LEAST_PER_BIN = 25
_SURE_GROWTH = 3.0


def growth_of_scatter(standardised: FloatArray, sigma: FloatArray) -> float:
    """The exponent p for which scatter grows as sigma^p, sigma being stated with each measurement; 1 if they are right.

    Stated standard deviations are only as good as what detection knows of the noise: where they run from 1 to 5, the
    true ones may run from 1 to 2. Slope of log scatter against log sigma over bins of equal size; 1 unless it differs
    by three standard deviations, and where all sigmas are much the same.
    """
    bins = min(_SCATTER_BINS, len(sigma) // _LEAST_PER_BIN)
    if bins < 3:
        return 1.0
    size = len(sigma) // bins
    order = np.argsort(sigma, kind="stable")[: bins * size].reshape(bins, size)
    x = np.log(sigma[order]).mean(axis=1)
    x = x - x.mean()
    if float(np.ptp(x)) < 0.2:
        return 1.0
    scatter = np.array([mad_sigma(standardised[row], centred=True) for row in order])
    slope = float(x @ np.log(np.maximum(scatter, 1e-12)) / (x @ x))
    # A median absolute deviation of n normal numbers has a relative standard deviation of 1.17 / sqrt(n).
    doubt = 1.17 / np.sqrt(size * float(x @ x))
    return float(np.clip(1.0 + slope, 0.0, 2.0)) if abs(slope) > _SURE_GROWTH * doubt else 1.0
