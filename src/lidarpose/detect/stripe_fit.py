"""The stripe's centre line to a few hundredths of a pixel, fitted in a narrow band of the raw image.

See `laser_stripe` for the model. Here the image is looked at along a scan coordinate u (x, or y for steep stripes), one
profile in v for each whole u. Each profile has its own height, centre, background and shift of the squares' edges
(known to some hundredths of a pixel only: this is what limits points beside an edge); the stripe's width and how much
light dark squares send back are common to all. Gauss and Newton's method, all profiles at once; the common unknowns by
elimination of the others. The noise's variance, r^2 + g * level + (s * signal)^2 (reading, shots, speckle), is learnt
from the residuals.

The images of one panel are fitted several at once: see `stripe_bands` for the tables.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields, replace

import numpy as np

from lidarpose.detect.stripe_bands import (
    Bands,
    Curves,
    Powers,
    Ranges,
    Source,
    bands_about,
    cut,
    distance_from,
    fit_curves,
    for_table,
    look_at_albedo,
    quantiles,
    usable_ranges,
)
from lidarpose.detect.stripe_noise import NOISE_SAMPLES, Samples, learn_noise
from lidarpose.detect.stripe_points import MIN_POINTS, State, StripeFit, merged, smoothed
from lidarpose.detect.stripe_search import KERNELS, CoarseLine, PanelView
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.geometry.compiled import pays
from lidarpose.model.image import GrayImage

# Half-height of the band in which the coarse line is made fine, pixels.
_FIRST_HALF = 12
# Pixels further from the stripe than this, in widths, show what is beside it.
_BESIDE = 2.7
# Profiles without light keep to the curve by this pull, nothing against a real profile's hundredths.
_PULL_PX = 1.5
# A step that changes the width by this share and the typical centre by so many of its sigmas is the last one.
_SETTLED_WIDTH, _SETTLED_SIGMAS, _MOST_STEPS = 0.04, 1.5, 6
# Order of the unknowns: the first three are each profile's own, the width is common.
_BACKGROUND, _HEIGHT, _CENTRE, _WIDTH = range(4)


_NO_RANGE = "no stripe on the panel: the bright line leaves the squares"
_NO_RIDGE = "no stripe on the panel: the bright line is not a narrow ridge"


def fit_stripes(
    view: PanelView, images: Sequence[GrayImage], lines: Sequence[CoarseLine], limit: float
) -> list[StripeFit | str]:
    """Fit the stripe near each image's line; `limit` is the grey level at which the sensor saturates.

    A string says why there is none.
    """
    found: list[StripeFit | str] = [_NO_RANGE] * len(images)
    for steep in (False, True):
        which = [k for k, line in enumerate(lines) if line.steep == steep]
        source = Source(view, [images[k] for k in which], steep, limit)
        for k, fit in zip(which, _fit_alike(source, [lines[k] for k in which]), strict=True):
            found[k] = fit
    return found


def _fit_alike(source: Source, lines: Sequence[CoarseLine]) -> list[StripeFit | str]:
    """The same for stripes that all run along x, or all along y."""
    found: list[StripeFit | str] = [_NO_RANGE] * len(lines)
    if not lines:
        return found
    share = np.array([line.ambient_share for line in lines])
    straight = Curves(
        np.array([[line.intercept, line.slope] for line in lines]), np.zeros((len(lines), 1)), np.ones((len(lines), 1))
    )
    ranges = usable_ranges(source.view, lines, straight)
    long_enough = ranges.valid.sum(axis=1) >= MIN_POINTS
    alive = np.flatnonzero(long_enough)
    if len(alive) == 0:
        return found
    source, ranges, straight = source.take(long_enough), ranges.take(long_enough), straight.take(long_enough)
    few = ranges.thinned()
    half = np.full(len(alive), _FIRST_HALF)
    curves, width, is_ridge = _first_curves(cut(source, few, straight, half), share[long_enough], straight)
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


def _fit_near(source: Source, ranges: Ranges, few: Ranges, curves: Curves, width: FloatArray) -> list[StripeFit | str]:
    """Fit bands about curves that are right to a pixel: some of the profiles first, then all."""
    albedo = source.view.albedo
    ratio = float(np.clip(np.median(albedo.dark / np.maximum(albedo.light, 1.0)), 0.02, 0.95))
    bands = look_at_albedo(bands_about(source, few, curves, width), source, curves, width)
    state = _start(bands, curves, width, np.full(len(width), ratio), None)
    state = _settle(bands, state, curves, learn_at=0, least=1)
    curves, ratios = smoothed(bands, state).curves, _dark_ratios(bands, state)
    bands = look_at_albedo(bands_about(source, ranges, curves, state.width), source, curves, state.width)
    state = _start(bands, curves, state.width, ratios, state.noise)
    state = _settle(bands, state, curves, learn_at=1, least=2)
    smooth = smoothed(bands, state)
    state = replace(state, dark_ratio=_dark_ratios(bands, state))
    return merged(bands, smooth, source.steep, state)


def _settle(bands: Bands, state: State, curves: Curves, *, learn_at: int, least: int) -> State:
    """Steps until each band's width and centres stay; the noise is learnt from what is left before step `learn_at`.

    Two steps do for most; it is saturated stripes, of which only the skirts are seen, that take more. A band that has
    settled is left as it is, so that the others do not matter to it.
    """
    if pays(0.0, KERNELS):
        return _settle_compiled(bands, state, curves, learn_at=learn_at, least=least)
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


def _settle_compiled(bands: Bands, state: State, curves: Curves, *, learn_at: int, least: int) -> State:
    """`_settle` by kernels."""
    from lidarpose.detect import stripe_profile_kernels

    state = State(**{entry.name: np.array(getattr(state, entry.name), dtype=np.float64) for entry in fields(State)})
    unknowns = (state.height, state.centre, state.background, state.width, state.information)
    pull = (curves.at(bands.u), 1.0 / _PULL_PX**2, _SETTLED_SIGMAS, _SETTLED_WIDTH)
    moving = np.ones(len(state.width), dtype=bool)
    for step in range(_MOST_STEPS):
        rows, state.noise[:] = _sums_compiled(bands, state, learn=step == learn_at)
        stripe_profile_kernels.take_step(rows, bands.valid, *pull, moving, *unknowns)
        moving |= step + 1 < least
        if not moving.any():
            break
    return state


def _has_settled(bands: Bands, before: State, after: State) -> BoolArray:
    """Whether the last step (B,) was so small that the next one would not matter."""
    moved = np.abs(after.centre - before.centre) * np.sqrt(after.information)
    small = quantiles(moved, bands.valid, 0.5) < _SETTLED_SIGMAS
    return np.asarray(small & (np.abs(np.log(after.width / before.width)) < _SETTLED_WIDTH))


def _chosen(which: BoolArray, a: State, b: State) -> State:
    """`a` for the bands in `which`, `b` for the others."""
    found = {}
    for entry in fields(State):
        x, y = getattr(a, entry.name), getattr(b, entry.name)
        found[entry.name] = np.where(which if x.ndim == 1 else which[:, None], x, y)
    return State(**found)


def _first_curves(bands: Bands, share: FloatArray, straight: Curves) -> tuple[Curves, FloatArray, BoolArray]:
    """Curves within about a pixel, from the brightest pixel of each profile, the stripes' rough widths (B,), and
    whether there is a ridge at all (B,)."""
    if pays(0.0, KERNELS):
        return _first_curves_compiled(bands, share, straight)
    rest = bands.values - for_table(share) * bands.bright
    rest -= rest.mean(axis=0)
    smooth = rest.copy()
    smooth[1:-1] = 0.25 * rest[:-2] + 0.5 * rest[1:-1] + 0.25 * rest[2:]
    peak = np.argmax(smooth, axis=0)
    height = smooth.max(axis=0)
    v = bands.v[0].astype(np.float64) + peak
    strong = bands.valid & (height > 0.4 * quantiles(height, bands.valid, 0.75)[:, None])
    powers = Powers.of(bands, 2)
    near, is_ridge, curves = strong, np.ones(len(v), dtype=bool), straight
    for reach in (8.0, 4.0, 2.5):
        near = strong & (np.abs(v - curves.at(bands.u)) <= reach)
        is_ridge &= np.count_nonzero(near, axis=1) >= MIN_POINTS
        curves = fit_curves(powers, v, near.astype(np.float64))
    window = np.clip(peak + np.arange(-9, 10)[:, None, None], 0, len(rest) - 1)
    area = np.maximum(np.take_along_axis(rest, window, axis=0), 0.0).sum(axis=0) / np.maximum(height, 1e-3)
    cosine = 1.0 / np.sqrt(1.0 + curves.slope(bands.u) ** 2)
    # Speckle makes the highest pixel too high, by this much typically, and the width too small.
    width = 1.15 * quantiles(area * cosine, near, 0.5) / np.sqrt(2.0 * np.pi)
    return curves, np.clip(width, 0.6, 6.0), is_ridge


def _first_curves_compiled(bands: Bands, share: FloatArray, straight: Curves) -> tuple[Curves, FloatArray, BoolArray]:
    """`_first_curves` by kernels."""
    from lidarpose.detect import stripe_profile_kernels

    found = np.empty((len(share), 7))
    tables = (bands.values, bands.bright, np.asarray(share, dtype=np.float32))
    profiles = (bands.v[0], bands.u, bands.valid, straight.at(bands.u))
    stripe_profile_kernels.first_curves(*tables, *profiles, MIN_POINTS, found)
    return Curves(found[:, :3], found[:, 3:4], found[:, 4:5]), found[:, 5], found[:, 6] > 0.0


def _start(bands: Bands, curves: Curves, width: FloatArray, ratio: FloatArray, noise: FloatArray | None) -> State:
    """Heights and backgrounds by least squares with all else as given; a guess of the noise from the pixels beside."""
    centre = curves.at(bands.u)
    if pays(0.0, KERNELS):
        return _start_compiled(bands, centre, width, ratio, noise)
    distance = distance_from(bands, centre) * for_table(1.0 / width)
    n, b, v, bb, bv = _start_sums(bands, distance, ratio)
    det = np.maximum(n * bb - b * b, 1e-3)
    height = np.maximum((n * bv - b * v) / det, 1.0)
    background = (v - height * b) / np.maximum(n, 1.0)
    if noise is None:
        flank = bands.good * (np.abs(distance) > _BESIDE)
        rest = np.abs(bands.values - for_table(background)) * flank
        rest_sum, count = (x.sum(axis=0).sum(axis=1, dtype=np.float64) for x in (rest, flank))
        noise = _first_noise(rest_sum / np.maximum(count, 1.0))
    return State(height, centre, background, width, ratio, noise, np.ones_like(centre))


def _first_noise(distance: FloatArray) -> FloatArray:
    """A guess of the noise (B, 3) from the mean distance of the pixels beside the stripe from the background."""
    nothing = np.zeros(len(distance))
    return np.stack([np.maximum(1.25 * distance, 0.3) ** 2, nothing, nothing], axis=1)


def _start_sums(bands: Bands, distance: FloatArray, ratio: FloatArray) -> Sequence[FloatArray]:
    """Sums over each profile's good pixels: 1, bell, values, bell^2 and bell * values, (B, N) each."""
    bell = np.exp(np.float32(-0.5) * (distance * distance))
    bell *= for_table(ratio) + for_table(1.0 - ratio) * bands.light
    weighted = bands.good * bell
    plain = [np.einsum("pbn,pbn->bn", bands.good, x) for x in (np.ones_like(bell), bell, bands.values)]
    return plain + [np.einsum("pbn,pbn->bn", weighted, x) for x in (bell, bands.values)]


def _start_compiled(
    bands: Bands, centre: FloatArray, width: FloatArray, ratio: FloatArray, noise: FloatArray | None
) -> State:
    """`_start` by kernels."""
    from lidarpose.detect import stripe_kernels

    bell = _bell_compiled(bands, centre, width)
    height, background = np.empty(centre.shape, np.float32), np.empty(centre.shape, np.float32)
    each = np.stack([ratio, 1.0 - ratio], axis=1).astype(np.float32)
    stripe_kernels.start(bands.values, bands.good, bands.light, bell, each, height, background)
    if noise is None:
        distance = np.empty(len(width))
        profiles = (background, for_table(centre), for_table(bands.cosine), np.asarray(1.0 / width, dtype=np.float32))
        stripe_kernels.beside(bands.v, bands.values, bands.good, *profiles, np.float32(_BESIDE), distance)
        noise = _first_noise(distance)
    return State(height, centre, background, width, ratio, noise, np.ones_like(centre))


def _bell_compiled(bands: Bands, centre: FloatArray, width: FloatArray) -> FloatArray:
    """exp(-d^2 / 2) (P, B, N) of the pixels' distances in widths, by kernels and NumPy's own exponential."""
    from lidarpose.detect import stripe_kernels

    bell = np.empty_like(bands.v)
    by_width = np.asarray(1.0 / width, dtype=np.float32)
    stripe_kernels.exponents(bands.v, for_table(centre), for_table(bands.cosine), by_width, bell)
    return np.exp(bell, out=bell)


def _step(bands: Bands, state: State, curves: Curves, *, learn: bool) -> State:
    """One Gauss-Newton step; with `learn`, the noise is learnt again first."""
    M, noise = _equations(bands, state, learn=learn)
    M[_BACKGROUND][0] += 1e-9
    M[_HEIGHT][0] += 1e-9
    M[_CENTRE][0] += 1.0 / _PULL_PX**2
    M[_CENTRE][-1] += (curves.at(bands.u) - state.centre) / _PULL_PX**2
    change, by_width, information = _solve(M)
    return State(
        np.maximum(state.height + change[_HEIGHT], 1e-3),
        state.centre + np.clip(change[_CENTRE], -1.0, 1.0),
        state.background + change[_BACKGROUND],
        np.clip(state.width * np.exp(by_width), 0.4, 10.0),
        state.dark_ratio,
        noise,
        information,
    )


def _equations(bands: Bands, state: State, *, learn: bool) -> tuple[list[FloatArray], FloatArray]:
    """`_normal_equations` of the next step, and the noise (B, 3) that its weights are for."""
    distance = distance_from(bands, state.centre) * for_table(1.0 / state.width)
    squared = distance * distance
    bell = np.exp(np.float32(-0.5) * squared)
    ratio, height = for_table(state.dark_ratio), for_table(state.height)
    by_height = bell * (ratio + (1 - ratio) * bands.light)
    signal = height * by_height
    residual = bands.values - for_table(state.background) - signal
    level = np.maximum(bands.values + bands.ambient, np.float32(0.0))
    noise = state.noise
    if learn:
        noise = learn_noise(Samples.of(bands.good, (residual, level, signal)), state.noise)
    variance = for_table(noise[:, 0]) + for_table(noise[:, 1]) * level + for_table(noise[:, 2]) * signal * signal
    weight = bands.good / variance
    J = [
        np.ones_like(signal),
        by_height,
        signal * distance * for_table(bands.cosine / state.width[:, None]),
        signal * squared,
    ]
    return _normal_equations(J, residual, weight), noise


def _sums_compiled(bands: Bands, state: State, *, learn: bool) -> tuple[FloatArray, FloatArray]:
    """The sums of `_normal_equations` (14, B, N), one row after the other, and the noise (B, 3), by kernels."""
    from lidarpose.detect import stripe_kernels

    bell = _bell_compiled(bands, state.centre, state.width)
    noise = learn_noise(_samples(bands, state, bell), state.noise) if learn else state.noise
    ratio = np.asarray(state.dark_ratio, dtype=np.float32)
    each = np.column_stack(
        [np.asarray(1.0 / state.width, dtype=np.float32), ratio, 1 - ratio, noise.astype(np.float32)]
    )
    profiles = (state.centre, bands.cosine, bands.cosine / state.width[:, None], state.height, state.background)
    rows = np.empty((14, *state.centre.shape), np.float32)
    centre, cosine, slant, height, background = (for_table(x) for x in profiles)
    tables = (bands.v, bands.values, bands.ambient, bands.good, bands.light, bell)
    stripe_kernels.normal_equations(*tables, centre, cosine, slant, height, background, each, rows)
    return rows, noise


def _samples(bands: Bands, state: State, bell: FloatArray) -> Samples:
    """Residual, level and signal of some pixels of each band, as `_equations` has them of all, by kernels."""
    from lidarpose.detect import stripe_kernels

    tables = (bands.values, bands.ambient, bands.good, bands.light, bell)
    profiles = (for_table(state.height), for_table(state.background), np.asarray(state.dark_ratio, dtype=np.float32))
    found = np.zeros((len(state.width), 3, 2 * NOISE_SAMPLES), np.float32)
    return Samples(found, stripe_kernels.samples(*tables, *profiles, NOISE_SAMPLES, found))


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


def _dark_ratios(bands: Bands, state: State) -> FloatArray:
    """Light (B,) that dark squares send back against light ones, at the laser's colour: from the profiles wholly on
    either.

    Not fitted with the rest: its product with the heights makes a bad start worse.
    """
    share = bands.light[bands.half]
    on_light, on_dark = bands.valid & (share > 0.98), bands.valid & (share < 0.02)
    enough = np.minimum(np.count_nonzero(on_light, axis=1), np.count_nonzero(on_dark, axis=1)) >= 20
    light, dark = (quantiles(state.height, which, 0.5) for which in (on_light, on_dark))
    seen = state.dark_ratio * np.where(enough, dark, 1.0) / np.where(enough, light, 1.0)
    return np.where(enough, np.clip(seen, 0.01, 1.0), state.dark_ratio)
