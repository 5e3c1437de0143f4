"""Means and covariances of a posterior by sampling: for likelihoods that may be flat with steep walls."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from lidarpose.geometry.arrays import FloatArray

LogDensity = Callable[[FloatArray], FloatArray]
"""Log-density (k,), up to a constant, of points (k, d); -inf outside its bounds."""

WALKERS = 32
_TEMPERATURES = np.geomspace(60.0, 1.0, 50)
_SETTLE = 60
_STEPS = 200
_DRAWS, _FREEDOM = 4000, 5.0


def anneal(log_density: LogDensity, walkers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Walkers (k, d) cooled down from a flattened density, so that none stays behind in a side valley."""
    value = log_density(walkers)
    for temperature in _TEMPERATURES:
        walkers, value = _stretch(log_density, walkers, value, float(temperature), rng)
    return walkers


def sample(log_density: LogDensity, walkers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples (n, d) of a density, from walkers (k, d) that are about where it is high."""
    value = log_density(walkers)
    kept = []
    for step in range(_SETTLE + _STEPS):
        walkers, value = _stretch(log_density, walkers, value, 1.0, rng)
        if step >= _SETTLE:
            kept.append(walkers.copy())
    return np.concatenate(kept)


def sample_about(
    log_density: LogDensity, top: FloatArray, covariance: FloatArray, rng: np.random.Generator
) -> FloatArray | None:
    """Samples (n, d) of a density with one smooth top, from its fitted normal distribution; None if that fits badly.

    Importance sampling from Student's t about the top, whose tails cover those of the density. Fits badly: the weights
    leave less than a tenth of the draws.
    """
    d = len(top)
    try:
        root = np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        return None
    z = rng.normal(size=(_DRAWS, d))
    stretch = np.sqrt(_FREEDOM / rng.chisquare(_FREEDOM, (_DRAWS, 1)))
    drawn = top + (stretch * z) @ root.T
    value = log_density(drawn)
    log_t = -0.5 * (_FREEDOM + d) * np.log1p(((stretch * z) ** 2).sum(axis=1) / _FREEDOM)
    log_weight = value - log_t
    if not np.isfinite(log_weight).any():
        return None
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    if 1.0 / float((weight**2).sum()) < 0.1 * _DRAWS:
        return None
    # Systematic resampling: each draw as often as its weight says, to within one.
    places = (np.arange(_DRAWS) + rng.uniform()) / _DRAWS
    return drawn[np.minimum(np.searchsorted(np.cumsum(weight), places), _DRAWS - 1)]


def _stretch(
    log_density: LogDensity, walkers: FloatArray, value: FloatArray, temperature: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """One stretch move of all walkers (Goodman and Weare, 2010), which knows no scales to tune."""
    k, d = walkers.shape
    walkers, value = walkers.copy(), value.copy()
    halves = np.array_split(rng.permutation(k), 2)
    for mine, others in (halves, halves[::-1]):
        partner = walkers[others[rng.integers(0, len(others), len(mine))]]
        z = (1.0 + rng.uniform(size=len(mine))) ** 2 / 2.0
        trial = partner + z[:, None] * (walkers[mine] - partner)
        trial_value = log_density(trial)
        gain = np.where(np.isneginf(trial_value), -np.inf, trial_value - value[mine])
        accept = np.log(rng.uniform(size=len(mine))) < (d - 1) * np.log(z) + gain / temperature
        walkers[mine[accept]], value[mine[accept]] = trial[accept], trial_value[accept]
    return walkers, value


def climb(log_density: LogDensity, walkers: FloatArray) -> tuple[FloatArray, float, FloatArray | None]:
    """The top (d,) of a density by damped Newton steps from the best walker, its value, and the covariance (d, d).

    The covariance is None where the density has no smooth top.
    """
    value = log_density(walkers)
    top, best = walkers[int(np.argmax(value))], float(np.max(value))
    scale = np.maximum(walkers.std(axis=0), 1e-12)
    damping = np.array([0.0, 0.01, 0.1, 1.0, 10.0, 100.0, 1e3])
    for _ in range(40):
        gradient, hessian = _derivatives(log_density, top, 0.1 * scale)
        if not (np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))):
            return top, best, None
        values, vectors = np.linalg.eigh(-hessian)
        # Curvature of either sign bounds the step: uphill along every axis (saddle-free Newton).
        curvature = np.maximum(np.abs(values), 1e-3)[:, None] + damping * max(float(np.abs(values).max()), 1e-3)
        steps = vectors @ ((vectors.T @ gradient)[:, None] / curvature)
        trials = top + scale * steps.T
        trial_values = log_density(trials)
        winner = int(np.argmax(trial_values))
        gain = float(trial_values[winner]) - best
        # Steps of differences follow the width of the top: exact enough, and not lost in rounding.
        width = np.sqrt(np.clip((vectors**2 / np.maximum(np.abs(values), 1e-3)).sum(axis=1), 1e-2, 25.0))
        if gain > 0.0:
            top, best = trials[winner], float(trial_values[winner])
        if gain < 1e-2 and float(np.abs(width - 1.0).max()) < 0.5:
            break
        scale = scale * width
    gradient, hessian = _derivatives(log_density, top, 0.1 * scale)
    if not np.all(np.isfinite(hessian)):
        return top, best, None
    values, vectors = np.linalg.eigh(-hessian)
    if values[0] <= 0.0:
        return top, best, None
    return top, best, (vectors / values @ vectors.T) * np.outer(scale, scale)


def scatter_about(
    log_density: LogDensity,
    top: FloatArray,
    best: float,
    covariance: FloatArray | None,
    walkers: FloatArray,
    rng: np.random.Generator,
) -> FloatArray:
    """Walkers drawn from the normal distribution that fits the top; the given ones where it does not fit the density.

    Where ridges are long it takes walkers many steps to spread along them; this spares the steps.
    """
    if covariance is None:
        return walkers
    drawn = rng.multivariate_normal(top, covariance, size=6 * len(walkers), method="eigh")
    drop = best - log_density(drawn)
    # Samples of a normal distribution lie half of its dimension below its top, on the average.
    good = drawn[drop < 1.5 * len(top) + 4.0]
    return good[: len(walkers)] if len(good) >= len(walkers) else walkers


def _derivatives(log_density: LogDensity, top: FloatArray, h: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Gradient (d,) and Hessian (d, d) by central differences, in units of h / 0.1."""
    d = len(top)
    unit = np.eye(d)
    i, j = np.triu_indices(d, 1)
    pairs = unit[i] + unit[j]
    values = log_density(top + h * np.concatenate([np.zeros((1, d)), unit, -unit, pairs, -pairs]))
    if not np.all(np.isfinite(values)):
        return np.full(d, np.nan), np.full((d, d), np.nan)
    middle, plus, minus = values[0], values[1 : d + 1], values[d + 1 : 2 * d + 1]
    both = values[2 * d + 1 :].reshape(2, -1).sum(axis=0)
    second = plus + minus - 2.0 * middle
    hessian = np.diag(second)
    hessian[i, j] = hessian[j, i] = 0.5 * (both - 2.0 * middle - second[i] - second[j])
    return (plus - minus) / 0.2, hessian / 0.1**2
