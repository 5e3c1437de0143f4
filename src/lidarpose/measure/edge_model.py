"""Where a round edge lies, from which beams hit it: a model of the beam at the edge, and its posterior.

A beam's axis meets the plane of the disk at a signed distance s from the circle, known from the beam's direction alone,
so the range noise plays no part in it. Its spot has some width w. The share of the spot on the material,
``F = Phi(-s / w)``, is a half exactly at the edge whatever the width, and that is what makes the diameter free of bias.
What the instrument returns tells F:

- a range between material and background, whose place between the two is 1 - F on the average (mixed pixels). The
  scatter about it, kappa F (1 - F), is a parameter: 0 for instruments that average by energy, 1/3 for ones that return
  anything between, 1 for ones that return either;
- no return near the edge only (mixed pixels dropped): as likely on either side of it;
- no return beyond the edge (no background in reach): the edge of what is seen.

Spot width, scatter and dropping are parameters beside centre and radius, and all are integrated out by sampling the
posterior: without mixed returns the likelihood is a flat box with steep walls (each pair of neighbours brackets the
edge), which has no smooth maximum, and whose middle and width are what is wanted.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtr

from lidarpose.geometry.arrays import BoolArray, FloatArray

# Spot widths (standard deviations) that the prior allows, metres.
SMALLEST_SPOT_M, LARGEST_SPOT_M = 2e-5, 1e-2
_SMALLEST_SCATTER, _LARGEST_SCATTER = 1e-5, 1.0
_OUTLIERS = 0.01


@dataclass(frozen=True, eq=False)
class EdgeBeams:
    """Beams near a round edge.

    Attributes
    ----------
    place : (n, 2)
        Where the beam's axis meets the plane, in the plane's axes, metres.
    slope : (n, 2)
        The unit direction's components along these axes: the spot on the plane is drawn out along them.
    depth : (n,)
        Measured range minus that of the plane, over the background's minus that of the plane; NaN without return.
    depth_sigma : (n, 2)
        Its noise on the material and on the background.
    open : (n,)
        True where nothing behind the edge returns.
    """

    place: FloatArray
    slope: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray
    open: BoolArray

    def __len__(self) -> int:
        return len(self.place)


@dataclass(frozen=True, eq=False)
class EdgeFit:
    """Posterior of a round edge.

    Attributes
    ----------
    centre : (2,)
        In the plane's axes, metres.
    radius : float
    covariance : (3, 3)
        Of centre and radius, m^2.
    spot_m
        Width of the spot as a standard deviation (median), metres.
    scatter
        kappa above (median).
    lost_share
        Share of mixed pixels that are dropped (median).
    """

    centre: FloatArray
    radius: float
    covariance: FloatArray
    spot_m: float
    scatter: float
    lost_share: float


def signed_distance(beams: EdgeBeams, centre: FloatArray, radius: FloatArray | float) -> tuple[FloatArray, FloatArray]:
    """Distances (..., n) outside the circle, and how much longer (..., n) the spot is across the edge than the beam is wide.

    `centre` is (..., 2), `radius` (...).
    """
    offset = beams.place - np.asarray(centre)[..., None, :]
    length = np.maximum(np.linalg.norm(offset, axis=-1), 1e-12)
    along = (offset * beams.slope).sum(axis=-1) / length
    # A round beam cut at an angle: variance 1 + (e.d)^2 / (n.d)^2 along the unit direction e in the plane.
    stretch = np.sqrt(1.0 + along**2 / (1.0 - (beams.slope**2).sum(axis=-1)))
    return length - np.asarray(radius)[..., None], stretch


def log_likelihood(parameters: FloatArray, beams: EdgeBeams, *, inside: bool, dropout: float) -> FloatArray:
    """Log-likelihood (k,) of parameters (k, 6): centre x, y, radius, log spot width, log scatter, share of mixed lost.

    Parameters
    ----------
    inside
        True if the material is inside the circle (a disk), False if outside (a hole).
    dropout
        Share of beams that return nothing anywhere.
    """
    radius = parameters[:, 2]
    spot, scatter, lost = np.exp(parameters[:, 3, None]), np.exp(parameters[:, 4, None]), parameters[:, 5, None]
    s, stretch = signed_distance(beams, parameters[:, :2], radius)
    # Of a spot centred on the edge of a disk less than half is on it, by the sagitta of the arc.
    width = spot * stretch
    u = (s + 0.5 * spot**2 / radius[:, None]) / width
    F = ndtr(-u if inside else u)
    has_return = np.isfinite(beams.depth)
    bounded = ~beams.open
    total = np.zeros(len(parameters))
    some = bounded & has_return
    total += _log_depth(beams.depth[some], beams.depth_sigma[some], F[:, some], scatter).sum(axis=1)
    drop = np.clip(dropout + (1.0 - dropout) * lost * 4.0 * F * (1.0 - F), 1e-9, 1.0 - 1e-9)
    total += np.log1p(-drop[:, some]).sum(axis=1) + np.log(drop[:, bounded & ~has_return]).sum(axis=1)
    seen = (1.0 - dropout) * F * (1.0 - 2.0 * _OUTLIERS) + _OUTLIERS
    total += np.log(seen[:, beams.open & has_return]).sum(axis=1)
    total += np.log1p(-seen[:, beams.open & ~has_return]).sum(axis=1)
    return np.asarray(total)


def _log_depth(depth: FloatArray, sigma: FloatArray, F: FloatArray, scatter: FloatArray) -> FloatArray:
    variance = F * sigma[:, 0] ** 2 + (1.0 - F) * sigma[:, 1] ** 2 + scatter * F * (1.0 - F)
    normal = np.exp(-0.5 * (depth - (1.0 - F)) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    # An outlier may lie anywhere between and a little beyond.
    return np.asarray(np.log((1.0 - _OUTLIERS) * normal + _OUTLIERS / 1.5))


def fit_edge(
    beams: EdgeBeams,
    centre: FloatArray,
    radius: float,
    *,
    inside: bool,
    dropout: float,
    reach: float,
    seed: int = 0,
) -> EdgeFit:
    """Posterior mean and covariance of a round edge.

    Parameters
    ----------
    centre, radius
        A first estimate, to within `reach`.
    reach
        How far the first estimate may be off, metres; also about the distance between beams.
    """

    def log_posterior(x: FloatArray) -> FloatArray:
        low = np.log([SMALLEST_SPOT_M, _SMALLEST_SCATTER])
        high = np.log([LARGEST_SPOT_M, _LARGEST_SCATTER])
        ok = ((x[:, 3:5] > low) & (x[:, 3:5] < high)).all(axis=1) & (x[:, 5] >= 0.0) & (x[:, 5] <= 1.0)
        ok &= np.abs(x[:, 2] - radius) < 0.5 * radius
        value = np.full(len(x), -np.inf)
        if ok.any():
            value[ok] = log_likelihood(x[ok], beams, inside=inside, dropout=dropout)
        return value

    rng = np.random.default_rng(seed)
    start = _search(log_posterior, centre, radius, reach, rng)
    samples = _sample(log_posterior, start, rng)
    mean = samples[:, :3].mean(axis=0)
    covariance = np.cov(samples[:, :3].T)
    spot, scatter = np.exp(np.median(samples[:, 3:5], axis=0))
    return EdgeFit(mean[:2], float(mean[2]), covariance, float(spot), float(scatter), float(np.median(samples[:, 5])))


_WALKERS = 24
_STEPS = 420
_BURN = 180


def _search(
    log_posterior: Callable[[FloatArray], FloatArray],
    centre: FloatArray,
    radius: float,
    reach: float,
    rng: np.random.Generator,
) -> FloatArray:
    """Walkers (k, 6) where the posterior is high: the best of many random starts, drawn closer round by round."""
    middle = np.array([centre[0], centre[1], radius, np.log(0.4 * reach), np.log(0.03), 0.2])
    spread = np.array([0.5 * reach, 0.5 * reach, 0.5 * reach, 0.8, 2.0, 0.3])
    best = np.zeros((0, 6))
    value = np.zeros(0)
    for _ in range(12):
        trial = middle + spread * rng.normal(size=(160, 6))
        trial[:, 5] = np.clip(trial[:, 5], 0.0, 1.0)
        best, value = np.vstack([best, trial]), np.concatenate([value, log_posterior(trial)])
        order = np.argsort(-value, kind="stable")[:_WALKERS]
        best, value = best[order], value[order]
        middle = best.mean(axis=0)
        spread = np.maximum(1.2 * best.std(axis=0), np.array([1e-6, 1e-6, 1e-6, 0.05, 0.1, 0.02]))
    return best


def _sample(
    log_posterior: Callable[[FloatArray], FloatArray], walkers: FloatArray, rng: np.random.Generator
) -> FloatArray:
    """Samples of the posterior by the stretch move of Goodman and Weare (2010), which knows no scales to tune."""
    k, d = walkers.shape
    x = walkers + 1e-7 * rng.normal(size=walkers.shape)
    value = log_posterior(x)
    kept = []
    for step in range(_STEPS):
        for half in (np.arange(k) < k // 2, np.arange(k) >= k // 2):
            others = x[~half][rng.integers(0, k // 2, k // 2)]
            z = (1.0 + rng.uniform(size=k // 2)) ** 2 / 2.0
            trial = others + z[:, None] * (x[half] - others)
            trial_value = log_posterior(trial)
            with np.errstate(invalid="ignore"):
                accept = np.log(rng.uniform(size=k // 2)) < (d - 1) * np.log(z) + trial_value - value[half]
            index = np.flatnonzero(half)[accept]
            x[index], value[index] = trial[accept], trial_value[accept]
        if step >= _BURN:
            kept.append(x.copy())
    return np.concatenate(kept)
