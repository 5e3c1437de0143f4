"""The stripe's centre line to a few hundredths of a pixel, fitted in a narrow band of the raw image.

See `laser_stripe` for the model. Here the image is looked at along a scan coordinate u (x, or y for steep stripes), one
profile in v for each whole u. Each profile has its own height, centre, background and shift of the squares' edges
(known to some hundredths of a pixel only: this is what limits points beside an edge); the stripe's width and how much
light dark squares send back are common to all. Gauss and Newton's method, all profiles at once; the common unknowns by
elimination of the others. The noise's variance, r^2 + g * level + (s * signal)^2 (reading, shots, speckle), is learnt
from the residuals.

Arrays are single precision and made once a band: this runs once for each image and panel, in about a millisecond.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np

from lidarpose.detect.stripe_search import CoarseLine, PanelView
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.robust import MAD_TO_SIGMA, tukey_weights
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import StripePoints

# Profiles that are merged into one point (half as many in short stripes): neighbours share the lens's blur and the
# laser's speckle.
_BLOCK = 8
_SHORT = 300
_MIN_POINTS = 8
# Half-height of the band in which the coarse line is made fine, pixels.
_FIRST_HALF = 12
# A profile whose own centre is worse than this tells nothing.
_WORST_SIGMA_PX = 0.8
# Profiles without light keep to the curve by this pull, nothing against a real profile's hundredths.
_PULL_PX = 1.5
# Pixels that the noise is learnt from, and the bins they are sorted into.
_NOISE_SAMPLES, _NOISE_BINS = 2000, 8
# Order of the unknowns: the first three are each profile's own, the width is common.
_BACKGROUND, _HEIGHT, _CENTRE, _WIDTH = range(4)


@dataclass(frozen=True, eq=False)
class StripeFit:
    """Points, and what the fit learnt on the way (for tests and reports).

    Attributes
    ----------
    width_px
        Standard deviation of the stripe's profile across, lens included.
    dark_ratio
        Light sent back by dark squares against light ones, at the laser's colour.
    inflation
        By how much the scatter about a smooth curve exceeds what the noise explains (1: not at all); it is in the
        points' standard deviations.
    """

    points: StripePoints
    width_px: float
    dark_ratio: float
    inflation: float


@dataclass(frozen=True, eq=False)
class _Curve:
    """v as a polynomial of u, in (u - middle) / half."""

    coefficients: FloatArray
    middle: float
    half: float

    def at(self, u: FloatArray) -> FloatArray:
        return _horner(self.coefficients, (u - self.middle) / self.half)

    def slope(self, u: FloatArray) -> FloatArray:
        derivative = self.coefficients[1:] * np.arange(1, len(self.coefficients)) / self.half
        return _horner(derivative, (u - self.middle) / self.half)


def _horner(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    value = np.full_like(x, coefficients[-1])
    for c in coefficients[-2::-1]:
        value = value * x + c
    return value


@dataclass(frozen=True, eq=False)
class _Band:
    """Profiles along the stripe, as a table of N profiles of P pixels.

    u : (N,); v : (N, P) pixel coordinates; values, bright : grey levels; good : pixels that count;
    ambient : light that was taken out of the values; cosine, sine : (N,) of the stripe's inclination;
    light : share of light surface that each pixel sees.
    """

    u: FloatArray
    v: FloatArray
    values: FloatArray
    bright: FloatArray
    good: FloatArray
    ambient: FloatArray
    cosine: FloatArray
    sine: FloatArray
    light: FloatArray

    @property
    def half(self) -> int:
        return int(self.v.shape[1] // 2)


@dataclass(frozen=True, eq=False)
class _State:
    """height, centre, background : (N,); information : (N,) on the centre, 1 / px^2 along v."""

    height: FloatArray
    centre: FloatArray
    background: FloatArray
    width: float
    dark_ratio: float
    noise: tuple[float, float, float]
    information: FloatArray


@dataclass(frozen=True, eq=False)
class _Smooth:
    """A smooth curve through the centres, the weight (N,) that each profile is left with, and its residual (N,)."""

    curve: _Curve
    weight: FloatArray
    residual: FloatArray


def fit_stripe(view: PanelView, image: GrayImage, line: CoarseLine, limit: float) -> StripeFit | str:
    """Fit the stripe near `line`; `limit` is the grey level at which the sensor saturates. A string says why not."""
    straight = _Curve(np.array([line.intercept, line.slope]), 0.0, 1.0)
    u = _usable_range(view, line, straight)
    if len(u) < _MIN_POINTS:
        return "no stripe on the panel: the bright line leaves the squares"
    first = _first_curve(_cut(view, image, line.steep, u, straight, _FIRST_HALF, limit), line, straight)
    if isinstance(first, str):
        return first
    curve, width = first
    band = _start_band(view, image, line.steep, u, curve, width, limit)
    state = _start(band, curve, view, width)
    band, state, smooth = _refine(band, state, view, line.steep, curve, steps=2)
    if isinstance(smooth, str):
        return smooth
    if _half_height(smooth.curve, u, state.width) > band.half:
        band = _start_band(view, image, line.steep, u, smooth.curve, state.width, limit)
        state = replace(_start(band, smooth.curve, view, state.width), dark_ratio=state.dark_ratio)
    band, state, smooth = _refine(band, state, view, line.steep, smooth.curve, steps=2)
    return smooth if isinstance(smooth, str) else _points(band, smooth, line.steep, state)


def _refine(
    band: _Band, state: _State, view: PanelView, steep: bool, curve: _Curve, steps: int
) -> tuple[_Band, _State, _Smooth | str]:
    """Steps with the albedo as it is seen about the curve, and a smooth curve through what comes out."""
    band = _look_at_albedo(band, view, steep, curve, state.width)
    for step in range(steps):
        state = _step(band, state, curve, learn=step == 0)
    state = replace(state, dark_ratio=_dark_ratio(band, state))
    return band, state, _smooth(band, state)


def _usable_range(view: PanelView, line: CoarseLine, curve: _Curve) -> FloatArray:
    """Whole u (N,) near the coarse line's range whose centre lies in a usable square."""
    axis = 1 if line.steep else 0
    slack = 4 * view.factor
    first = max(int(np.floor(line.start)) - slack, view.low[axis])
    last = min(int(np.ceil(line.end)) + slack, view.high[axis] - 1)
    u = np.arange(first, last + 1, dtype=np.float64)
    v = curve.at(u)
    across = 1 - axis
    inside = (v > view.low[across] + 3) & (v < view.high[across] - 4)
    u, v = u[inside], v[inside]
    if len(u) == 0:
        return u
    grid, _ = view.grid_and_slopes(_pixels(u, v, line.steep))
    return u[view.albedo.is_usable(grid)]


def _pixels(u: FloatArray, v: FloatArray, steep: bool) -> FloatArray:
    return np.stack([v, u] if steep else [u, v], axis=-1)


def _cut(
    view: PanelView, image: GrayImage, steep: bool, u: FloatArray, curve: _Curve, half: int, limit: float
) -> _Band:
    """Profiles of 2 half + 1 pixels about the curve."""
    v = np.rint(curve.at(u)).astype(np.intp)[:, None] + np.arange(-half, half + 1)
    across = 0 if steep else 1
    low, high = view.low[across], view.high[across]
    safe = np.clip(v, low, high - 1)
    along = u.astype(np.intp)[:, None]
    rows, columns = (along, safe) if steep else (safe, along)
    values = image.take(rows * image.shape[1] + columns).astype(np.float32)
    bright = view.bright.take((rows - view.low[1]) * view.bright.shape[1] + (columns - view.low[0]))
    good = ((v == safe) & (values < 0.98 * limit)).astype(np.float32)
    slope = curve.slope(u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    nothing = np.zeros_like(values)
    return _Band(u, v.astype(np.float32), values, bright, good, nothing, cosine, slope * cosine, nothing)


def _half_height(curve: _Curve, u: FloatArray, width: float) -> int:
    """Half-height of a band that holds the profile and enough of its surroundings."""
    steepest = float(np.sqrt(1.0 + np.max(np.abs(curve.slope(u))) ** 2))
    return int(np.clip(np.ceil(3.3 * width * steepest + 1.5), 4, 24))


def _start_band(
    view: PanelView, image: GrayImage, steep: bool, u: FloatArray, curve: _Curve, width: float, limit: float
) -> _Band:
    """The band about a good curve, with the ambient light taken out."""
    band = _cut(view, image, steep, u, curve, _half_height(curve, u, width), limit)
    flank = band.good * (np.abs(_distance(band, curve.at(u))) > 2.7 * width)
    ambient = _ambient(band, flank)
    return replace(band, values=band.values - ambient, ambient=ambient)


def _distance(band: _Band, centre: FloatArray) -> FloatArray:
    """Distance (N, P) of the pixels from the stripe's centre line."""
    return np.asarray((band.v - _column(centre)) * _column(band.cosine))


def _column(values: FloatArray) -> FloatArray:
    return np.asarray(values, dtype=np.float32)[:, None]


def _first_curve(band: _Band, line: CoarseLine, straight: _Curve) -> tuple[_Curve, float] | str:
    """A curve within about a pixel, from the brightest pixel of each profile, and the stripe's rough width."""
    rest = band.values - np.float32(line.ambient_share) * band.bright
    rest -= rest.mean(axis=1, keepdims=True)
    smooth = rest.copy()
    smooth[:, 1:-1] = 0.25 * rest[:, :-2] + 0.5 * rest[:, 1:-1] + 0.25 * rest[:, 2:]
    peak = np.argmax(smooth, axis=1)
    rows = np.arange(len(peak))
    height = smooth[rows, peak]
    strong = height > 0.4 * _quantile(height, 0.75)
    offset = band.v[rows, peak] - straight.at(band.u)
    weight = np.where(strong, 1.0, 0.0)
    curve = straight
    for reach in (8.0, 4.0, 2.5):
        near = weight * (np.abs(band.v[rows, peak] - curve.at(band.u)) <= reach)
        if np.count_nonzero(near) < _MIN_POINTS:
            return "no stripe on the panel: the bright line is not a narrow ridge"
        curve = _fit_curve(band.u, straight.at(band.u) + offset, near, degree=2)
    chosen = rows[near > 0]
    window = np.clip(peak[chosen][:, None] + np.arange(-9, 10), 0, rest.shape[1] - 1)
    area = np.maximum(rest[chosen[:, None], window], 0.0).sum(axis=1) / height[chosen]
    cosine = 1.0 / np.sqrt(1.0 + curve.slope(band.u[chosen]) ** 2)
    # Speckle makes the highest pixel too high, by this much typically, and the width too small.
    width = 1.15 * _quantile(area * cosine, 0.5) / np.sqrt(2.0 * np.pi)
    return curve, float(np.clip(width, 0.6, 6.0))


def _fit_curve(u: FloatArray, v: FloatArray, weight: FloatArray, degree: int) -> _Curve:
    """Weighted least squares; well conditioned in a coordinate from -1 to 1."""
    middle, half = 0.5 * float(u[0] + u[-1]), max(0.5 * float(u[-1] - u[0]), 1.0)
    s = (u - middle) / half
    powers = [np.ones_like(s)]
    for _ in range(degree):
        powers.append(powers[-1] * s)
    design = np.stack(powers)
    weighted = design * weight
    normal = weighted @ design.T
    coefficients = np.linalg.solve(normal + np.eye(degree + 1) * (1e-12 * np.trace(normal)), weighted @ v)
    return _Curve(coefficients, middle, half)


def _quantile(values: FloatArray, share: float) -> float:
    """As numpy's, to the nearest value, without its checks."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])


def _spread(values: FloatArray) -> float:
    """Robust standard deviation about zero."""
    return MAD_TO_SIGMA * _quantile(np.abs(values), 0.5) if len(values) else float("nan")


def _start(band: _Band, curve: _Curve, view: PanelView, width: float) -> _State:
    """Guess heights and backgrounds."""
    centre = curve.at(band.u)
    distance = np.abs(_distance(band, centre))
    flank, core = band.good * (distance > 2.7 * width), band.good * (distance < width)
    background = (band.values * flank).sum(axis=1) / np.maximum(flank.sum(axis=1), 1.0)
    rest = band.values - background[:, None]
    height = (rest * core).sum(axis=1) / np.maximum(core.sum(axis=1), 1.0) / 0.85
    reading = 1.25 * float((np.abs(rest) * flank).sum() / max(float(flank.sum()), 1.0))
    ratio = float(np.clip(np.median(view.albedo.dark / np.maximum(view.albedo.light, 1.0)), 0.02, 0.95))
    noise = (max(reading, 0.3) ** 2, 0.0, 0.0)
    return _State(np.maximum(height, 1.0), centre, background, width, ratio, noise, np.ones(len(centre)))


def _ambient(band: _Band, flank: FloatArray) -> FloatArray:
    """The bright image times a share that changes slowly along the stripe, from the pixels beside it (`flank`)."""
    count = np.maximum(flank.sum(axis=1, keepdims=True), 1.0)
    values, bright = (flank * (x - (x * flank).sum(axis=1, keepdims=True) / count) for x in (band.values, band.bright))
    s = (band.u - band.u.mean()) / max(float(np.ptp(band.u)) / 2.0, 1.0)
    powers = np.stack([np.ones_like(s), s, s**2], axis=1)
    own, cross = np.einsum("np,np->n", bright, bright), np.einsum("np,np->n", bright, values)
    normal = (powers * own[:, None]).T @ powers
    # Flat profiles tell nothing: a weak pull towards no ambient light.
    share = np.linalg.solve(normal + np.eye(3) * (1e-6 * np.trace(normal) + 1.0), powers.T @ cross)
    return np.asarray(_column(powers @ share) * band.bright)


def _look_at_albedo(band: _Band, view: PanelView, steep: bool, curve: _Curve, width: float) -> _Band:
    """Share of light surface that each pixel sees through stripe and lens (see `laser_stripe`)."""
    albedo = view.albedo
    centre = curve.at(band.u)
    slope = curve.slope(band.u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    band = replace(band, cosine=cosine, sine=slope * cosine)
    grid, slopes = view.grid_and_slopes(_pixels(band.u, centre, steep))
    by_u, by_v = (slopes[:, 1::2], slopes[:, ::2]) if steep else (slopes[:, ::2], slopes[:, 1::2])
    across = by_v * _column(cosine) - by_u * _column(band.sine)
    along = by_u * _column(cosine) + by_v * _column(band.sine)
    blur2 = min(albedo.blur_px, width) ** 2
    thickness = 1.0 - blur2 / width**2
    edges = np.sqrt(blur2 * (thickness * across**2 + along**2))
    # A pixel at (0, dv) from the centre is seen at dv along the stripe's tangent plus `thickness` of it across.
    dv = band.v - _column(centre)
    per_v = by_v * _column(cosine**2 * thickness + band.sine**2)
    per_v = np.asarray(per_v + by_u * _column((1.0 - thickness) * cosine * band.sine), dtype=np.float32)
    inside = _inside_squares(view, grid, across, width)
    x, y = (dv * per_v[:, k, None] + _column(grid[:, k]) for k in (0, 1))
    light = albedo.light_share(x, y, _column(edges[:, 0]), _column(edges[:, 1]))
    return replace(band, light=light, good=band.good * inside[:, None])


def _inside_squares(view: PanelView, grid: FloatArray, across: FloatArray, width: float) -> FloatArray:
    """1 for profiles (N,) whose light falls on usable squares alone: what lies around the board is not known.

    `across` (N, 2) is the change of the grid coordinates by a pixel across the stripe.
    """
    usable = view.albedo.is_usable
    reach = 2.5 * width * across
    return (usable(grid) & usable(grid - reach) & usable(grid + reach)).astype(np.float32)


def _step(band: _Band, state: _State, curve: _Curve, *, learn: bool) -> _State:
    """One Gauss-Newton step; with `learn`, the noise is learnt again first."""
    distance = _distance(band, state.centre) * np.float32(1.0 / state.width)
    squared = distance * distance
    bell = np.exp(np.float32(-0.5) * squared)
    ratio, height = np.float32(state.dark_ratio), _column(state.height)
    by_height = bell * (ratio + (1 - ratio) * band.light)
    signal = height * by_height
    rest = band.values - _column(state.background)
    residual = rest - signal
    level = np.maximum(band.values + band.ambient, np.float32(0.0))
    noise = _learn_noise(residual, level, signal, band.good, state.noise) if learn else state.noise
    variance = np.float32(noise[0]) + np.float32(noise[1]) * level + np.float32(noise[2]) * signal * signal
    weight = band.good / variance
    J = [
        np.ones_like(signal),
        by_height,
        signal * distance * _column(band.cosine / state.width),
        signal * squared,
    ]
    M = _normal_equations(J, residual, weight)
    M[_BACKGROUND][0] += 1e-9
    M[_HEIGHT][0] += 1e-9
    M[_CENTRE][0] += 1.0 / _PULL_PX**2
    M[_CENTRE][-1] += (curve.at(band.u) - state.centre) / _PULL_PX**2
    change, by_width, information = _solve(M)
    return _State(
        np.maximum(state.height + change[_HEIGHT], 1e-3),
        state.centre + np.clip(change[_CENTRE], -1.0, 1.0),
        state.background + change[_BACKGROUND],
        float(np.clip(state.width * np.exp(by_width), 0.4, 10.0)),
        state.dark_ratio,
        noise,
        information,
    )


def _normal_equations(J: list[FloatArray], residual: FloatArray, weight: FloatArray) -> list[FloatArray]:
    """Upper triangle, row by row, of the sums over each profile of weight * J_i * J_j; last in each row, the residual.

    Row i is an array (k - i + 1, N) of k unknowns' products, from the diagonal on.
    """
    rows = []
    for i in range(len(J)):
        weighted = J[i] * weight
        rows.append(np.stack([np.einsum("np,np->n", weighted, other) for other in (*J[i:], residual)]).astype(float))
    return rows


def _solve(rows: list[FloatArray]) -> tuple[list[FloatArray], float, FloatArray]:
    """Changes (N,) of the profiles' own unknowns, of the width's logarithm, and the centres' information (N,).

    Gauss's elimination of each profile's own unknowns, what is left summed over the profiles. `rows` are used up.
    """
    for k in range(_WIDTH):
        share = rows[k][1:-1] / rows[k][0]
        for i in range(k + 1, len(rows)):
            rows[i] -= share[i - k - 1] * rows[k][i - k :]
    normal, goal = rows[_WIDTH].sum(axis=-1)
    by_width = float(np.clip(goal / (normal + 1e-6), -0.3, 0.3))
    changes: list[FloatArray] = [np.zeros(0)] * _WIDTH
    for k in reversed(range(_WIDTH)):
        value = rows[k][-1] - rows[k][_WIDTH - k] * by_width
        for j in range(k + 1, _WIDTH):
            value = value - rows[k][j - k] * changes[j]
        changes[k] = value / rows[k][0]
    return changes, by_width, np.asarray(rows[_CENTRE][0])


def _dark_ratio(band: _Band, state: _State) -> float:
    """Light that dark squares send back against light ones, at the laser's colour: from the profiles wholly on either.

    Not fitted with the rest: its product with the heights makes a bad start worse.
    """
    share = band.light[:, band.half]
    light, dark = state.height[share > 0.98], state.height[share < 0.02]
    if min(len(light), len(dark)) < 20:
        return state.dark_ratio
    seen = state.dark_ratio * _quantile(dark, 0.5) / _quantile(light, 0.5)
    return float(np.clip(seen, 0.01, 1.0))


def _learn_noise(
    residual: FloatArray, level: FloatArray, signal: FloatArray, good: FloatArray, before: tuple[float, float, float]
) -> tuple[float, float, float]:
    """Variance as r^2 + g * level + s^2 * signal^2 (all >= 0), from residuals sorted into bins by the signal."""
    step = max(good.size // _NOISE_SAMPLES, 1)
    some = np.flatnonzero(good.ravel()[::step]) * step
    if len(some) < 12 * _NOISE_BINS:
        return before
    some = some[: len(some) // _NOISE_BINS * _NOISE_BINS]
    signal = signal.ravel()[some]
    order = np.argsort(signal)
    error, level, signal = (
        x.reshape(_NOISE_BINS, -1)
        for x in (np.abs(residual.ravel()[some])[order], level.ravel()[some[order]], signal[order])
    )
    # Medians are deaf to what does not belong; a sixth of the freedom went into the fit.
    middle = error.shape[1] // 2
    variance = np.maximum(1.2 * (MAD_TO_SIGMA * np.partition(error, middle, axis=1)[:, middle]) ** 2, 0.05)
    design = np.stack([np.ones(_NOISE_BINS), level.mean(axis=1), (signal**2).mean(axis=1)], axis=1)
    solution = _not_negative(design / variance[:, None], np.ones(_NOISE_BINS))
    return (max(float(solution[0]), 0.05), float(solution[1]), float(solution[2]))


def _not_negative(design: FloatArray, goal: FloatArray) -> FloatArray:
    """Least squares with no unknown below zero, for a few unknowns: the best of all choices of those that are zero."""
    count = design.shape[1]
    best, least = np.zeros(count), float(goal @ goal)
    for size in range(count, 0, -1):
        for free in combinations(range(count), size):
            found = np.linalg.lstsq(design[:, free], goal, rcond=None)[0]
            rest = goal - design[:, free] @ found
            if found.min() >= 0.0 and float(rest @ rest) < least:
                best, least = np.zeros(count), float(rest @ rest)
                best[list(free)] = found
        if size == count and best.any():
            break
    return best


def _smooth(band: _Band, state: _State) -> _Smooth | str:
    """A smooth curve through the centres, robust against the profiles that show something else."""
    sigma = 1.0 / np.sqrt(state.information)
    weight = np.where(sigma * band.cosine < _WORST_SIGMA_PX, state.information, 0.0)
    robust = weight
    degree = 3 if np.count_nonzero(weight) > 60 else 2
    for _ in range(3):
        if np.count_nonzero(robust) < _MIN_POINTS:
            return "no stripe on the panel: too few profiles show it"
        curve = _fit_curve(band.u, state.centre, robust, degree)
        residual = state.centre - curve.at(band.u)
        standardised = residual / sigma
        scale = max(_spread(standardised[weight > 0]), 1.0)
        robust = weight * tukey_weights(standardised / scale)
    kept = np.where(np.abs(standardised) < 4.0 * scale, weight, 0.0)
    spread = _spread((residual * band.cosine)[kept > 0])
    if not spread < 0.5 * max(state.width, 1.0):
        return "the bright line on the panel is not the narrow straight line that a laser makes"
    return _Smooth(curve, kept, residual)


def _points(band: _Band, smooth: _Smooth, steep: bool, state: _State) -> StripeFit | str:
    """Merge blocks of neighbouring profiles; their scatter about the curve corrects what the noise model states."""
    weight = smooth.weight
    length = _BLOCK if np.count_nonzero(weight) > _SHORT else _BLOCK // 2
    block = np.floor(band.u / length).astype(int)
    block -= block[0]
    total = np.bincount(block, weight)
    enough = (np.bincount(block, weight > 0) >= length // 2) & (total > 0)
    safe = np.where(enough, total, 1.0)
    columns = (band.u, smooth.residual, band.cosine, band.sine)
    u, offset, cosine, sine = ((np.bincount(block, weight * x) / safe)[enough] for x in columns)
    sigma = 1.0 / np.sqrt(total[enough])
    if len(u) < _MIN_POINTS:
        return "no stripe on the panel: too few profiles show it"
    freedom = np.sqrt(max(len(u) - 4, 1) / len(u))
    inflation = max(_spread(offset / sigma) / freedom, 1.0)
    norm = np.hypot(cosine, sine)
    cosine, sine = cosine / norm, sine / norm
    sigma = sigma * inflation * cosine
    # Points on dark squares beside points on light ones: a hundredth of their weight, and mostly trouble.
    best = _quantile(sigma, 0.2)
    worth = sigma < max(8.0 * best, 0.1)
    u, offset, cosine, sine, sigma = u[worth], offset[worth], cosine[worth], sine[worth], sigma[worth]
    normals = np.stack([cosine, -sine] if steep else [-sine, cosine], axis=-1)
    points = StripePoints(_pixels(u, smooth.curve.at(u) + offset, steep), normals, sigma)
    return StripeFit(points, state.width, state.dark_ratio, inflation)
