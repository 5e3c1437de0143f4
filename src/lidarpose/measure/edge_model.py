"""Where a round edge lies, from which beams hit it: a model of the beam at the edge, and its posterior.

A beam's axis meets the plane of the disk at a signed distance s from the circle, known from the beam's direction alone,
so the range noise plays no part in it. Its spot has some width w. The share of the spot on the material,
``F = Phi(-s / w)`` for a Gaussian one, is a half exactly at the edge whatever the width, and that is what makes the
diameter free of bias.
What the instrument returns tells F:

- a range between material and background (mixed pixels), whose place between the two is on the average the share of
  the light that comes from the background: 1 - F where both are as bright, k (1 - F) / (F + k (1 - F)) in general. The
  brightness k is a parameter: it skews the way from one to the other, which a shift of the edge does not. The scatter
  about it, kappa F (1 - F), is a parameter too: 0 for instruments that average by energy, 1/3 for ones that return
  anything between, 1 for ones that return either;
- no return near the edge only (mixed pixels dropped): as likely on either side of it;
- no return beyond the edge (no background in reach): the edge of what is seen.

The kind of spot is chosen by the data; its width, scatter and dropping are parameters beside centre and radius, and all
are integrated out by sampling the posterior. Without mixed returns the likelihood is a flat box with steep walls (each
pair of neighbours brackets the edge), which has no smooth maximum, and whose middle and width are what is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.measure.sampling import WALKERS, LogDensity, anneal, climb, sample, scatter_about

# Spot widths (standard deviations) that the prior allows, metres.
SMALLEST_SPOT_M, LARGEST_SPOT_M = 4e-5, 1e-2
_SMALLEST_SCATTER, _LARGEST_SCATTER = 1e-5, 2.0
# Softness of these bounds, as a logarithm.
_WALL = 0.3
_OUTLIERS = 0.01
# Softness of the edge of what is detected, in distances between beams.
_SOFTNESS = 0.02
# The prior of the logarithm of the background's brightness over the material's.
_CONTRAST_SIGMA = 0.7
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
    straight: bool


def _sorted(beams: EdgeBeams, stretch: FloatArray, reach: float, straight: bool) -> _Sorted:
    has_return = np.isfinite(beams.depth)
    group = 2 * beams.open.astype(int) + (~has_return).astype(int)
    order = np.argsort(group, kind="stable")
    bounds = np.cumsum(np.bincount(group, minlength=4))
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
        straight,
    )


def _log_likelihood(x: FloatArray, data: _Sorted, inside: bool, dropout: float) -> FloatArray:
    """Log-likelihood (k,) of parameters (k, 9), in the order of `_USUAL`."""
    radius, spot = x[:, 2, None], np.exp(x[:, 3, None])
    scatter, lost = np.exp(x[:, 4, None]), x[:, 5, None]
    if data.straight:
        s, sagitta = data.place[:, 0] - x[:, 0, None] - x[:, 1, None] * data.place[:, 1], np.zeros_like(spot)
    else:
        s = np.hypot(data.place[:, 0] - x[:, 0, None], data.place[:, 1] - x[:, 1, None]) - radius
        # Of a spot centred on the edge of a disk less than half is on it, by the sagitta of the arc.
        sagitta = 0.5 * spot**2 / radius
    u = (s + sagitta) / (spot * data.stretch)
    F = _share(-u if inside else u, x[:, 8, None])
    a, b, c = data.ends
    # Light weighs the two ranges: a background k times as bright as the material pulls the mean its way.
    share = F[:, :a] / (F[:, :a] + np.exp(x[:, 7, None]) * (1.0 - F[:, :a]))
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


def _share(u: FloatArray, evenness: FloatArray) -> FloatArray:
    """Share (k, n) of a spot on one side of a straight edge, at u standard deviations of the spot inside it.

    Between a Gaussian spot (evenness 0) and a disk of even light (1), whose radius is two standard deviations.
    """
    z = np.clip(0.5 * u, -1.0, 1.0)
    disk = 0.5 + (np.arcsin(z) + z * np.sqrt(1.0 - z * z)) / np.pi
    return np.asarray((1.0 - evenness) * ndtr(u) + evenness * disk)


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
    # How the spot is drawn out changes so little with the centre that the first estimate is enough.
    _, stretch = signed_distance(beams, centre, 1.0)

    def round_prior(x: FloatArray) -> FloatArray:
        # Beyond the beams that were chosen every circle explains them equally badly.
        off = np.abs(x[:, :3] - [centre[0], centre[1], radius]).max(axis=1)
        return np.where(off < min(0.5 * radius, 4.0 * reach), 0.0, -np.inf)

    shape = np.array([centre[0], centre[1], radius])
    problem = _Problem(beams, stretch, reach, False, inside, dropout, round_prior)
    samples = _explore(problem, shape, np.full(3, 0.3 * reach), seed)
    covariance = np.cov(samples[:, :3].T)
    if not tells_threshold(beams):
        covariance[2, 2] += threshold_variance(stretch)
    mean = samples[:, :3].mean(axis=0)
    spot, scatter = np.exp(np.median(samples[:, 3:5], axis=0))
    return EdgeFit(mean[:2], float(mean[2]), covariance, float(spot), float(scatter), float(np.median(samples[:, 5])))


# A straight edge may deviate by this from the direction that the planes beside it give it, radians.
_SLOPE_SIGMA = 0.01


def fit_straight_edge(
    beams: EdgeBeams, offset: float, *, dropout: float, reach: float, seed: int = 0
) -> tuple[float, float]:
    """Where a straight edge lies along the first axis of the plane, at zero along the second, and its variance, m^2.

    The material is on the side of smaller first coordinates; the edge runs along the second axis, nearly. Otherwise as
    `fit_edge`.
    """
    stretch = np.sqrt(1.0 + beams.slope[:, 0] ** 2 / (1.0 - (beams.slope**2).sum(axis=-1)))

    def straight_prior(x: FloatArray) -> FloatArray:
        near = np.abs(x[:, 0] - offset) < 4.0 * reach
        return np.where(near, -0.5 * (x[:, 1] / _SLOPE_SIGMA) ** 2, -np.inf)

    problem = _Problem(beams, stretch, reach, True, True, dropout, straight_prior)
    samples = _explore(problem, np.array([offset, 0.0, 0.0]), np.array([0.3 * reach, 0.5 * _SLOPE_SIGMA, 0.0]), seed)
    variance = float(np.var(samples[:, 0]))
    if not tells_threshold(beams):
        variance += threshold_variance(stretch)
    return float(samples[:, 0].mean()), variance


def tells_threshold(beams: EdgeBeams) -> bool:
    """True if anything tells where the threshold of detection lies in the spot: mixed ranges, or the light of hits."""
    return bool(np.any(~beams.open)) or beams.light is not None


def threshold_variance(stretch: FloatArray) -> float:
    """Variance of an edge of hits and misses where the prior alone bounds spot and threshold, m^2.

    Sampling such a ridge is slow; its variance is known, that of threshold times spot.
    """
    return float(_USUAL_SPOT_M**2 * np.exp(2.0 * _SPOT_SPREAD**2) * np.mean(stretch**2))


@dataclass(frozen=True, eq=False)
class _Problem:
    """An edge to estimate: its beams, how their spots are drawn out, and what shape it has."""

    beams: EdgeBeams
    stretch: FloatArray
    reach: float
    straight: bool
    inside: bool
    dropout: float
    shape_prior: LogDensity

    def near(self, shape: FloatArray, distance: FloatArray) -> _Problem:
        """The problem with the beams that are nearer to a shape (3,) than `distance` (n,)."""
        if self.straight:
            s = self.beams.place[:, 0] - shape[0] - shape[1] * self.beams.place[:, 1]
        else:
            s, _ = signed_distance(self.beams, shape[:2], float(shape[2]))
        close = np.abs(s) < distance
        return replace(self, beams=self.beams.at(close), stretch=self.stretch[close])

    def active(self) -> BoolArray:
        """Which of the nine parameters the data can tell; the others stay at their usual values."""
        beams = self.beams
        bounded, open_ = bool(np.any(~beams.open)), bool(np.any(beams.open))
        spot = tells_threshold(beams)
        lost = bool(np.any(~beams.open & ~np.isfinite(beams.depth)))
        return np.array([True, True, not self.straight, spot, spot, lost, spot and open_, bounded, False])


# Shape (centre x, y, radius; or offset, slope), log spot, log scatter, share of mixed lost, threshold, log contrast,
# evenness of the spot.
_USUAL = np.array([0.0, 0.0, 0.0, np.log(_USUAL_SPOT_M), np.log(0.03), 0.0, 0.0, 0.0, 0.5])


def _explore(problem: _Problem, shape: FloatArray, off: FloatArray, seed: int) -> FloatArray:
    """Samples (n, 9) of the posterior, from a first estimate of the shape (3,) that may be `off` (3,)."""
    rng = np.random.default_rng(seed)
    active = problem.active()
    usual = _USUAL.copy()
    usual[:3] = shape
    walkers = anneal(_posterior(problem, active, usual), _start(shape, off, problem.reach, rng)[:, active], rng)
    if active[3]:
        walkers, usual = _best_spot(problem, walkers, active, usual, rng)
    # Beams far from the edge, in widths of the spot, say nothing more.
    full = _completed(walkers, active, usual)
    width = 6.0 * float(np.exp(full[:, 3].max())) * problem.stretch + 1.5 * problem.reach
    near = problem.near(full[:, :3].mean(axis=0), width)
    return _completed(sample(_posterior(near, active, usual), walkers, rng), active, usual)


def _best_spot(
    problem: _Problem, walkers: FloatArray, active: BoolArray, usual: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Walkers for the kind of spot that explains the beams best, and the usual parameters with its evenness."""
    best = -np.inf
    chosen, kind = walkers, usual
    for evenness in (0.0, 0.5, 1.0):
        trial = usual.copy()
        trial[8] = evenness
        density = _posterior(problem, active, trial)
        # The second and third kind start from the top of the best before, with the walkers about it.
        top, value, covariance = climb(density, np.vstack([walkers, chosen]))
        if value > best:
            best, kind = value, trial
            chosen = scatter_about(density, top, value, covariance, walkers, rng)
    return chosen, kind


def _completed(x: FloatArray, active: BoolArray, usual: FloatArray) -> FloatArray:
    """Parameters (k, 9) from the active ones (k, d)."""
    full = np.repeat(usual[None], len(x), axis=0)
    full[:, active] = x
    return full


def _posterior(problem: _Problem, active: BoolArray, usual: FloatArray) -> LogDensity:
    """Log posterior density (k,) of the active parameters (k, d), up to a constant.

    The prior is even within bounds; for the spot it prefers, weakly, what 2D LiDARs have at a few metres, for the
    threshold of detection one half, and for both sides of the edge the same brightness. All three matter only where
    the data say nothing of them.
    """
    data = _sorted(problem.beams, problem.stretch, problem.reach, problem.straight)
    low = np.log([SMALLEST_SPOT_M, _SMALLEST_SCATTER])
    high = np.log([LARGEST_SPOT_M, _LARGEST_SCATTER])

    def density(some: FloatArray) -> FloatArray:
        x = _completed(some, active, usual)
        ok = ((x[:, [5, 8]] >= 0.0) & (x[:, [5, 8]] <= 1.0)).all(axis=1)
        shape = problem.shape_prior(x)
        ok &= np.isfinite(shape)
        value = np.full(len(x), -np.inf)
        if ok.any():
            prior = -0.5 * ((x[ok, 3] - np.log(_USUAL_SPOT_M)) / _SPOT_SPREAD) ** 2
            # Soft walls, as the likeliest scatter is often none: a top at a hard wall has no derivatives.
            beyond = np.maximum(low - x[ok, 3:5], 0.0) + np.maximum(x[ok, 3:5] - high, 0.0)
            prior -= 0.5 * ((beyond / _WALL) ** 2).sum(axis=1)
            prior -= 0.5 * x[ok, 6] ** 2 + 0.5 * (x[ok, 7] / _CONTRAST_SIGMA) ** 2
            # Far trials of a search may overflow; what is no number is no likelihood.
            with np.errstate(all="ignore"):
                value[ok] = _log_likelihood(x[ok], data, problem.inside, problem.dropout) + prior + shape[ok]
        return np.where(np.isnan(value), -np.inf, value)

    return density


def _start(shape: FloatArray, off: FloatArray, reach: float, rng: np.random.Generator) -> FloatArray:
    """Walkers (k, 9) spread by `off` (3,) about a first estimate of the shape (3,), and over all else."""
    middle = np.concatenate([shape, [np.log(0.4 * reach), np.log(0.03), 0.3, 0.0, 0.0, 0.5]])
    spread = np.concatenate([off, [0.5, 1.5, 0.15, 0.5, 0.3, 0.2]])
    walkers = middle + spread * rng.normal(size=(WALKERS, 9))
    walkers[:, [5, 8]] = np.clip(walkers[:, [5, 8]], 0.01, 0.99)
    walkers[:, 3] = np.clip(walkers[:, 3], np.log(1.2 * SMALLEST_SPOT_M), np.log(0.8 * LARGEST_SPOT_M))
    walkers[:, 4] = np.clip(walkers[:, 4], np.log(2.0 * _SMALLEST_SCATTER), np.log(0.8 * _LARGEST_SCATTER))
    return walkers
