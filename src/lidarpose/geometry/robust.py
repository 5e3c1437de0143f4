"""Robust statistics, and fits that tell their inliers."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import BoolArray, FloatArray

# Makes the median absolute deviation of a normal distribution its standard deviation.
MAD_TO_SIGMA = 1.4826022185056018
# Of fewer values the median is found soonest in one call.
FEW_VALUES = 600


def mad_sigma(values: ArrayLike, *, centred: bool = False, near: float | None = None) -> float:
    """Robust standard deviation (median absolute deviation); with `centred`, about zero. NaN if empty.

    A guess of it, `near`, finds it sooner.
    """
    x = np.asarray(values, dtype=np.float64)
    if x.size == 0:
        return float("nan")
    deviation = np.abs(x if centred else x - median(x))
    return MAD_TO_SIGMA * (median(deviation) if near is None else median_near(deviation, near / MAD_TO_SIGMA))


def median_near(values: FloatArray, guess: float) -> float:
    """The median of values (N,), found sooner if it lies within a tenth of a guess."""
    n = values.size
    if n < FEW_VALUES:
        return median(values)
    low, high = 0.9 * guess, 1.1 * guess
    below = np.count_nonzero(values < low)
    close = values[(values >= low) & (values < high)]
    k = n // 2 - below
    # Else it lies elsewhere, or some value is NaN, which is below nothing and above nothing.
    if not 0 < k < close.size or below + close.size + np.count_nonzero(values >= high) != n:
        return median(values)
    ordered = np.partition(close, k)
    return float(ordered[k]) if n % 2 else 0.5 * float(ordered[:k].max() + ordered[k])


def median(values: FloatArray) -> float:
    """As numpy's, of all values, at a fraction of its overhead; NaN where a value is."""
    n = values.size
    k = n // 2
    # NaN sorts last. About one place NumPy divides with vector instructions, about several without.
    if n < FEW_VALUES:
        ordered = np.partition(values, [(n - 1) // 2, k, n - 1], axis=None)
        low, last = ordered[(n - 1) // 2], ordered[-1]
    else:
        ordered = np.partition(values, k, axis=None)
        low, last = ordered[k] if n % 2 else ordered[:k].max(), ordered[k:].max()
    return float("nan") if np.isnan(last) else 0.5 * float(low + ordered[k])


def medians(values: FloatArray, axis: int) -> FloatArray:
    """As numpy's along an axis, of values none of which is NaN, without numpy.ma, which numpy's own imports."""
    n = values.shape[axis]
    middle = np.take(np.sort(values, axis=axis), [(n - 1) // 2, n // 2], axis=axis)
    return np.asarray(0.5 * middle.sum(axis=axis))


def quantile(values: FloatArray, share: float) -> float:
    """As numpy's, of all values (one or more, none of them NaN), at a fraction of its overhead."""
    at = share * (values.size - 1)
    k = int(at)
    ordered = np.partition(values, [k, min(k + 1, values.size - 1)], axis=None)
    low, high, part = float(ordered[k]), float(ordered[min(k + 1, values.size - 1)]), at - k
    return low + (high - low) * part if part < 0.5 else high - (high - low) * (1.0 - part)


def row_medians(values: FloatArray, there: BoolArray) -> FloatArray:
    """Median (L,) of those values (L, N) of each row that are there; NaN for a row without any."""
    count = np.count_nonzero(there, axis=1)
    if values.shape[1] == 0:
        return np.full(len(values), np.nan)
    ordered = np.sort(np.where(there, values, np.inf), axis=1)
    low, high = np.maximum(count - 1, 0) // 2, np.minimum(count // 2, values.shape[1] - 1)
    rows = np.arange(len(values))
    return np.asarray(np.where(count > 0, 0.5 * (ordered[rows, low] + ordered[rows, high]), np.nan))


def chi2_tail(chi2: float, freedom: float) -> float:
    """Probability of a chi-squared of `freedom` > 0 degrees above `chi2`.

    The incomplete gamma function's series and continued fraction (Abramowitz and Stegun, 6.5.29 and 6.5.31).
    """
    a, x = 0.5 * freedom, 0.5 * chi2
    if x <= 0.0:
        return 1.0
    factor = math.exp(a * math.log(x) - x - math.lgamma(a))
    if x < a + 1.0:
        term = total = 1.0 / a
        k = a
        while term > 1e-16 * total:
            k += 1.0
            term *= x / k
            total += term
        return 1.0 - factor * total
    # Lentz's method; the fraction's terms fall from the first on.
    b = x + 1.0 - a
    c, d = 1e300, 1.0 / b
    value = d
    for k in range(1, 10_000):
        numerator = k * (a - k)
        b += 2.0
        d = 1.0 / (numerator * d + b)
        c = b + numerator / c
        value *= c * d
        if abs(c * d - 1.0) < 1e-15:
            break
    return factor * value


def huber_weights(standardised: ArrayLike, k: float = 1.345) -> FloatArray:
    """Weights of Huber's loss for residuals in units of sigma; k = 1.345 keeps 95 % efficiency."""
    r = np.abs(np.asarray(standardised, dtype=np.float64))
    return np.asarray(np.where(r <= k, 1.0, k / np.maximum(r, k)))


def tukey_weights(standardised: ArrayLike, k: float = 4.685) -> FloatArray:
    """Weights of Tukey's biweight for residuals in units of sigma: zero beyond k; 4.685 keeps 95 % efficiency."""
    r = np.asarray(standardised, dtype=np.float64) / k
    return np.asarray(np.where(np.abs(r) < 1.0, (1.0 - r**2) ** 2, 0.0))


def box_plot_inliers(values: ArrayLike, whisker: float = 1.5) -> BoolArray:
    """Which values (N,) lie within Tukey's whiskers (quartiles widened by `whisker` interquartile ranges)."""
    x = np.asarray(values, dtype=np.float64)
    if np.isnan(x).any():
        return np.zeros(len(x), dtype=bool)
    low, high = quantile(x, 0.25), quantile(x, 0.75)
    reach = whisker * (high - low)
    return np.asarray((x >= low - reach) & (x <= high + reach))


class Residuals(Protocol):
    """A model that tells signed or absolute distances of points."""

    def distance(self, points: ArrayLike) -> FloatArray: ...


M = TypeVar("M", bound=Residuals)


@dataclass(frozen=True, eq=False)
class RobustFit(Generic[M]):
    """A model, which points (N,) support it, and their robust spread in the points' unit."""

    model: M
    inliers: BoolArray
    sigma: float


def ransac(
    points: FloatArray,
    fit: Callable[[FloatArray], M],
    sample_size: int,
    threshold: float,
    *,
    seed: int,
    iterations: int = 500,
) -> RobustFit[M]:
    """Random sample consensus with a local optimisation: the model with most points within `threshold`.

    Parameters
    ----------
    points : (N, d)
    fit
        Makes a model from at least `sample_size` points; may raise ValueError for degenerate samples.
    threshold
        In the points' unit.

    Raises
    ------
    ValueError
        If no sample gives a model.

    Source: Fischler and Bolles (1981); the refit of each new best follows Chum, Matas and Kittler (2003).
    """
    rng = np.random.default_rng(seed)
    best: tuple[int, M, BoolArray] | None = None
    for _ in range(iterations):
        try:
            model = fit(points[rng.choice(len(points), sample_size, replace=False)])
        except ValueError:
            continue
        inliers = np.abs(model.distance(points)) <= threshold
        count = int(inliers.sum())
        if best is None or count > best[0]:
            best = _optimise_locally(points, fit, threshold, model, inliers, sample_size)
            if best[0] == len(points):
                break
    if best is None:
        raise ValueError("no sample of the points determines the model")
    _, model, inliers = best
    return RobustFit(model, inliers, mad_sigma(model.distance(points[inliers]), centred=True))


def _optimise_locally(
    points: FloatArray,
    fit: Callable[[FloatArray], M],
    threshold: float,
    model: M,
    inliers: BoolArray,
    sample_size: int,
) -> tuple[int, M, BoolArray]:
    count = int(inliers.sum())
    for _ in range(4):
        if count < sample_size:
            break
        try:
            refined = fit(points[inliers])
        except ValueError:
            break
        again = np.abs(refined.distance(points)) <= threshold
        if int(again.sum()) < count:
            break
        model, stable, inliers = refined, bool(np.array_equal(again, inliers)), again
        count = int(inliers.sum())
        if stable:
            break
    return count, model, inliers
