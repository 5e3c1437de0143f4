"""Narrow bands of pixels along the stripes of one panel, cut from several images at once, and curves through them.

Tables of B bands, N profiles each and P pixels a profile. P comes first: NumPy is fast along the last axis, profiles
are short. Several bands at once, because single ones are so small that calling NumPy would take most of the time.
Shorter bands are filled up with profiles that are not `valid`, and nothing passes from one band to another. Single
precision, where there is a number for each pixel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from lidarpose.detect.albedo import MARGIN, PanelAlbedo, edge_scale, erf_table
from lidarpose.detect.stripe_search import KERNELS, NODE_STEP, CoarseLine, PanelView
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import MAD_TO_SIGMA
from lidarpose.model.image import GrayImage

# Pixels above this share of the sensor's limit are saturated.
_BELOW_LIMIT = 0.98
# Profiles of a band, about, that the width, the squares' colours and a first curve are found from.
_FEW = 150


@dataclass(frozen=True, eq=False)
class Curves:
    """v as a polynomial of u, one a band, in (u - middle) / half: coefficients (B, K), middle and half (B, 1)."""

    coefficients: FloatArray
    middle: FloatArray
    half: FloatArray

    def at(self, u: FloatArray) -> FloatArray:
        return _horner(self.coefficients, (u - self.middle) / self.half)

    def slope(self, u: FloatArray) -> FloatArray:
        derivative = self.coefficients[:, 1:] * np.arange(1, self.coefficients.shape[1]) / self.half
        return _horner(derivative, (u - self.middle) / self.half)

    def take(self, which: BoolArray) -> Curves:
        return Curves(self.coefficients[which], self.middle[which], self.half[which])


def _horner(coefficients: FloatArray, x: FloatArray) -> FloatArray:
    value = coefficients[:, -1:]
    for k in range(coefficients.shape[1] - 2, -1, -1):
        value = value * x
        value += coefficients[:, k : k + 1]
    return np.asarray(value) if value.shape == x.shape else np.repeat(value, x.shape[1], axis=1)


@dataclass(frozen=True, eq=False)
class Ranges:
    """Profiles of each band: whole coordinates u (B, N) along the stripe, and which of them are any (B, N)."""

    u: FloatArray
    valid: BoolArray

    def take(self, which: BoolArray) -> Ranges:
        return Ranges(self.u[which], self.valid[which])

    def thinned(self) -> Ranges:
        """About `_FEW` profiles of each band, evenly spread."""
        count = np.count_nonzero(self.valid, axis=1)
        step = np.maximum(count // _FEW, 1)[:, None]
        index = np.arange(int((count[:, None] / step).max()) + 1) * step
        valid = index < count[:, None]
        return Ranges(np.take_along_axis(self.u, np.where(valid, index, 0), axis=1), valid)


@dataclass(frozen=True, eq=False)
class Bands:
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
class Source:
    """Where the pixels come from: a panel, images of it whose stripes run the same way, and the sensor's limit."""

    view: PanelView
    images: Sequence[GrayImage]
    steep: bool
    limit: float

    def take(self, which: BoolArray) -> Source:
        return replace(self, images=[image for image, taken in zip(self.images, which, strict=True) if taken])


def usable_ranges(view: PanelView, lines: Sequence[CoarseLine], curves: Curves) -> Ranges:
    """Whole u near the coarse lines' ranges whose centre lies in a usable square."""
    steep = lines[0].steep
    axis, across = (1, 0) if steep else (0, 1)
    slack = 4 * view.factor
    first = np.array([max(int(np.floor(line.start)) - slack, view.low[axis]) for line in lines])
    last = np.array([min(int(np.ceil(line.end)) + slack, view.high[axis] - 1) for line in lines])
    size = max(int((last - first).max()) + 1, 1)
    if pays(0.0, KERNELS):
        return _usable_ranges_compiled(view, curves, steep, first, last, size)
    u = first[:, None] + np.arange(size, dtype=np.float64)
    v = curves.at(u)
    usable = (u <= last[:, None]) & (v > view.low[across] + 3) & (v < view.high[across] - 4)
    at = np.nonzero(usable)
    usable[at] = view.albedo.is_usable(view.grid_at(as_pixels(u[at], v[at], steep)))
    # Usable ones to the front of each row; what fills it up repeats the first.
    count = usable.sum(axis=1)
    order = np.argsort(~usable, axis=1, kind="stable")[:, : max(int(count.max()), 1)]
    valid = np.arange(order.shape[1]) < count[:, None]
    return Ranges(np.take_along_axis(u, np.where(valid, order, order[:, :1]), axis=1), valid)


def _usable_ranges_compiled(
    view: PanelView, straight: Curves, steep: bool, first: IntArray, last: IntArray, size: int
) -> Ranges:
    """`usable_ranges` by kernels; `size` is how many there are at most."""
    from lidarpose.detect import stripe_kernels

    u = np.empty((len(first), size))
    count = stripe_kernels.usable_ranges(
        *_nodes_and_board(view), view.high, first, last, straight.coefficients, steep, u
    )
    u = u[:, : max(int(count.max()), 1)]
    valid = np.arange(u.shape[1]) < count[:, None]
    return Ranges(np.where(valid, u, u[:, :1]), valid)


def _nodes_and_board(view: PanelView) -> tuple[tuple[Any, ...], tuple[Any, ...], float]:
    """A panel's nodes and usable squares, and where they begin, as kernels take them."""
    albedo, (rows, columns) = view.albedo, view.nodes.shape[:2]
    nodes = (view.nodes_and_slopes, rows, columns, NODE_STEP, view.low)
    return nodes, (albedo.grid_map.columns + MARGIN, albedo.grid_map.rows + MARGIN, albedo.usable), -1.0 - MARGIN


def as_pixels(u: FloatArray, v: FloatArray, steep: bool) -> FloatArray:
    return np.stack([v, u] if steep else [u, v], axis=-1)


def cut(source: Source, ranges: Ranges, curves: Curves, half: FloatArray) -> Bands:
    """Profiles of 2 half + 1 pixels about the curves; `half` (B,) may differ from band to band."""
    slope = curves.slope(ranges.u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    v, values, bright, good = (_cut_compiled if pays(0.0, KERNELS) else _cut)(source, ranges, curves.at(ranges.u), half)
    nothing = np.zeros_like(values)
    return Bands(ranges.u, ranges.valid, v, values, bright, good, nothing, cosine, slope * cosine, nothing)


_Tables = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Pixel coordinates, values, the bright image, and which count: (P, B, N), float32."""


def _cut(source: Source, ranges: Ranges, centre: FloatArray, half: FloatArray) -> _Tables:
    view, steep = source.view, source.steep
    reach = int(half.max())
    offsets = np.arange(-reach, reach + 1)[:, None, None]
    v = np.rint(centre).astype(np.intp) + offsets
    across = 0 if steep else 1
    safe = np.clip(v, view.low[across], view.high[across] - 1)
    along = ranges.u.astype(np.intp)
    rows, columns = (along, safe) if steep else (safe, along)
    index = rows * source.images[0].shape[1] + columns
    values = np.stack([image.take(index[:, b]) for b, image in enumerate(source.images)], axis=1)
    bright = view.bright.take((rows - view.low[1]) * view.bright.shape[1] + (columns - view.low[0]))
    within = ranges.valid & (np.abs(offsets) <= half[:, None])
    good = ((v == safe) & (values < _BELOW_LIMIT * source.limit) & within).astype(np.float32)
    return v.astype(np.float32), values.astype(np.float32), bright, good


def _cut_compiled(source: Source, ranges: Ranges, centre: FloatArray, half: FloatArray) -> _Tables:
    """`_cut` by kernels."""
    from lidarpose.detect import stripe_kernels

    view, reach = source.view, int(half.max())
    v, values, bright, good = (np.empty((2 * reach + 1, *centre.shape), np.float32) for _ in range(4))
    for b, image in enumerate(source.images):
        where = (source.steep, view.low, view.high, _BELOW_LIMIT * source.limit, b)
        profiles = (ranges.u, centre, ranges.valid, int(half[b]), reach)
        stripe_kernels.cut_band(image, view.bright, *where, *profiles, v, values, bright, good)
    return v, values, bright, good


def _half_heights(curves: Curves, ranges: Ranges, width: FloatArray) -> FloatArray:
    """Half-heights (B,) of bands that hold the profile and enough of its surroundings."""
    steepest = np.sqrt(1.0 + np.max(np.abs(curves.slope(ranges.u)), axis=1) ** 2)
    return np.asarray(np.clip(np.ceil(3.3 * width * steepest + 1.5), 4, 24))


def bands_about(source: Source, ranges: Ranges, curves: Curves, width: FloatArray) -> Bands:
    """The bands about good curves, with the ambient light taken out and the first backgrounds."""
    bands = cut(source, ranges, curves, _half_heights(curves, ranges, width))
    own, cross = _ambient_products(bands, curves.at(bands.u), 2.7 * width)
    if pays(0.0, KERNELS):
        from lidarpose.detect import stripe_profile_kernels

        values, ambient = bands.values.copy(), np.empty_like(bands.values)
        where = (bands.u, curves.middle, curves.half, bands.bright)
        stripe_profile_kernels.take_out(own, cross, *where, values, ambient)
    else:
        ambient = _ambient(bands, own, cross, curves)
        values = bands.values - ambient
    return replace(bands, values=values, ambient=ambient)


def distance_from(bands: Bands, centre: FloatArray) -> FloatArray:
    """Distance (P, B, N) of the pixels from the stripe's centre line."""
    return np.asarray((bands.v - for_table(centre)) * for_table(bands.cosine))


def for_table(values: FloatArray) -> FloatArray:
    """Values of profiles (B, N), or of bands (B,), in the precision of the tables (P, B, N) they are used with."""
    single = np.asarray(values, dtype=np.float32)
    return single if single.ndim == 2 else single[:, None]


@dataclass(frozen=True, eq=False)
class Powers:
    """Powers (B, degree + 1, N) of u, in (u - middle) / half: what `fit_curves` fits with, several times."""

    values: FloatArray
    middle: FloatArray
    half: FloatArray

    @staticmethod
    def of(bands: Bands, degree: int) -> Powers:
        u = bands.u
        last = u[np.arange(len(u)), np.maximum(np.count_nonzero(bands.valid, axis=1) - 1, 0)][:, None]
        middle, half = 0.5 * (u[:, :1] + last), np.maximum(0.5 * (last - u[:, :1]), 1.0)
        values = np.empty((len(u), degree + 1, u.shape[1]))
        values[:, 0] = 1.0
        values[:, 1] = (u - middle) / half
        for k in range(2, degree + 1):
            np.multiply(values[:, k - 1], values[:, 1], out=values[:, k])
        return Powers(values, middle, half)


def fit_curves(powers: Powers, v: FloatArray, weight: FloatArray, cubic: BoolArray | None = None) -> Curves:
    """Weighted least squares; well conditioned in a coordinate from -1 to 1. Where not `cubic`, without the cube."""
    size = powers.values.shape[1]
    weighted = powers.values * weight[:, None]
    normal = weighted @ powers.values.swapaxes(1, 2)
    trace = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-30)
    normal += np.eye(size) * (1e-12 * trace)[:, None, None]
    if cubic is not None:
        normal[:, 3, 3] += np.where(cubic, 0.0, 1e9 * trace)
    return Curves(np.linalg.solve(normal, weighted @ v[..., None])[..., 0], powers.middle, powers.half)


def quantile(values: FloatArray, share: float) -> float:
    """As numpy's, to the nearest value, without its checks."""
    k = int(share * (len(values) - 1))
    return float(np.partition(values, k)[k])


def quantiles(values: FloatArray, which: BoolArray, share: float) -> FloatArray:
    """The same (B,) for each row of `values` (B, N), of those in `which` (B, N); infinite where there are none."""
    count = np.count_nonzero(which, axis=1)
    k = (share * np.maximum(count - 1, 0)).astype(np.intp)
    ordered = np.sort(np.where(which, values, np.inf), axis=1)
    return np.asarray(ordered[np.arange(len(k)), k], dtype=np.float64)


def spreads(values: FloatArray, which: BoolArray) -> FloatArray:
    """Robust standard deviation about zero of each row; infinite where `which` has none."""
    return MAD_TO_SIGMA * quantiles(np.abs(values), which, 0.5)


def _ambient(bands: Bands, own: FloatArray, cross: FloatArray, curves: Curves) -> FloatArray:
    """The bright image times a share that changes slowly along the stripe, from `_ambient_products`."""
    s = (bands.u - curves.middle) / curves.half
    powers = np.stack([np.ones_like(s), s, s**2], axis=2)
    normal = (powers * own[..., None]).swapaxes(1, 2) @ powers
    # Flat profiles tell nothing: a weak pull towards no ambient light.
    normal += np.eye(3) * (1e-6 * np.trace(normal, axis1=1, axis2=2) + 1.0)[:, None, None]
    share = np.linalg.solve(normal, powers.swapaxes(1, 2) @ cross[..., None].astype(np.float64))
    return np.asarray(for_table((powers @ share)[..., 0]) * bands.bright)


def _ambient_products(bands: Bands, centre: FloatArray, beyond: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Sums (B, N) of bright * bright and bright * values over the pixels beside the stripe, both less their means."""
    if pays(0.0, KERNELS):
        from lidarpose.detect import stripe_kernels

        own, cross = np.empty(centre.shape, np.float32), np.empty(centre.shape, np.float32)
        profiles = (for_table(centre), for_table(bands.cosine), np.asarray(beyond, dtype=np.float32))
        stripe_kernels.ambient_products(bands.v, bands.values, bands.bright, bands.good, *profiles, own, cross)
        return own, cross
    flank = bands.good * (np.abs(distance_from(bands, centre)) > for_table(beyond))
    count = np.maximum(flank.sum(axis=0), 1.0)
    values, bright = (flank * (x - (x * flank).sum(axis=0) / count) for x in (bands.values, bands.bright))
    return np.einsum("pbn,pbn->bn", bright, bright), np.einsum("pbn,pbn->bn", bright, values)


_Two = tuple[FloatArray, ...]
"""Tables (B, N), float32, for x and for y."""


def look_at_albedo(bands: Bands, source: Source, curves: Curves, width: FloatArray) -> Bands:
    """Share of light surface that each pixel sees through stripe and lens (see `laser_stripe`)."""
    centre, slope = curves.at(bands.u), curves.slope(bands.u)
    cosine = 1.0 / np.sqrt(1.0 + slope**2)
    sine = slope * cosine
    squares = (_squares_compiled if pays(0.0, KERNELS) else _squares)(source, bands.u, centre, cosine, sine, width)
    light = _light_shares(bands, source.view.albedo, for_table(centre), *squares[:3])
    return replace(bands, cosine=cosine, sine=sine, light=light, good=bands.good * squares[3])


def _squares(
    source: Source, u: FloatArray, centre: FloatArray, cosine: FloatArray, sine: FloatArray, width: FloatArray
) -> tuple[_Two, _Two, _Two, FloatArray]:
    """Grid coordinates at the centres, their change by a pixel along v, the edges' blur, and whether all light falls
    on usable squares (1, or 0: what lies around the board is not known); float32."""
    view, steep = source.view, source.steep
    grid, slopes = view.grid_and_slopes(as_pixels(u, centre, steep))
    by_u, by_v = (slopes[..., 1::2], slopes[..., ::2]) if steep else (slopes[..., ::2], slopes[..., 1::2])
    across = by_v * cosine[..., None] - by_u * sine[..., None]
    along = by_u * cosine[..., None] + by_v * sine[..., None]
    blur2 = np.minimum(view.albedo.blur_px, width) ** 2
    thickness = (1.0 - blur2 / width**2)[:, None]
    edges = np.sqrt(blur2[:, None, None] * (thickness[..., None] * across**2 + along**2))
    # A pixel at (0, dv) from the centre is seen at dv along the stripe's tangent plus `thickness` of it across.
    per_v = by_v * (cosine**2 * thickness + sine**2)[..., None]
    per_v = per_v + by_u * ((1.0 - thickness) * cosine * sine)[..., None]
    usable = view.albedo.is_usable
    reach = 2.5 * width[:, None, None] * across
    inside = (usable(grid) & usable(grid - reach) & usable(grid + reach)).astype(np.float32)
    first, second, third = (tuple(for_table(t[..., k]) for k in (0, 1)) for t in (grid, per_v, edges))
    return first, second, third, inside


def _squares_compiled(
    source: Source, u: FloatArray, centre: FloatArray, cosine: FloatArray, sine: FloatArray, width: FloatArray
) -> tuple[_Two, _Two, _Two, FloatArray]:
    """`_squares` by kernels."""
    from lidarpose.detect import stripe_kernels

    grid, per_v, edges = (np.empty((2, *u.shape), np.float32) for _ in range(3))
    inside = np.empty(u.shape, np.float32)
    profiles = (u, centre, cosine, sine, width, source.view.albedo.blur_px, source.steep)
    stripe_kernels.squares(*_nodes_and_board(source.view), *profiles, grid, per_v, edges, inside)
    return tuple(grid), tuple(per_v), tuple(edges), inside


def _light_shares(
    bands: Bands, albedo: PanelAlbedo, centre: FloatArray, grid: _Two, per_v: _Two, edges: _Two
) -> FloatArray:
    """Share of light surface (P, B, N) at pixels; `grid` at the centre, its change `per_v`, and the edges' blur."""
    # No pixel of a band is further from the centre than this.
    reach = bands.half + 1.0
    x_range, y_range = ((g - reach * np.abs(d), g + reach * np.abs(d)) for g, d in zip(grid, per_v, strict=True))
    near = albedo.near_ends(x_range, y_range, edges)
    if pays(0.0, KERNELS):
        from lidarpose.detect import stripe_kernels

        scales = np.stack([edge_scale(edge) for edge in edges])
        light = np.empty_like(bands.v)
        size = np.array([albedo.grid_map.columns, albedo.grid_map.rows], dtype=np.float32)
        places = (centre, np.stack(grid), np.stack(per_v), scales, size)
        stripe_kernels.light_shares(bands.v, *places, near, albedo.first_is_dark, erf_table(), light)
        return light
    dv = bands.v - centre
    x, y = (dv * d + g for g, d in zip(grid, per_v, strict=True))
    return albedo.light_share(x, y, *edges, near=near)
