"""What whole lines are off by: the variance of their shifts and slopes beyond what the scatter of their rows explains.

A stripe's centre pulled by the squares, a plate that is not flat, or a wrong model move all points of a line together.
Hundreds of points then promise a precision that is not there. The part that a line's points share is therefore a random
effect, a shift and a slope a line, whose variance is estimated from how far lines lie from the solution.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, inverse_2x2
from lidarpose.geometry.robust import chi2_tail
from lidarpose.refine.least_squares import determined_effects

LINE_CORE, LINE_REJECT = 25.0, 49.0
"""A line whose shift and slope have a chi-square (two degrees of freedom) above the first loses weight, and all of it
at the second (7 sigma)."""
_MOST_LEFT_OUT = 0.25
_MEDIAN_CHI_SQUARE_2 = 1.3862943611
_SIGNIFICANCE = 0.1
_HYSTERESIS = 0.3
"""Levels at which the variance counts, and is given up again once found. A variance of nearly the lines' own that is
overlooked makes squared errors half as large again as stated; one that is not there and counted, a tenth too small. At
13 degrees of freedom (5 places) a level of 0.2 with `certainty_factor` leaves squared errors at 0.91 to 1.05 of what is
stated, whatever the true variance is; a level of 0.05 alone, at 0.98 to 1.28."""


@dataclass(frozen=True, eq=False)
class PlaceEffects:
    """What whole lines are off by.

    Attributes
    ----------
    variance
        Of lines' shifts and slopes; zero where it is not seen.
    weight : (S,)
        Of each line; 0: it contradicts all others.
    certainty_factor
        By what the lines' variance has to be multiplied since it was estimated from few: a squared error over a
        variance of k degrees of freedom is k / (k - 2) in the mean. 1 where no variance was found.
    """

    variance: float
    weight: FloatArray
    certainty_factor: float = 1.0


@dataclass(frozen=True, eq=False)
class _Standardised:
    """Lines' effects at one variance: inverse covariances as (S,) each of both variances and what lies between them,
    squared standardised effects (S,), and degrees of freedom (S,)."""

    inverse: tuple[FloatArray, FloatArray, FloatArray]
    square: FloatArray
    freedom: FloatArray


@dataclass(frozen=True, eq=False)
class _Effects:
    """Each line's own least-squares shift and slope: values (S, 2), their covariance (S, 2, 2) from the rows' scatter,
    and the part of the covariance that the parameters have absorbed (S, 2, 2)."""

    own: FloatArray
    covariance: FloatArray
    absorbed: FloatArray

    def standardised(self, variance: float) -> _Standardised:
        # Two by two: written out, a fraction of what NumPy's own calls take.
        C, A, (x, y) = self.covariance, self.absorbed, self.own.T
        first, second, both = C[:, 0, 0] + variance, C[:, 1, 1] + variance, 0.5 * (C[:, 0, 1] + C[:, 1, 0])
        det = first * second - both * both
        p, q, r = second / det, first / det, -both / det
        square = p * x * x + 2.0 * r * x * y + q * y * y
        taken = p * A[:, 0, 0] + r * (A[:, 0, 1] + A[:, 1, 0]) + q * A[:, 1, 1]
        return _Standardised((p, q, r), square, np.maximum(2.0 - taken, 0.0))


def place_effects(moments: FloatArray, spread: FloatArray, before: float = 0.0) -> PlaceEffects:
    """The variance of lines' shifts and slopes, and a weight for each line.

    Parameters
    ----------
    moments : (S, b + 3, b + 3)
        Of `line_moments`.
    spread : (S, b, b)
        Covariance of the basis' coefficients, from the parameters' uncertainty.
    before
        The variance at the last step.

    Fisher scoring of the restricted likelihood, with what the parameters absorbed taken as shared out evenly between
    shift and slope. Zero unless it is significant; once found it is given up at a higher level only, or steps would go
    on and off for ever.
    """
    effects, good = _effects(moments, spread)
    if good.sum() < 3:
        return PlaceEffects(0.0, np.ones(len(moments)))
    without = effects.standardised(0.0)
    variance = _robust_start(effects, good, without)
    at = effects.standardised(variance)
    weight = _line_weights(at, good)
    for _ in range(30):
        new = max(variance + _scoring_step(effects, weight * good, at), 0.0)
        settled = abs(new - variance) <= 1e-4 * max(variance, 1e-300)
        variance, at = new, effects.standardised(new)
        weight = _line_weights(at, good)
        if settled or variance == 0.0:
            break
    level = _SIGNIFICANCE if before == 0.0 else _HYSTERESIS
    if not _significant(without, good & (weight > 0.5), level):
        return PlaceEffects(0.0, _line_weights(without, good))
    if variance == 0.0:
        return PlaceEffects(0.0, weight)
    freedom = float((weight * good) @ at.freedom)
    return PlaceEffects(variance, weight, freedom / (freedom - 2.0) if freedom > 3.0 else 3.0)


def _effects(moments: FloatArray, spread: FloatArray) -> tuple[_Effects, BoolArray]:
    size = moments.shape[1]
    inner = moments[:, size - 3 : size - 1, size - 3 : size - 1]
    good = determined_effects(inner)
    covariance = inverse_2x2(np.where(good[:, None, None], inner, np.eye(2)))
    coupling = covariance @ moments[:, size - 3 : size - 1, :]
    to_parameters = coupling[:, :, : size - 3]
    absorbed = to_parameters @ spread @ np.swapaxes(to_parameters, 1, 2)
    return _Effects(coupling[:, :, -1], covariance, absorbed), good


def _robust_start(effects: _Effects, good: BoolArray, without: _Standardised) -> float:
    """From the median of the squared standardised effects, which pure noise puts at that of chi-square of 2."""
    ratio = float(np.median(without.square[good])) / _MEDIAN_CHI_SQUARE_2
    size = float(np.median(np.trace(effects.covariance[good], axis1=1, axis2=2))) / 2.0
    return max(ratio - 1.0, 0.0) * size


def _line_weights(at: _Standardised, good: BoolArray) -> FloatArray:
    """Weights (S,), below 1 for lines that contradict all others; at most a quarter can be the odd ones out."""
    root = (np.sqrt(at.square) - np.sqrt(LINE_CORE)) / (np.sqrt(LINE_REJECT) - np.sqrt(LINE_CORE))
    weight = np.where(good, 0.5 * (1.0 + np.cos(np.pi * np.clip(root, 0.0, 1.0))), 1.0)
    if (weight < 0.5).sum() > max(int(_MOST_LEFT_OUT * good.sum()), 1):
        return np.ones(len(weight))
    return np.asarray(weight)


def _scoring_step(effects: _Effects, weight: FloatArray, at: _Standardised) -> float:
    (p, q, r), (x, y) = at.inverse, effects.own.T
    found = float(weight @ ((p * x + r * y) ** 2 + (r * x + q * y) ** 2))
    expected = float(weight @ ((p + q) * at.freedom / 2.0))
    fisher = float(weight @ (p * p + 2.0 * r * r + q * q))
    return (found - expected) / max(fisher, 1e-300)


def _significant(without: _Standardised, use: BoolArray, level: float) -> bool:
    freedom = max(float(without.freedom[use].sum()), 1.0)
    return bool(chi2_tail(float(without.square[use].sum()), freedom) < level)
