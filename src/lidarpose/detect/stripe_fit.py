"""The stripe's centre line to a few hundredths of a pixel, fitted in a narrow band of the raw image.

See `laser_stripe` for the model. Here the image is looked at along a scan coordinate u (x, or y for steep stripes), one
profile in v for each whole u. Each profile has its own height, centre, background and shift of the squares' edges
(known to some hundredths of a pixel only: this is what limits points beside an edge); the stripe's width and how much
light dark squares send back are common to all. Gauss and Newton's method, all profiles at once; the common unknowns by
elimination of the others. The noise's variance, r^2 + g * level + (s * signal)^2 (reading, shots, speckle), is learnt
from the residuals.

The images of one panel are fitted several at once, as tables of B bands, N profiles each and P pixels a profile (P
first: NumPy is fast along the last axis, and profiles are short): single
ones are so small that calling NumPy would take most of the time. Shorter bands are filled up with profiles that are not
`valid`. Nothing passes from one band to another.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from itertools import product

import numpy as np

from lidarpose.detect.stripe_search import CoarseLine, PanelView
from lidarpose.geometry.arrays import BoolArray, FloatArray
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
# A profile, or a point, whose centre is worse than this tells nothing.
_WORST_SIGMA_PX = 0.8
# Profiles without light keep to the curve by this pull, nothing against a real profile's hundredths.
_PULL_PX = 1.5
# Profiles of a band, about, that the width, the squares' colours and a first curve are found from.
_FEW = 250
# Pixels that the noise is learnt from, and the bins they are sorted into.
_NOISE_SAMPLES, _NOISE_BINS = 1200, 8
# What the squares' edges and the blur are known to at best, in what they move a point by.
_MODEL_SIGMA_PX = 0.01
# A step that changes the width by this share and the typical centre by so many of its sigmas is the last one.
_SETTLED_WIDTH, _SETTLED_SIGMAS, _MOST_STEPS = 0.04, 1.5, 6
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


_NO_RANGE = "no stripe on the panel: the bright line leaves the squares"
_NO_RIDGE = "no stripe on the panel: the bright line is not a narrow ridge"
_TOO_FEW = "no stripe on the panel: too few profiles show it"
_TOO_ROUGH = "no usable stripe on the panel: what there is of it is too faint and rough to tell where it runs"
_NOT_NARROW = "the bright line on the panel is not the narrow straight line that a laser makes"


@dataclass(frozen=True, eq=False)
class _Curves:
    """v as a polynomial of u, one a band, in (u - middle) / half: coefficients (B, K), middle and half (B, 1)."""

    coefficients: FloatArray
    middle: FloatArray
    half: FloatArray

    def at(self, u: FloatArray) -> FloatArray:
        return _horner(self.coefficients, (u - self.middle) / self.half)

    def slope(self, u: FloatArray) -> FloatArray:
        derivative = self.coefficients[:, 1:] * np.arange(1, self.coefficients.shape[1]) / self.half
        return _horner(derivative, (u - self.middle) / self.half)

    def take(self, which: BoolArray) -> _Curves:
        return _Curves(self.coefficients[which], self.middle[which], self.half[which])


def _horner(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    value = np.broadcast_to(coefficients[:, -1:], x.shape)
    for k in range(coefficients.shape[1] - 2, -1, -1):
        value = value * x + coefficients[:, k : k + 1]
    return np.asarray(value)


@dataclass(frozen=True, eq=False)
class _Ranges:
    """Profiles of each band: whole coordinates u (B, N) along the stripe, and which of them are any (B, N)."""

    u: FloatArray
    valid: BoolArray

    def take(self, which: BoolArray) -> _Ranges:
        return _Ranges(self.u[which], self.valid[which])

    def thinned(self) -> _Ranges:
        """About `_FEW` profiles of each band, evenly spread."""
        count = np.count_nonzero(self.valid, axis=1)
        step = np.maximum(count // _FEW, 1)[:, None]
        index = np.arange(int((count[:, None] / step).max()) + 1) * step
        valid = index < count[:, None]
        return _Ranges(np.take_along_axis(self.u, np.where(valid, index, 0), axis=1), valid)


@dataclass(frozen=True, eq=False)
class _Bands:
    """Profiles along the stripes, as tables (P, B, N): what belongs to a profile, (B, N), combines with them as it is.

    u, valid : (B, N); v : (P, B, N) pixel coordinates; values, bright : grey levels; good : pixels that count;
    ambient : light that was taken out of the values; cosine, sine : (B, N) of the stripe's inclination;
    light : share of light surface that each pixel sees.
    """

    u: FloatArray
    valid: BoolArray
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
        return int(self.v.shape[0] // 2)


@dataclass(frozen=True, eq=False)
class _State:
    """height, centre, background : (B, N); width, dark_ratio : (B,); noise : (B, 3); information : (B, N) on the
    centre, 1 / px^2 along v."""

    height: FloatArray
    centre: FloatArray
    background: FloatArray
    width: FloatArray
    dark_ratio: FloatArray
    noise: FloatArray
    information: FloatArray


@dataclass(frozen=True, eq=False)
class _Smooth:
    """Smooth curves through the centres, the weight (B, N) that each profile is left with, and its residual (B, N).

    `problems` are why a band shows no stripe, empty where it does.
    """

    curves: _Curves
    weight: FloatArray
    residual: FloatArray
    problems: list[str]


@dataclass(frozen=True, eq=False)
class _Source:
    """Where the pixels come from: a panel, images of it whose stripes run the same way, and the sensor's limit."""

    view: PanelView
    images: Sequence[GrayImage]
    steep: bool
    limit: float

    def take(self, which: BoolArray) -> _Source:
        return replace(self, images=[image for image, taken in zip(self.images, which, strict=True) if taken])


def fit_stripes(
    view: PanelView, images: Sequence[GrayImage], lines: Sequence[CoarseLine], limit: float
) -> list[StripeFit | str]:
    """Fit the stripe near each image's line; `limit` is the grey level at which the sensor saturates.

    A string says why there is none.
    """
    found: list[StripeFit | str] = [_NO_RANGE] * len(images)
    for steep in (False, True):
        which = [k for k, line in enumerate(lines) if line.steep == steep]
        source = _Source(view, [images[k] for k in which], steep, limit)
        for k, fit in zip(which, _fit_alike(source, [lines[k] for k in which]), strict=True):
            found[k] = fit
    return found


def _fit_alike(source: _Source, lines: Sequence[CoarseLine]) -> list[StripeFit | str]:
    """The same for stripes that all run along x, or all along y."""
    found: list[StripeFit | str] = [_NO_RANGE] * len(lines)
    if not lines:
        return found
    share = np.array([line.ambient_share for line in lines])
    straight = _Curves(
        np.array([[line.intercept, line.slope] for line in lines]), np.zeros((len(lines), 1)), np.ones((len(lines), 1))
    )
    ranges = _usable_ranges(source.view, lines, straight)
    long_enough = ranges.valid.sum(axis=1) >= _MIN_POINTS
    alive = np.flatnonzero(long_enough)
    if len(alive) == 0:
        return found
    source, ranges, straight = source.take(long_enough), ranges.take(long_enough), straight.take(long_enough)
    few = ranges.thinned()
    half = np.full(len(alive), _FIRST_HALF)
    curves, width, is_ridge = _first_curves(_cut(source, few, straight, half), share[long_enough], straight)
    for k in alive[~is_ridge]:
        found[k] = _NO_RIDGE
    alive = alive[is_ridge]
    if len(alive) == 0:
        return found
    near = (source.take(is_ridge), ranges.take(is_ridge), few.take(is_ridge), curves.take(is_ridge))
    fits = _fit_near(*near, width[is_ridge])
    for k, fit in zip(alive, fits, strict=True):
        found[k] = fit
    return found


def _fit_near(
    source: _Source, ranges: _Ranges, few: _Ranges, curves: _Curves, width: FloatArray
) -> list[StripeFit | str]:
    """Fit bands about curves that are right to a pixel: some of the profiles first, then all."""
    albedo = source.view.albedo
    ratio = float(np.clip(np.median(albedo.dark / np.maximum(albedo.light, 1.0)), 0.02, 0.95))
    bands = _look_at_albedo(_bands_about(source, few, curves, width), source, curves, width)
    state = _start(bands, curves, width, np.full(len(width), ratio), None)
    state = _settle(bands, state, curves, learn_at=0, least=1)
    curves, ratios = _smooth(bands, state).curves, _dark_ratios(bands, state)
    bands = _look_at_albedo(_bands_about(source, ranges, curves, state.width), source, curves, state.width)
    state = _start(bands, curves, state.width, ratios, state.noise)
    state = _settle(bands, state, curves, learn_at=1, least=2)
    smooth = _smooth(bands, state)
    state = replace(state, dark_ratio=_dark_ratios(bands, state))
    return [problem or _points(bands, smooth, source.steep, state, b) for b, problem in enumerate(smooth.problems)]


def _settle(bands: _Bands, state: _State, curves: _Curves, *, learn_at: int, least: int) -> _State:
    """Steps until each band's width and centres stay; the noise is learnt from what is left before step `learn_at`.

    Two steps do for most; it is saturated stripes, of which only the skirts are seen, that take more. A band that has
    settled is left as it is, so that the others do not matter to it.
    """
    moving = np.ones(len(state.width), dtype=bool)
    for step in range(_MOST_STEPS):
        after = _step(bands, state, curves, learn=step == learn_at)
        settled = _has_settled(bands, state, after)
        state = after if moving.all() else _chosen(moving, after, state)
        if step + 1 >= least:
            moving = moving & ~settled
        if not moving.any():
            break
    return state


def _has_settled(bands: _Bands, before: _State, after: _State) -> BoolArray:
    """Whether the last step (B,) was so small that the next one would not matter."""
    moved = np.abs(after.centre - before.centre) * np.sqrt(after.information)
    small = _quantiles(moved, bands.valid, 0.5) < _SETTLED_SIGMAS
    return np.asarray(small & (np.abs(np.log(after.width / before.width)) < _SETTLED_WIDTH))


def _chosen(which: BoolArray, a: _State, b: _State) -> _State:
    """`a` for the bands in `which`, `b` for the others."""
    found = {}
    for entry in fields(_State):
        x, y = getattr(a, entry.name), getattr(b, entry.name)
        found[entry.name] = np.where(which if x.ndim == 1 else which[:, None], x, y)
    return _State(**found)


def _usable_ranges(view: PanelView, lines: Sequence[CoarseLine], curves: _Curves) -> _Ranges:
    """Whole u near the coarse lines' ranges whose centre lies in a usable square."""
    steep = lines[0].steep
    axis, across = (1, 0) if steep else (0, 1)
    slack = 4 * view.factor
    first = np.array([max(int(np.floor(line.start)) - slack, view.low[axis]) for line in lines])
    last = np.array([min(int(np.ceil(line.end)) + slack, view.high[axis] - 1) for line in lines])
    u = first[:, None] + np.arange(max(int((last - first).max()) + 1, 1), dtype=np.float64)
    v = curves.at(u)
    usable = (u <= last[:, None]) & (v > view.low[across] + 3) & (v < view.high[across] - 4)
    at = np.nonzero(usable)
    grid, _ = view.grid_and_slopes(_pixels(u[at], v[at], steep))
    usable[at] = view.albedo.is_usable(grid)
    # Usable ones to the front of each row; what fills it up repeats the first.
    count = usable.sum(axis=1)
    order = np.argsort(~usable, axis=1, kind="stable")[:, : max(int(count.max()), 1)]
    valid = np.arange(order.shape[1]) < count[:, None]
    return _Ranges(np.take_along_axis(u, np.where(valid, order, order[:, :1]), axis=1), valid)


def _pixels(u: FloatArray, v: FloatArray, steep: bool) -> FloatArray:
    return np.stack([v, u] if steep else [u, v], axis=-1)


def _cut(source: _Source, ranges: _Ranges, curves: _Curves, half: FloatArray) -> _Bands:
    """Profiles of 2 half + 1 pixels about the curves; `half` (B,) may differ from band to band."""
    view, steep = source.view, source.steep
    reach = int(half.max())
    offsets = np.arange(-reach, reach + 1)[:, None, None]
    v = np.rint(curves.at(ranges.u)).astype(np.intp) + offsets
    across = 0 if steep else 1
    safe = np.clip(v, view.low[across], view.high[across] - 1)
    along = ranges.u.astype(np.intp)
    rows, columns = (along, safe) if steep else (safe, along)
    index = rows * source.images[0].shape[1] + columns
    values = np.stack([image.take(index[:, b]) for b, image in enumerate(source.images)], axis=1)
    bright = view.bright.take((rows - view.low[1]) * view.bright.shape[1] + (columns - view.low[0]))
    within = ranges.valid & (np.abs(offsets) <= half[:, None])
    good = ((v == safe) & (values < 0.98 * source.limit) & within).astype(np.float32)
    slope = curves.slope(ranges.u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    values = values.astype(np.float32)
    nothing = np.zeros_like(values)
    return _Bands(
        ranges.u, ranges.valid, v.astype(np.float32), values, bright, good, nothing, cosine, slope * cosine, nothing
    )


def _half_heights(curves: _Curves, ranges: _Ranges, width: FloatArray) -> FloatArray:
    """Half-heights (B,) of bands that hold the profile and enough of its surroundings."""
    steepest = np.sqrt(1.0 + np.max(np.abs(curves.slope(ranges.u)), axis=1) ** 2)
    return np.asarray(np.clip(np.ceil(3.3 * width * steepest + 1.5), 4, 24))


def _bands_about(source: _Source, ranges: _Ranges, curves: _Curves, width: FloatArray) -> _Bands:
    """The bands about good curves, with the ambient light taken out and the first backgrounds."""
    bands = _cut(source, ranges, curves, _half_heights(curves, ranges, width))
    flank = bands.good * (np.abs(_distance(bands, curves.at(bands.u))) > _single(2.7 * width))
    ambient = _ambient(bands, flank, curves)
    return replace(bands, values=bands.values - ambient, ambient=ambient)


def _distance(bands: _Bands, centre: FloatArray) -> FloatArray:
    """Distance (P, B, N) of the pixels from the stripe's centre line."""
    return np.asarray((bands.v - _single(centre)) * _single(bands.cosine))


def _single(values: FloatArray) -> FloatArray:
    """Values of profiles (B, N), or of bands (B,), in the precision of the tables (P, B, N) they are used with."""
    single = np.asarray(values, dtype=np.float32)
    return single if single.ndim == 2 else single[:, None]


def _first_curves(bands: _Bands, share: FloatArray, straight: _Curves) -> tuple[_Curves, FloatArray, BoolArray]:
    """Curves within about a pixel, from the brightest pixel of each profile, the stripes' rough widths (B,), and
    whether there is a ridge at all (B,)."""
    rest = bands.values - _single(share) * bands.bright
    rest -= rest.mean(axis=0)
    smooth = rest.copy()
    smooth[1:-1] = 0.25 * rest[:-2] + 0.5 * rest[1:-1] + 0.25 * rest[2:]
    peak = np.argmax(smooth, axis=0)[None]
    height = np.take_along_axis(smooth, peak, axis=0)[0]
    v = np.take_along_axis(bands.v, peak, axis=0)[0].astype(np.float64)
    strong = bands.valid & (height > 0.4 * _quantiles(height, bands.valid, 0.75)[:, None])
    near, is_ridge, curves = strong, np.ones(len(v), dtype=bool), straight
    for reach in (8.0, 4.0, 2.5):
        near = strong & (np.abs(v - curves.at(bands.u)) <= reach)
        is_ridge &= np.count_nonzero(near, axis=1) >= _MIN_POINTS
        curves = _fit_curves(bands, v, near.astype(np.float64), 2)
    window = np.clip(peak + np.arange(-9, 10)[:, None, None], 0, len(rest) - 1)
    area = np.maximum(np.take_along_axis(rest, window, axis=0), 0.0).sum(axis=0) / np.maximum(height, 1e-3)
    cosine = 1.0 / np.sqrt(1.0 + curves.slope(bands.u) ** 2)
    # Speckle makes the highest pixel too high, by this much typically, and the width too small.
    width = 1.15 * _quantiles(area * cosine, near, 0.5) / np.sqrt(2.0 * np.pi)
    return curves, np.clip(width, 0.6, 6.0), is_ridge


def _fit_curves(
    bands: _Bands, v: FloatArray, weight: FloatArray, degree: int, cubic: BoolArray | None = None
) -> _Curves:
    """Weighted least squares; well conditioned in a coordinate from -1 to 1. Where not `cubic`, without the cube."""
    u = bands.u
    last = np.take_along_axis(u, np.maximum(bands.valid.sum(axis=1) - 1, 0)[:, None], axis=1)
    middle, half = 0.5 * (u[:, :1] + last), np.maximum(0.5 * (last - u[:, :1]), 1.0)
    s = (u - middle) / half
    powers = [np.ones_like(s), s]
    for _ in range(degree - 1):
        powers.append(powers[-1] * s)
    design = np.stack(powers, axis=1)
    weighted = design * weight[:, None]
    normal = weighted @ design.swapaxes(1, 2)
    trace = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-30)
    normal += np.eye(degree + 1) * (1e-12 * trace)[:, None, None]
    if cubic is not None:
        normal[:, 3, 3] += np.where(cubic, 0.0, 1e9 * trace)
    return _Curves(np.linalg.solve(normal, weighted @ v[..., None])[..., 0], middle, half)


def _quantile(values: FloatArray, share: float) -> float:
    """As numpy's, to the nearest value, without its checks."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])


def _quantiles(values: FloatArray, which: BoolArray, share: float) -> FloatArray:
    """The same (B,) for each row of `values` (B, N), of those in `which` (B, N); infinite where there are none."""
    count = np.count_nonzero(which, axis=1)
    k = (share * np.maximum(count - 1, 0)).astype(np.intp)
    ordered = np.sort(np.where(which, values, np.inf), axis=1)
    return np.asarray(np.take_along_axis(ordered, k[:, None], axis=1)[:, 0], dtype=np.float64)


def _spreads(values: FloatArray, which: BoolArray) -> FloatArray:
    """Robust standard deviation about zero of each row; infinite where `which` has none."""
    return MAD_TO_SIGMA * _quantiles(np.abs(values), which, 0.5)


def _start(bands: _Bands, curves: _Curves, width: FloatArray, ratio: FloatArray, noise: FloatArray | None) -> _State:
    """Heights and backgrounds by least squares with all else as given; a guess of the noise from the pixels beside."""
    centre = curves.at(bands.u)
    distance = _distance(bands, centre) * _single(1.0 / width)
    bell = np.exp(np.float32(-0.5) * distance * distance) * (_single(ratio) + _single(1.0 - ratio) * bands.light)
    weighted = bands.good * bell
    n, b, v = (np.einsum("pbn,pbn->bn", bands.good, x) for x in (np.ones_like(bell), bell, bands.values))
    bb, bv = (np.einsum("pbn,pbn->bn", weighted, x) for x in (bell, bands.values))
    det = np.maximum(n * bb - b * b, 1e-3)
    height = np.maximum((n * bv - b * v) / det, 1.0)
    background = (v - height * b) / np.maximum(n, 1.0)
    if noise is None:
        flank = bands.good * (np.abs(distance) > 2.7)
        rest = np.abs(bands.values - _single(background)) * flank
        reading = 1.25 * rest.sum(axis=(0, 2)) / np.maximum(flank.sum(axis=(0, 2)), 1.0)
        noise = np.stack([np.maximum(reading, 0.3) ** 2, np.zeros(len(ratio)), np.zeros(len(ratio))], axis=1)
    return _State(height, centre, background, width, ratio, noise, np.ones_like(centre))


def _ambient(bands: _Bands, flank: FloatArray, curves: _Curves) -> FloatArray:
    """The bright image times a share that changes slowly along the stripe, from the pixels beside it (`flank`)."""
    count = np.maximum(flank.sum(axis=0), 1.0)
    values, bright = (flank * (x - (x * flank).sum(axis=0) / count) for x in (bands.values, bands.bright))
    s = (bands.u - curves.middle) / curves.half
    powers = np.stack([np.ones_like(s), s, s**2], axis=2)
    own, cross = np.einsum("pbn,pbn->bn", bright, bright), np.einsum("pbn,pbn->bn", bright, values)
    normal = (powers * own[..., None]).swapaxes(1, 2) @ powers
    # Flat profiles tell nothing: a weak pull towards no ambient light.
    normal += np.eye(3) * (1e-6 * np.trace(normal, axis1=1, axis2=2) + 1.0)[:, None, None]
    share = np.linalg.solve(normal, powers.swapaxes(1, 2) @ cross[..., None].astype(np.float64))
    return np.asarray(_single((powers @ share)[..., 0]) * bands.bright)


def _look_at_albedo(bands: _Bands, source: _Source, curves: _Curves, width: FloatArray) -> _Bands:
    """Share of light surface that each pixel sees through stripe and lens (see `laser_stripe`)."""
    view, steep = source.view, source.steep
    albedo = view.albedo
    centre, slope = curves.at(bands.u), curves.slope(bands.u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    sine = slope * cosine
    grid, slopes = view.grid_and_slopes(_pixels(bands.u, centre, steep))
    by_u, by_v = (slopes[..., 1::2], slopes[..., ::2]) if steep else (slopes[..., ::2], slopes[..., 1::2])
    across = by_v * cosine[..., None] - by_u * sine[..., None]
    along = by_u * cosine[..., None] + by_v * sine[..., None]
    blur2 = np.minimum(albedo.blur_px, width) ** 2
    thickness = (1.0 - blur2 / width**2)[:, None]
    edges = np.sqrt(blur2[:, None, None] * (thickness[..., None] * across**2 + along**2))
    # A pixel at (0, dv) from the centre is seen at dv along the stripe's tangent plus `thickness` of it across.
    dv = bands.v - _single(centre)
    per_v = by_v * (cosine**2 * thickness + sine**2)[..., None]
    per_v = per_v + by_u * ((1.0 - thickness) * cosine * sine)[..., None]
    inside = _inside_squares(view, grid, across, width)
    x, y = (dv * _single(per_v[..., k]) + _single(grid[..., k]) for k in (0, 1))
    light = albedo.light_share(x, y, _single(edges[..., 0]), _single(edges[..., 1]))
    return replace(bands, cosine=cosine, sine=sine, light=light, good=bands.good * inside)


def _inside_squares(view: PanelView, grid: FloatArray, across: FloatArray, width: FloatArray) -> FloatArray:
    """1 for profiles (B, N) whose light falls on usable squares alone: what lies around the board is not known.

    `across` (B, N, 2) is the change of the grid coordinates by a pixel across the stripe.
    """
    usable = view.albedo.is_usable
    reach = 2.5 * width[:, None, None] * across
    return (usable(grid) & usable(grid - reach) & usable(grid + reach)).astype(np.float32)


def _step(bands: _Bands, state: _State, curves: _Curves, *, learn: bool) -> _State:
    """One Gauss-Newton step; with `learn`, the noise is learnt again first."""
    distance = _distance(bands, state.centre) * _single(1.0 / state.width)
    squared = distance * distance
    bell = np.exp(np.float32(-0.5) * squared)
    ratio, height = _single(state.dark_ratio), _single(state.height)
    by_height = bell * (ratio + (1 - ratio) * bands.light)
    signal = height * by_height
    residual = bands.values - _single(state.background) - signal
    level = np.maximum(bands.values + bands.ambient, np.float32(0.0))
    noise = _learn_noise(residual, level, signal, bands.good, state.noise) if learn else state.noise
    variance = _single(noise[:, 0]) + _single(noise[:, 1]) * level + _single(noise[:, 2]) * signal * signal
    weight = bands.good / variance
    J = [
        np.ones_like(signal),
        by_height,
        signal * distance * _single(bands.cosine / state.width[:, None]),
        signal * squared,
    ]
    M = _normal_equations(J, residual, weight)
    M[_BACKGROUND][0] += 1e-9
    M[_HEIGHT][0] += 1e-9
    M[_CENTRE][0] += 1.0 / _PULL_PX**2
    M[_CENTRE][-1] += (curves.at(bands.u) - state.centre) / _PULL_PX**2
    change, by_width, information = _solve(M)
    return _State(
        np.maximum(state.height + change[_HEIGHT], 1e-3),
        state.centre + np.clip(change[_CENTRE], -1.0, 1.0),
        state.background + change[_BACKGROUND],
        np.clip(state.width * np.exp(by_width), 0.4, 10.0),
        state.dark_ratio,
        noise,
        information,
    )


def _normal_equations(J: Sequence[FloatArray], residual: FloatArray, weight: FloatArray) -> list[FloatArray]:
    """Upper triangle, row by row, of the sums over each profile of weight * J_i * J_j; last in each row, the residual.

    Row i is an array (k - i + 1, B, N) of k unknowns' products, from the diagonal on.
    """
    rows: list[FloatArray] = []
    for i in range(len(J)):
        weighted = J[i] * weight
        products = [np.einsum("pbn,pbn->bn", weighted, other) for other in (*J[i:], residual)]
        rows.append(np.stack(products).astype(np.float64))
    return rows


def _solve(rows: list[FloatArray]) -> tuple[list[FloatArray], FloatArray, FloatArray]:
    """Changes (B, N) of the profiles' own unknowns, (B,) of the width's logarithm, and the centres' information (B, N).

    Gauss's elimination of each profile's own unknowns, what is left summed over the profiles. `rows` are used up.
    """
    for k in range(_WIDTH):
        share = rows[k][1:-1] / rows[k][0]
        for i in range(k + 1, len(rows)):
            rows[i] -= share[i - k - 1] * rows[k][i - k :]
    normal, goal = rows[_WIDTH].sum(axis=-1)
    by_width = np.clip(goal / (normal + 1e-6), -0.3, 0.3)
    changes: list[FloatArray] = [np.zeros(0)] * _WIDTH
    for k in reversed(range(_WIDTH)):
        value = rows[k][-1] - rows[k][_WIDTH - k] * by_width[:, None]
        for j in range(k + 1, _WIDTH):
            value = value - rows[k][j - k] * changes[j]
        changes[k] = value / rows[k][0]
    return changes, by_width, np.asarray(rows[_CENTRE][0])


def _dark_ratios(bands: _Bands, state: _State) -> FloatArray:
    """Light (B,) that dark squares send back against light ones, at the laser's colour: from the profiles wholly on
    either.

    Not fitted with the rest: its product with the heights makes a bad start worse.
    """
    share = bands.light[bands.half]
    on_light, on_dark = bands.valid & (share > 0.98), bands.valid & (share < 0.02)
    enough = np.minimum(np.count_nonzero(on_light, axis=1), np.count_nonzero(on_dark, axis=1)) >= 20
    light, dark = (_quantiles(state.height, which, 0.5) for which in (on_light, on_dark))
    seen = state.dark_ratio * np.where(enough, dark, 1.0) / np.where(enough, light, 1.0)
    return np.where(enough, np.clip(seen, 0.01, 1.0), state.dark_ratio)


def _learn_noise(
    residual: FloatArray, level: FloatArray, signal: FloatArray, good: FloatArray, before: FloatArray
) -> FloatArray:
    """Variance as r^2 + g * level + s^2 * signal^2 (all >= 0), from residuals sorted into bins by the signal."""
    bins = [_noise_bins(*(x[:, b].ravel() for x in (residual, level, signal, good))) for b in range(len(before))]
    learnt = np.array([b for b, found in enumerate(bins) if found is not None], dtype=np.intp)
    noise = before.copy()
    if len(learnt):
        variance, by_level, by_signal = np.stack([found for found in bins if found is not None], axis=1)
        design = np.stack([np.ones_like(variance), by_level, by_signal], axis=-1)
        noise[learnt] = _not_negative(design / variance[..., None], np.ones_like(variance))
        noise[learnt, 0] = np.maximum(noise[learnt, 0], 0.05)
    return noise


def _noise_bins(residual: FloatArray, level: FloatArray, signal: FloatArray, good: FloatArray) -> FloatArray | None:
    """Variance, mean level and mean squared signal (3, bins) of one band's pixels; None if they are too few."""
    some = np.flatnonzero(good)
    some = some[:: max(len(some) // _NOISE_SAMPLES, 1)]
    if len(some) < 12 * _NOISE_BINS:
        return None
    some = some[: len(some) // _NOISE_BINS * _NOISE_BINS]
    some = some[np.argsort(signal[some])]
    error, level, signal = (x[some].reshape(_NOISE_BINS, -1) for x in (np.abs(residual), level, signal))
    # Medians are deaf to what does not belong; a sixth of the freedom went into the fit.
    middle = error.shape[1] // 2
    variance = np.maximum(1.2 * (MAD_TO_SIGMA * np.partition(error, middle, axis=1)[:, middle]) ** 2, 0.05)
    return np.stack([variance, level.mean(axis=1), (signal**2).mean(axis=1)])


def _not_negative(design: FloatArray, goal: FloatArray) -> FloatArray:
    """Least squares (B, k) with no unknown below zero, k small, for design (B, M, k) and goal (B, M).

    The best of all choices of the unknowns that are zero.
    """
    count = design.shape[-1]
    free = np.array(list(product((0.0, 1.0), repeat=count)))[:, None]
    scale = np.maximum(np.linalg.norm(design, axis=1), 1e-30)
    A = design / scale[:, None]
    normal, right = A.swapaxes(1, 2) @ A, (A.swapaxes(1, 2) @ goal[..., None])[..., 0]
    # Unknowns that are held at zero get the equation x = 0; the tiny part keeps equal columns solvable.
    both = free[..., None] * free[..., None, :]
    systems = normal * both + np.eye(count) * (1.0 - free[..., None] + 1e-12)
    found = np.linalg.solve(systems, (right * free)[..., None])[..., 0]
    rest = ((np.einsum("bmk,cbk->cbm", A, found) - goal) ** 2).sum(axis=-1)
    rest = np.where(found.min(axis=-1) >= 0.0, rest, np.inf)
    best = np.argmin(rest, axis=0)
    return np.asarray(found[best, np.arange(len(best))] / scale)


def _smooth(bands: _Bands, state: _State) -> _Smooth:
    """Smooth curves through the centres, robust against the profiles that show something else."""
    sigma = 1.0 / np.sqrt(state.information)
    known = bands.valid & (sigma * bands.cosine < _WORST_SIGMA_PX)
    weight = np.where(known, state.information, 0.0)
    robust = weight
    cubic = np.count_nonzero(known, axis=1) > 60
    enough = np.ones(len(sigma), dtype=bool)
    for _ in range(3):
        enough &= np.count_nonzero(robust, axis=1) >= _MIN_POINTS
        curves = _fit_curves(bands, state.centre, robust, 3, cubic)
        residual = state.centre - curves.at(bands.u)
        standardised = residual / sigma
        scale = np.maximum(np.where(enough, _spreads(standardised, known), 1.0), 1.0)[:, None]
        robust = weight * tukey_weights(standardised / scale)
    kept = np.where(np.abs(standardised) < 4.0 * scale, weight, 0.0)
    narrow = _spreads(residual * bands.cosine, kept > 0) < 0.5 * np.maximum(state.width, 1.0)
    problems = [_TOO_FEW if not e else "" if n else _NOT_NARROW for e, n in zip(enough, narrow, strict=True)]
    return _Smooth(curves, kept, residual, problems)


def _points(bands: _Bands, smooth: _Smooth, steep: bool, state: _State, b: int) -> StripeFit | str:
    """Merge blocks of neighbouring profiles of band `b`; their scatter about the curve corrects what the noise model
    states."""
    valid = bands.valid[b]
    weight = smooth.weight[b, valid]
    length = _BLOCK if np.count_nonzero(weight) > _SHORT else _BLOCK // 2
    block = np.floor(bands.u[b, valid] / length).astype(int)
    block -= block[0]
    total = np.bincount(block, weight)
    enough = (np.bincount(block, weight > 0) >= length // 2) & (total > 0)
    safe = np.where(enough, total, 1.0)
    columns = (x[b, valid] for x in (bands.u, smooth.residual, bands.cosine, bands.sine))
    u, offset, cosine, sine = ((np.bincount(block, weight * x) / safe)[enough] for x in columns)
    sigma = 1.0 / np.sqrt(total[enough])
    if len(u) < _MIN_POINTS:
        return _TOO_FEW
    freedom = np.sqrt(max(len(u) - 4, 1) / len(u))
    inflation = max(MAD_TO_SIGMA * _quantile(np.abs(offset / sigma), 0.5) / freedom, 1.0)
    norm = np.hypot(cosine, sine)
    cosine, sine = cosine / norm, sine / norm
    sigma = np.hypot(sigma * inflation, _MODEL_SIGMA_PX) * cosine
    # Points on dark squares beside points on light ones: a hundredth of their weight, and mostly trouble.
    best = _quantile(sigma, 0.2)
    worth = sigma < np.clip(8.0 * best, 0.1, _WORST_SIGMA_PX)
    if np.count_nonzero(worth) < max(_MIN_POINTS, len(u) // 2):
        return _TOO_ROUGH
    u, offset, cosine, sine, sigma = u[worth], offset[worth], cosine[worth], sine[worth], sigma[worth]
    normals = np.stack([cosine, -sine] if steep else [-sine, cosine], axis=-1)
    only = np.arange(len(smooth.problems)) == b
    v = smooth.curves.take(only).at(u[None])[0] + offset
    points = StripePoints(_pixels(u, v, steep), normals, sigma)
    return StripeFit(points, float(state.width[b]), float(state.dark_ratio[b]), inflation)
