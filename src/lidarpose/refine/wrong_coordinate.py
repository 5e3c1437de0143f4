"""Whether the world coordinates of one place alone are wrong, where all were taken to be uncertain alike.

Normal errors, as large as restricted maximum likelihood finds them, are the wrong model of one slip of the tape: the
pose follows a place far from the others, and the residuals stay small. For each place in turn its coordinates are left
free and all others taken for exact; the likelihoods say which is the case (the mean-shift model of outliers, Cook and
Weisberg, Residuals and Influence in Regression, 1982), and the covariance holds where the pose would be.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.refine.corner_model import CornerFit, without_world_noise

# Twice the log likelihood ratio at which one wrong place is believed in, as the world's noise is.
CONVINCING_GAIN = 9.0


@dataclass(frozen=True, eq=False)
class WrongCoordinate:
    """The place whose world coordinates are wrong, if one's are.

    Attributes
    ----------
    place
        Its number among those of the estimate.
    off_m
        By how much, if all others are exact.
    also
        Other places that explain as much, nearly, and by how much theirs are then off.
    gain
        Twice the log likelihood that this gains against errors of all places.
    covariance : (n, n)
        How far the joint estimate's parameters are then off, weighted by how likely each place is.
    """

    place: int
    off_m: float
    gain: float
    covariance: FloatArray
    also: tuple[tuple[int, float], ...] = ()

    @property
    def told(self) -> bool:
        """Whether the data speak for it."""
        return self.gain > CONVINCING_GAIN


def wrong_coordinate(fit: CornerFit) -> WrongCoordinate | None:
    """The place that explains the misfit of the world's coordinates best; None where they fit or too few are there.

    Three places leave as many residuals as one of them has coordinates, and any of the three explains them.
    """
    count = len(fit.world)
    if fit.world_sigma_m <= 0.0 or count < 4:
        return None
    information, gradient, errors = without_world_noise(fit)
    solved = np.linalg.solve(
        information[:errors, :errors], np.column_stack([information[:errors, errors:], gradient[:errors]])
    )
    own = information[errors:, errors:] - information[errors:, :errors] @ solved[:, :-1]
    pull = gradient[errors:] - information[errors:, :errors] @ solved[:, -1]
    gains, moves = np.zeros(count), np.zeros((count, len(gradient)))
    for k in range(count):
        mine = slice(3 * k, 3 * k + 3)
        gains[k] = _gain(own[mine, mine], pull[mine])
        # A place that lacks a face does not tell all of its coordinates.
        off = np.linalg.pinv(own[mine, mine], rcond=1e-9, hermitian=True) @ pull[mine]
        moves[k, :errors] = solved[:, -1] - solved[:, mine] @ off
        moves[k, errors:] = -fit.state.world_errors.ravel()
        moves[k, errors:][mine] += off
    common = _gain(own, pull)
    # One slip at any of the places is taken to be as likely beforehand as noise at all.
    odds = np.exp(np.clip(0.5 * (gains - common), -50.0, 50.0)) / count
    chance = odds / (1.0 + odds.sum())
    order = np.argsort(-gains)
    best = int(order[0])
    off_m = np.linalg.norm((moves[:, errors:] + fit.state.world_errors.ravel()).reshape(count, count, 3), axis=2)
    also = tuple((int(k), float(off_m[k, k])) for k in order[1:] if gains[best] - gains[k] < CONVINCING_GAIN)
    covariance = np.asarray((moves.T * chance) @ moves)
    return WrongCoordinate(best, float(off_m[best, best]), float(gains[best] - common), covariance, also)


def unsure_noise(fit: CornerFit) -> FloatArray:
    """What to add to the covariance (n, n) where the world's noise was estimated from the misfit itself.

    Errors over a standard deviation from few degrees of freedom are Student's: of ``f / (f - 2)`` times the variance.
    """
    freedom = 3.0 * len(fit.world) - (7.0 if "log_scale" in fit.names else 6.0)
    return np.asarray(2.0 / max(freedom - 2.0, 0.5) * fit.covariance)


def _gain(information: FloatArray, pull: FloatArray) -> float:
    """Twice the log likelihood that errors gain, of the standard deviation that gains most."""
    sureness, axes = np.linalg.eigh(0.5 * (information + information.T))
    along = (axes.T @ pull) ** 2
    variance = np.geomspace(1e-5, 0.5, 60)[:, None] ** 2
    grown = 1.0 + variance * np.maximum(sureness, 0.0)
    return float(np.max((variance * along / grown - np.log(grown)).sum(axis=1)))
