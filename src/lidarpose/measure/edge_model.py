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
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from lidarpose.geometry.arrays import BoolArray, FloatArray

# Spot widths (standard deviations) that the prior allows, metres.
SMALLEST_SPOT_M, LARGEST_SPOT_M = 4e-5, 1e-2
_SMALLEST_SCATTER, _LARGEST_SCATTER = 1e-5, 2.0
_OUTLIERS = 0.01
# Softness of the edge of what is detected, in distances between beams.
_SOFTNESS = 0.02
# The prior of the spot: its median as a standard deviation (2 mm across), and its spread as a logarithm.
_USUAL_SPOT_M, _SPOT_SPREAD = 5e-4, 0.6


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
        True where only a hit or a miss is known: nothing behind the edge returns, or the instrument never mixes.
        There a depth of 0 is a hit.
    light : (n,) or None
        Light of the open hits, relative to that of a spot wholly on the material; None where it tells nothing.
    light_sigma
        Its noise.
    """

    place: FloatArray
    slope: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray
    open: BoolArray
    light: FloatArray | None = None
    light_sigma: float = 1.0

    def __len__(self) -> int:
        return len(self.place)

    def at(self, mask: BoolArray) -> EdgeBeams:
        """Some of the beams."""
        return replace(
            self,
            place=self.place[mask],
            slope=self.slope[mask],
            depth=self.depth[mask],
            depth_sigma=self.depth_sigma[mask],
            open=self.open[mask],
            light=None if self.light is None else self.light[mask],
        )


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
    """Distances (..., n) outside the circle, and by what factor (..., n) the spot is drawn out across the edge.

    `centre` is (..., 2), `radius` (...).
    """
    offset = beams.place - np.asarray(centre)[..., None, :]
    length = np.maximum(np.linalg.norm(offset, axis=-1), 1e-12)
    along = (offset * beams.slope).sum(axis=-1) / length
    # A round beam cut at an angle: variance 1 + (e.d)^2 / (n.d)^2 along the unit direction e in the plane.
    stretch = np.sqrt(1.0 + along**2 / (1.0 - (beams.slope**2).sum(axis=-1)))
    return length - np.asarray(radius)[..., None], stretch


@dataclass(frozen=True, eq=False)
class _Sorted:
    """Edge beams in the order: bounded with and without return, open with and without return; counts of each."""

    place: FloatArray
    stretch: FloatArray
    depth: FloatArray
    near_variance: FloatArray
    far_variance: FloatArray
    ends: tuple[int, int, int]
    light: FloatArray | None
    light_sigma: float
    softness: float


def _sorted(beams: EdgeBeams, centre: FloatArray, reach: float) -> _Sorted:
    has_return = np.isfinite(beams.depth)
    group = 2 * beams.open.astype(int) + (~has_return).astype(int)
    order = np.argsort(group, kind="stable")
    bounds = np.cumsum(np.bincount(group, minlength=4))
    # How the spot is drawn out changes so little with the centre that the first estimate is enough.
    _, stretch = signed_distance(beams, centre, 1.0)
    kept = order[: bounds[0]]
    return _Sorted(
        beams.place[order],
        stretch[order],
        beams.depth[kept],
        beams.depth_sigma[kept, 0] ** 2,
        beams.depth_sigma[kept, 1] ** 2,
        (int(bounds[0]), int(bounds[1]), int(bounds[2])),
        None if beams.light is None else beams.light[order[bounds[1] : bounds[2]]],
        beams.light_sigma,
        _SOFTNESS * reach,
    )


def _log_likelihood(x: FloatArray, data: _Sorted, inside: bool, dropout: float) -> FloatArray:
    """Log-likelihood (k,) of parameters (k, 7): centre x, y, radius, log spot, log scatter, lost, threshold."""
    radius, spot = x[:, 2, None], np.exp(x[:, 3, None])
    scatter, lost = np.exp(x[:, 4, None]), x[:, 5, None]
    s = np.hypot(data.place[:, 0] - x[:, 0, None], data.place[:, 1] - x[:, 1, None]) - radius
    # Of a spot centred on the edge of a disk less than half is on it, by the sagitta of the arc.
    u = (s + 0.5 * spot**2 / radius) / (spot * data.stretch)
    F = ndtr(-u if inside else u)
    a, b, c = data.ends
    share = F[:, :a]
    mixed = share * (1.0 - share)
    variance = share * data.near_variance + (1.0 - share) * data.far_variance + scatter * mixed
    normal = np.exp(-0.5 * (data.depth - 1.0 + share) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    kept = 1.0 - np.minimum(dropout + (1.0 - dropout) * lost * 4.0 * mixed, 1.0 - 1e-9)
    # An outlier may lie anywhere between material and background, and a little beyond.
    total = np.log(kept * ((1.0 - _OUTLIERS) * normal + _OUTLIERS / 1.5)).sum(axis=1)
    if b > a:
        none = F[:, a:b]
        total += np.log(dropout + (1.0 - dropout) * lost * 4.0 * none * (1.0 - none) + 1e-9).sum(axis=1)
    if len(data.place) > b:
        # Seen where the share passes an unknown threshold: a sharp edge, displaced by a part of the spot.
        past = (s[:, b:] + x[:, 6, None] * spot * data.stretch[b:]) / data.softness
        seen = (1.0 - dropout) * ndtr(-past if inside else past) * (1.0 - 2.0 * _OUTLIERS) + _OUTLIERS
        total += np.log(seen[:, : c - b]).sum(axis=1) + np.log1p(-seen[:, c - b :]).sum(axis=1)
        if data.light is not None:
            total += _log_light(data.light, F[:, b:c], scatter, data.light_sigma).sum(axis=1)
    return np.asarray(total)


def _log_light(light: FloatArray, share: FloatArray, scatter: FloatArray, sigma: float) -> FloatArray:
    """Log-density (k, n) of the light of hits, which is the share of the spot on the material."""
    variance = sigma**2 + scatter * share * (1.0 - share)
    normal = np.exp(-0.5 * (light - share) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    known = np.log((1.0 - _OUTLIERS) * normal + _OUTLIERS / 1.5)
    return np.where(np.isfinite(light), known, 0.0)


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

    log_posterior = _posterior(beams, centre, radius, inside, dropout, reach)
    rng = np.random.default_rng(seed)
    walkers = _anneal(log_posterior, _start(centre, radius, reach, rng), rng)
    # Beams far from the edge, in widths of the spot, say nothing more.
    spot = float(np.exp(walkers[:, 3].max()))
    s, stretch = signed_distance(beams, walkers[:, :2].mean(axis=0), float(walkers[:, 2].mean()))
    near = beams.at(np.abs(s) < 6.0 * spot * stretch + 1.5 * reach)
    log_posterior = _posterior(near, centre, radius, inside, dropout, reach)
    samples = _sample(log_posterior, walkers, rng)
    mean = samples[:, :3].mean(axis=0)
    covariance = np.cov(samples[:, :3].T)
    if not tells_threshold(beams):
        # Sampling a ridge that the prior alone bounds is slow; its variance is known: that of threshold times spot.
        covariance[2, 2] += _USUAL_SPOT_M**2 * np.exp(2.0 * _SPOT_SPREAD**2) * float(np.mean(stretch**2))
    spot, scatter = np.exp(np.median(samples[:, 3:5], axis=0))
    return EdgeFit(mean[:2], float(mean[2]), covariance, float(spot), float(scatter), float(np.median(samples[:, 5])))


LogDensity = Callable[[FloatArray], FloatArray]


def tells_threshold(beams: EdgeBeams) -> bool:
    """True if anything tells where the threshold of detection lies in the spot: mixed ranges, or the light of hits."""
    return bool(np.any(~beams.open)) or beams.light is not None


def _posterior(
    beams: EdgeBeams, centre: FloatArray, radius: float, inside: bool, dropout: float, reach: float
) -> LogDensity:
    """Log posterior density (k,) of parameters (k, 7), up to a constant.

    The prior is even within bounds; for the spot it prefers, weakly, what 2D LiDARs have at a few metres, and for the
    threshold of detection one half. Both matter only where the data say nothing of them.
    """
    data = _sorted(beams, centre, reach)
    threshold_sigma = 1.0 if tells_threshold(beams) else 1e-3
    low = np.log([SMALLEST_SPOT_M, _SMALLEST_SCATTER])
    high = np.log([LARGEST_SPOT_M, _LARGEST_SCATTER])

    def density(x: FloatArray) -> FloatArray:
        ok = ((x[:, 3:5] > low) & (x[:, 3:5] < high)).all(axis=1) & (x[:, 5] >= 0.0) & (x[:, 5] <= 1.0)
        ok &= np.abs(x[:, 2] - radius) < 0.5 * radius
        value = np.full(len(x), -np.inf)
        if ok.any():
            prior = -0.5 * ((x[ok, 3] - np.log(_USUAL_SPOT_M)) / _SPOT_SPREAD) ** 2
            prior -= 0.5 * (x[ok, 6] / threshold_sigma) ** 2
            value[ok] = _log_likelihood(x[ok], data, inside, dropout) + prior
        return value

    return density


_WALKERS = 32
_TEMPERATURES = np.geomspace(60.0, 1.0, 90)
_SETTLE = 40
_STEPS = 200


def _start(centre: FloatArray, radius: float, reach: float, rng: np.random.Generator) -> FloatArray:
    """Walkers (k, 7) spread over what the first estimate leaves open."""
    middle = np.array([centre[0], centre[1], radius, np.log(0.4 * reach), np.log(0.03), 0.3, 0.0])
    spread = np.array([0.3 * reach, 0.3 * reach, 0.3 * reach, 0.5, 1.5, 0.15, 0.5])
    walkers = middle + spread * rng.normal(size=(_WALKERS, 7))
    walkers[:, 5] = np.clip(walkers[:, 5], 0.01, 0.99)
    walkers[:, 3] = np.clip(walkers[:, 3], np.log(1.2 * SMALLEST_SPOT_M), np.log(0.8 * LARGEST_SPOT_M))
    walkers[:, 4] = np.clip(walkers[:, 4], np.log(2.0 * _SMALLEST_SCATTER), np.log(0.8 * _LARGEST_SCATTER))
    return walkers


def _anneal(log_density: LogDensity, walkers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Walkers cooled down from a flattened posterior, so that none stays behind in a side valley."""
    value = log_density(walkers)
    for temperature in _TEMPERATURES:
        walkers, value = _stretch(log_density, walkers, value, float(temperature), rng)
    return walkers


def _sample(log_density: LogDensity, walkers: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Samples (n, 7) of the posterior."""
    value = log_density(walkers)
    kept = []
    for step in range(_SETTLE + _STEPS):
        walkers, value = _stretch(log_density, walkers, value, 1.0, rng)
        if step >= _SETTLE:
            kept.append(walkers.copy())
    return np.concatenate(kept)


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
