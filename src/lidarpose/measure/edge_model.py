"""Where a round edge lies, from which beams hit it: a model of the beam at the edge, and its posterior.

A beam's axis meets the plane of the disk at a signed distance s from the circle, known from the beam's direction alone,
so the range noise plays no part in it. Its spot has some width w. The share of the spot on the material,
``F = Phi(-s / w)`` for a Gaussian one, is a half exactly at the edge whatever the width, and that is what makes the
diameter free of bias.
What the instrument returns tells F:

- a range between material and background (mixed pixels), whose place between the two is on the average the share of
  the light that comes from the background: 1 - F where both are as bright, k (1 - F) / (F + k (1 - F)) in general. The
  brightness k is a parameter: it skews the way from one to the other, which a shift of the edge does not. The scatter
  about it is a parameter too, and so is the share of mixed pixels that lie anywhere between the two;
- no return near the edge only (mixed pixels dropped): as likely on either side of it;
- no return beyond the edge (no background in reach): the edge of what is seen.

The kind of spot is chosen by the data; its width, scatter and dropping are parameters beside centre and radius, and all
are integrated out by sampling the posterior. What the beams' own scatter says beyond the model widens it
(`_inflation`). Without mixed returns the likelihood is a flat box with steep walls (each pair of neighbours brackets
the edge), which has no smooth maximum, and whose middle and width are what is wanted.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import ndtr

from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.measure.sampling import WALKERS, LogDensity, anneal, climb, sample, sample_about, scatter_about

# Spot widths (standard deviations) that the prior allows, metres.
SMALLEST_SPOT_M, LARGEST_SPOT_M = 4e-5, 1e-2
_SMALLEST_SCATTER, _LARGEST_SCATTER = 1e-5, 2.0
# Softness of these bounds, as a logarithm.
_WALL = 0.3
_OUTLIERS = 0.01
# Where in a spot beams on two surfaces are lost may differ by this, in standard deviations of the spot.
_LOST_ASIDE = 0.5
# How many parts of a spot a cut's place is told apart by, to so many standard deviations of the spot on both sides; and
# what chance makes of their means.
_CUTS, _CUT_REACH, _CUT_SIGMAS = 10, 2.5, 2.0
# Softness of the edge of what is detected, in distances between beams.
_SOFTNESS = 0.02
# The prior of the logarithm of the background's brightness over the material's.
_CONTRAST_SIGMA = 0.7
# The prior of the spot: its median across at the start of the beam and by what it widens a metre, and its spread as a
# logarithm. Makers state from 3 mm (0.4 mrad) to 11 mm (14 mrad) and more.
_SPOT_AT_START_M, _SPOT_WIDENS, _SPOT_SPREAD = 0.005, 0.002, 0.7


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
    usual_spot_m
        What spots have at this distance: the prior's median, as a standard deviation.
    mixing_seen
        True if spots on two surfaces are seen to give what neither gives alone.
    """

    place: FloatArray
    slope: FloatArray
    depth: FloatArray
    depth_sigma: FloatArray
    open: BoolArray
    light: FloatArray | None = None
    light_sigma: float = 1.0
    usual_spot_m: float = 0.25 * _SPOT_AT_START_M
    mixing_seen: bool = True

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
        Four times the variance that mixed pixels have at the edge beyond the noise, in squares of the way to the
        background (median).
    lost_share
        Share of mixed pixels that are dropped (median).
    """

    centre: FloatArray
    radius: float
    covariance: FloatArray
    spot_m: float
    scatter: float
    lost_share: float


def usual_spot(range_m: float) -> float:
    """What spots of LiDARs have at a distance, as a standard deviation, metres; known to a factor of two."""
    return 0.25 * (_SPOT_AT_START_M + _SPOT_WIDENS * range_m)


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


def _log_terms(x: FloatArray, data: _Sorted, inside: bool, dropout: float) -> FloatArray:
    """Log-likelihood (k, n) of each beam for parameters (k, 10), in the order of `_USUAL`."""
    s, u = _distances(x, data)
    F = _share(-u if inside else u, x[:, 8, None])
    a, b, c = data.ends
    scatter, lost = np.exp(x[:, 4, None]), _logistic(x[:, 5, None])
    terms = np.empty(F.shape)
    terms[:, :a] = _log_depth(x, data, F[:, :a], u[:, :a], lost, dropout)
    if b > a:
        terms[:, a:b] = np.log(dropout + (1.0 - dropout) * lost * _both(u[:, a:b]) + 1e-9)
    if F.shape[1] > b:
        # Seen where the share passes an unknown threshold: a sharp edge, displaced by a part of the spot.
        past = (s[:, b:] + x[:, 6, None] * np.exp(x[:, 3, None]) * data.stretch[b:]) / data.softness
        seen = (1.0 - dropout) * ndtr(-past if inside else past) * (1.0 - 2.0 * _OUTLIERS) + _OUTLIERS
        terms[:, b:c], terms[:, c:] = np.log(seen[:, : c - b]), np.log1p(-seen[:, c - b :])
        if data.light is not None:
            excess = 0.25 * scatter * np.sqrt(_both(u[:, b:c]))
            terms[:, b:c] += _log_light(data.light, F[:, b:c], excess, data.light_sigma)
    return terms


def _distances(x: FloatArray, data: _Sorted) -> tuple[FloatArray, FloatArray]:
    """How far off the material each beam's axis lies (k, n), in metres, and in widths of the spot for its share."""
    radius, spot = x[:, 2, None], np.exp(x[:, 3, None])
    if data.straight:
        s = data.place[:, 0] - x[:, 0, None] - x[:, 1, None] * data.place[:, 1]
        return s, s / (spot * data.stretch)
    s = np.hypot(data.place[:, 0] - x[:, 0, None], data.place[:, 1] - x[:, 1, None]) - radius
    u = s / (spot * data.stretch)
    # Of a spot centred on the edge of a disk less than half is on it, by the arc's mean sagitta under the spot: the
    # mean square along the cut is spot^2 for a Gaussian one, a third of the half chord's for an even one.
    square = 1.0 + x[:, 8, None] * (np.maximum(4.0 - u * u, 0.0) / 3.0 - 1.0)
    return s, u + 0.5 * spot / (radius * data.stretch) * square


def _log_depth(
    x: FloatArray, data: _Sorted, F: FloatArray, u: FloatArray, lost: FloatArray, dropout: float
) -> FloatArray:
    """Log-density (k, n) of the depths of beams before a background, of which F of the spot is on the material."""
    # Light weighs the two ranges: a background k times as bright as the material pulls the mean its way.
    share = F / (F + np.exp(x[:, 7, None]) * (1.0 - F))
    both = _both(u)
    excess = np.exp(x[:, 4, None]) * 0.25 * np.sqrt(both)
    variance = share * data.near_variance + (1.0 - share) * data.far_variance + excess
    normal = np.exp(-0.5 * (data.depth - 1.0 + share) ** 2 / variance) / np.sqrt(2.0 * np.pi * variance)
    kept = 1.0 - np.minimum(dropout + (1.0 - dropout) * lost * both, 1.0 - 1e-9)
    # A mixed pixel may lie anywhere between material and background, an outlier a little beyond as well.
    between = _logistic(x[:, 9, None]) * both
    anywhere = between * ((data.depth > -0.05) & (data.depth < 1.05)) / 1.1
    return np.asarray(np.log(kept * ((1.0 - _OUTLIERS) * ((1.0 - between) * normal + anywhere) + _OUTLIERS / 1.5)))


def _share(u: FloatArray, evenness: FloatArray) -> FloatArray:
    """Share (k, n) of a spot on one side of a straight edge, at u standard deviations of the spot inside it.

    Between a Gaussian spot (evenness 0) and a disk of even light (1), whose radius is two standard deviations.
    """
    z = np.clip(0.5 * u, -1.0, 1.0)
    disk = 0.5 + (np.arcsin(z) + z * np.sqrt(1.0 - z * z)) / np.pi
    return np.asarray((1.0 - evenness) * ndtr(u) + evenness * disk)


def _both(u: FloatArray) -> FloatArray:
    """How surely (k, n) a spot lies on both surfaces, at u of its widths from the edge.

    Smooth and wider than 4 F (1 - F): nobody knows a spot so well that nothing were to doubt where it ends.
    """
    v = 0.25 * u * u
    return np.asarray(np.exp(-2.0 * v * v))


def _log_light(light: FloatArray, share: FloatArray, excess: FloatArray, sigma: float) -> FloatArray:
    """Log-density (k, n) of the light of hits, which is the share of the spot on the material."""
    variance = sigma**2 + excess
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
    samples, inflation = _explore(problem, shape, np.full(3, 0.3 * reach), seed)
    covariance = np.cov(samples[:, :3].T) * np.sqrt(np.outer(inflation, inflation))
    covariance[2, 2] += _common_variance(problem, samples)
    mean = samples[:, :3].mean(axis=0)
    spot, scatter = np.exp(np.median(samples[:, 3:5], axis=0))
    lost = float(np.median(_logistic(samples[:, 5])))
    return EdgeFit(mean[:2], float(mean[2]), covariance, float(spot), float(scatter), lost)


# A straight edge may deviate by this from the direction that the planes beside it give it, radians.
_SLOPE_SIGMA = 0.01


def fit_straight_edge(
    beams: EdgeBeams, offset: float, *, dropout: float, reach: float, seed: int = 0
) -> tuple[float, float, float]:
    """Where a straight edge lies along the first axis of the plane, at zero along the second; its variance, m^2; spot.

    The material is on the side of smaller first coordinates; the edge runs along the second axis, nearly. Otherwise as
    `fit_edge`.
    """
    stretch = np.sqrt(1.0 + beams.slope[:, 0] ** 2 / (1.0 - (beams.slope**2).sum(axis=-1)))

    def straight_prior(x: FloatArray) -> FloatArray:
        near = np.abs(x[:, 0] - offset) < 4.0 * reach
        return np.where(near, -0.5 * (x[:, 1] / _SLOPE_SIGMA) ** 2, -np.inf)

    problem = _Problem(beams, stretch, reach, True, True, dropout, straight_prior)
    off = np.array([0.3 * reach, 0.5 * _SLOPE_SIGMA, 0.0])
    samples, inflation = _explore(problem, np.array([offset, 0.0, 0.0]), off, seed)
    variance = float(np.var(samples[:, 0]) * inflation[0])
    variance += _common_variance(problem, samples)
    return float(samples[:, 0].mean()), variance, float(np.exp(np.median(samples[:, 3])))


def tells_threshold(beams: EdgeBeams) -> bool:
    """True if anything tells where the threshold of detection lies in the spot: mixed ranges, or the light of hits."""
    return (beams.mixing_seen and bool(np.any(~beams.open))) or beams.light is not None


def _common_variance(problem: _Problem, samples: FloatArray) -> float:
    """Variance of an edge from what all beams share, and no number of them averages out, m^2.

    Where mixed ranges or light tell of the spot: depths that are off alike wherever a spot is cut alike come from a
    spot that the model does not have. A share that is off by d moves the edge by sqrt(2 pi) d of the spot.
    """
    beams, stretch = problem.beams, problem.stretch
    if not tells_threshold(beams):
        return threshold_variance(beams, stretch)
    x = np.median(samples, axis=0)
    # Beams that are lost need not be lost evenly on both sides.
    square = 2.0 * np.pi * _misfit_of_share(problem, x) + (_LOST_ASIDE * float(_logistic(x[5]))) ** 2
    return float(square * np.exp(2.0 * x[3]) * np.mean(stretch**2))


def _misfit_of_share(problem: _Problem, x: FloatArray) -> float:
    """Variance of what depths are off by at x (10,), as a function of how the spot is cut.

    Zero where noise explains it. By moments (DerSimonian and Laird, 1986), of means over parts of the spot.
    """
    data = _sorted(problem.beams, problem.stretch, problem.reach, problem.straight)
    _, u = _distances(x[None], data)
    F = _share(-u if problem.inside else u, x[None, 8, None])[0, : data.ends[0]]
    share = F / (F + np.exp(x[7]) * (1.0 - F))
    excess = np.exp(x[4]) * 0.25 * np.sqrt(_both(u[0, : data.ends[0]]))
    variance = share * data.near_variance + (1.0 - share) * data.far_variance + excess
    residual = data.depth - 1.0 + share
    part = np.floor((u[0, : data.ends[0]] + _CUT_REACH) * (_CUTS / (2.0 * _CUT_REACH)))
    chosen = (part >= 0) & (part < _CUTS) & (residual**2 < 16.0 * variance)
    part, residual, weight = part[chosen].astype(np.int64), residual[chosen], 1.0 / variance[chosen]
    weights = np.bincount(part, weight, _CUTS)
    sums = np.bincount(part, weight * residual, _CUTS)
    there = weights > 0.0
    count = np.count_nonzero(there)
    found = float((sums[there] ** 2 / weights[there]).sum()) - count
    if count < 2 or found < _CUT_SIGMAS * np.sqrt(2.0 * count):
        return 0.0
    return found / float(weights.sum() - (weights**2).sum() / weights.sum())


def threshold_variance(beams: EdgeBeams, stretch: FloatArray) -> float:
    """Variance of an edge of hits and misses where the prior alone bounds spot and threshold, m^2.

    Sampling such a ridge is slow; its variance is known, that of threshold times spot.
    """
    return float(beams.usual_spot_m**2 * np.exp(2.0 * _SPOT_SPREAD**2) * np.mean(stretch**2))


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

    def blurred(self, depth: float) -> _Problem:
        """The problem as if depths were noisier by so much."""
        sigma = np.hypot(self.beams.depth_sigma, depth)
        return replace(self, beams=replace(self.beams, depth_sigma=sigma))

    def active(self) -> BoolArray:
        """Which of the ten parameters the data can tell; the others stay at their usual values."""
        beams = self.beams
        bounded, open_ = bool(np.any(~beams.open)), bool(np.any(beams.open))
        spot = bounded or beams.light is not None
        lost = bool(np.any(~beams.open & ~np.isfinite(beams.depth)))
        # Without mixed ranges nothing tells of what they are made.
        mixed = bounded and self.mixed() >= _FEW_MIXED
        return np.array([True, True, not self.straight, spot, spot, lost, spot and open_, mixed, False, mixed])

    def mixed(self) -> int:
        """How many ranges clearly lie between material and background."""
        depth, sigma = self.beams.depth, self.beams.depth_sigma
        with np.errstate(invalid="ignore"):
            between = (depth > 5.0 * sigma[:, 0]) & (depth < 1.0 - 5.0 * sigma[:, 1])
        return int(np.count_nonzero(between & ~self.beams.open))


# Shape (centre x, y, radius; or offset, slope), log spot, log scatter, share of mixed lost (as the logarithm of its
# odds), threshold, log contrast, evenness of the spot, share of mixed pixels that lie anywhere (likewise).
_USUAL = np.array([0.0, 0.0, 0.0, np.log(0.25 * _SPOT_AT_START_M), np.log(0.03), -12.0, 0.0, 0.0, 0.5, -12.0])
# The search first sees depths blurred by this, then by less and less, so that no side valley holds it.
_BLUR, _SHARPEN = 0.1, 0.2
# Kinds of spot (see `_share`), which a larger blur hides; one that is worse by so much is not tried again.
_KINDS, _KINDS_BLUR, _HOPELESS = (0.0, 0.5, 1.0), 0.01, 30.0
# Of the priors of these parameters where they are not even; for the odds, of an even prior of the share at a half.
_PRIOR_CURVATURE = np.array([0, 0, 0, _SPOT_SPREAD**-2, 0, 0.5, 1, _CONTRAST_SIGMA**-2, 0, 0.5])
# Fewer mixed ranges than this may be outliers.
_FEW_MIXED = 12
# Of the circle, for the scatter of the beams' scores.
_SECTORS = 24
# The same edge seen with another kind of spot, whose width is another: changes of the logarithm of the spot.
_RESCALED = np.linspace(-0.3, 0.3, 13)[:, None] * (np.arange(10) == 3)


def _logistic(odds: FloatArray) -> FloatArray:
    """The share (...) of which `odds` is the logarithm of the odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * odds)))


def _explore(problem: _Problem, shape: FloatArray, off: FloatArray, seed: int) -> tuple[FloatArray, FloatArray]:
    """Samples (n, 10) of the posterior, from a first estimate of the shape (3,) that may be `off` (3,)."""
    rng = np.random.default_rng(seed)
    active = problem.active()
    usual = _USUAL.copy()
    usual[:3], usual[3], usual[8] = shape, np.log(problem.beams.usual_spot_m), _KINDS[0]
    start = _start(shape, off, problem.reach, rng)[:, active]
    walkers = anneal(_posterior(problem.blurred(_BLUR), active, usual), start, rng)
    if active[3]:
        problem, walkers, usual = _sharpened(problem, walkers, active, usual, rng)
    density = _posterior(problem, active, usual)
    top, _, covariance = climb(density, walkers)
    samples = None if covariance is None else sample_about(density, top, covariance, rng)
    samples = sample(density, walkers, rng) if samples is None else samples
    return _completed(samples, active, usual), _inflation(problem, samples, active, usual)


def _inflation(problem: _Problem, samples: FloatArray, active: BoolArray, usual: FloatArray) -> FloatArray:
    """By what factor (3,) at least the shape's variances are larger than the posterior's, from the beams themselves.

    The posterior believes the model. If that is wrong in the spot or the mixing, the scores of the beams scatter more
    than its curvature says, or together along the edge: the variance is then H^-1 J H^-1 with the scatter J of the
    scores' sums by sectors (Huber, 1967, with sectors for his observations). Priors enter J by their curvature.
    """
    inflation = np.ones(3)
    if not active[3]:
        return inflation
    mean, covariance = samples.mean(axis=0), np.cov(samples.T)
    sums = _sector_scores(problem, _completed(mean[None], active, usual)[0], active, np.sqrt(np.diag(covariance)))
    sums -= sums.mean(axis=0)
    J = sums.T @ sums * len(sums) / max(len(sums) - 1, 1) + np.diag(_PRIOR_CURVATURE[active])
    ratio = np.diag(covariance @ J @ covariance) / np.diag(covariance)
    inflation[active[:3]] = np.maximum(ratio[: np.count_nonzero(active[:3])], 1.0)
    return inflation


def _sector_scores(problem: _Problem, x: FloatArray, active: BoolArray, width: FloatArray) -> FloatArray:
    """Sums (sectors, d) of the beams' scores at x (10,): derivatives by the active parameters, of `width` (d,)."""
    step = 0.1 * width
    ends = np.concatenate([np.diag(step), -np.diag(step)])
    data = _sorted(problem.beams, problem.stretch, problem.reach, problem.straight)
    terms = _log_terms(_completed(x[active] + ends, active, x), data, problem.inside, problem.dropout)
    scores = (terms[: len(step)] - terms[len(step) :]) / (2.0 * step[:, None])
    if problem.straight:
        along = data.place[:, 1] / problem.reach
    else:
        along = np.arctan2(*(data.place - x[:2]).T) * (_SECTORS / (2.0 * np.pi))
    _, sector = np.unique(np.floor(along), return_inverse=True)
    sums = np.zeros((int(sector.max()) + 1, len(step)))
    np.add.at(sums, sector, scores.T)
    return sums


def _sharpened(
    problem: _Problem, walkers: FloatArray, active: BoolArray, usual: FloatArray, rng: np.random.Generator
) -> tuple[_Problem, FloatArray, FloatArray]:
    """The problem with the beams that matter, walkers about its top, and the usual parameters with the kind of spot.

    The kind of spot is the one that explains the beams best.
    """
    kinds: tuple[float, ...] = _KINDS
    for blur in _blurs(problem.beams):
        tops: list[tuple[float, float, FloatArray]] = []
        starts = walkers
        for kind in kinds if blur < _KINDS_BLUR else (usual[8],):
            trial = usual.copy()
            trial[8] = kind
            density = _posterior(problem.blurred(blur), active, trial)
            # From a soft spot to one with a sharp end, each from the tops of those before: the other way is rugged.
            top, value, covariance = climb(density, starts)
            starts = np.vstack([starts, top + _RESCALED[:, active]])
            tops.append((value, kind, scatter_about(density, top, value, covariance, walkers, rng)))
        best, usual[8], walkers = max(tops, key=lambda entry: entry[0])
        if len(tops) > 1:
            kinds = tuple(kind for value, kind, _ in tops if value > best - _HOPELESS)
        # Beams far from the edge, in widths of the spot, say nothing more.
        full = _completed(walkers, active, usual)
        width = 6.0 * float(np.exp(full[:, 3].max())) * problem.stretch + 0.5 * problem.reach
        problem = problem.near(full[:, :3].mean(axis=0), width)
    return problem, walkers, usual


def _blurs(beams: EdgeBeams) -> list[float]:
    """Ever smaller noise of depths to add to their own, and none in the end."""
    own = float(np.median(beams.depth_sigma[:, 0])) if np.any(~beams.open) else _BLUR
    blurs: list[float] = []
    while (_BLUR * _SHARPEN ** len(blurs)) > own:
        blurs.append(_BLUR * _SHARPEN ** len(blurs))
    return [*blurs, 0.0]


def _completed(x: FloatArray, active: BoolArray, usual: FloatArray) -> FloatArray:
    """Parameters (k, 10) from the active ones (k, d)."""
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
    log_spot = np.log(problem.beams.usual_spot_m)

    def density(some: FloatArray) -> FloatArray:
        x = _completed(some, active, usual)
        shape = problem.shape_prior(x)
        ok = np.isfinite(shape)
        value = np.full(len(x), -np.inf)
        if ok.any():
            prior = -0.5 * ((x[ok, 3] - log_spot) / _SPOT_SPREAD) ** 2
            # Soft walls, as the likeliest scatter is often none: a top at a hard wall has no derivatives.
            beyond = np.maximum(low - x[ok, 3:5], 0.0) + np.maximum(x[ok, 3:5] - high, 0.0)
            prior -= 0.5 * ((beyond / _WALL) ** 2).sum(axis=1)
            prior -= 0.5 * x[ok, 6] ** 2 + 0.5 * (x[ok, 7] / _CONTRAST_SIGMA) ** 2
            share = _logistic(x[ok][:, [5, 9]])
            prior += np.log(share * (1.0 - share) + 1e-300).sum(axis=1)
            # Far trials of a search may overflow; what is no number is no likelihood.
            with np.errstate(all="ignore"):
                value[ok] = _log_terms(x[ok], data, problem.inside, problem.dropout).sum(axis=1)
                value[ok] += prior + shape[ok]
        return np.where(np.isnan(value), -np.inf, value)

    return density


def _start(shape: FloatArray, off: FloatArray, reach: float, rng: np.random.Generator) -> FloatArray:
    """Walkers (k, 10) spread by `off` (3,) about a first estimate of the shape (3,), and over all else."""
    middle = np.concatenate([shape, [np.log(0.4 * reach), np.log(0.03), -1.0, 0.0, 0.0, 0.5, -3.0]])
    spread = np.concatenate([off, [0.5, 1.5, 0.7, 0.5, 0.3, 0.2, 1.0]])
    walkers = middle + spread * rng.normal(size=(WALKERS, 10))
    walkers[:, 3] = np.clip(walkers[:, 3], np.log(1.2 * SMALLEST_SPOT_M), np.log(0.8 * LARGEST_SPOT_M))
    walkers[:, 4] = np.clip(walkers[:, 4], np.log(2.0 * _SMALLEST_SCATTER), np.log(0.8 * _LARGEST_SCATTER))
    return walkers
