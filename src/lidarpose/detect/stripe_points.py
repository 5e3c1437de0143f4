"""Points of stripes, from the centres, widths and noise that `stripe_fit` has found: smooth curves reject what does not
belong, and neighbouring profiles become one point, whose scatter about the curve corrects what the noise model states.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.stripe_bands import Bands, Curves, Powers, as_pixels, fit_curves, quantile, spreads
from lidarpose.detect.stripe_search import KERNELS
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import MAD_TO_SIGMA, tukey_weights
from lidarpose.model.observation import StripePoints

# Profiles that are merged into one point (half as many in short stripes): neighbours share the lens's blur and the
# laser's speckle.
_BLOCK = 8
_SHORT = 300
# Of fewer profiles, or of fewer points, there is no stripe.
MIN_POINTS = 8
# A profile, or a point, whose centre is worse than this tells nothing.
_WORST_SIGMA_PX = 0.8
# What the squares' edges and the blur are known to at best, in what they move a point by.
_MODEL_SIGMA_PX = 0.01
# By what the noise of pixels may be off, and how often the part that all points share is halved.
_NOISE_FACTORS, _HALVINGS = np.array([[1.0], [1.25], [1.5], [1.75], [2.0], [2.5]]), 8

_TOO_FEW = "no stripe on the panel: too few profiles show it"
_TOO_ROUGH = "no usable stripe on the panel: what there is of it is too faint and rough to tell where it runs"
_NOT_NARROW = "the bright line on the panel is not the narrow straight line that a laser makes"
# `stripe_profile_kernels` counts them so too.
_PROBLEMS = ("", _TOO_FEW, _NOT_NARROW, _TOO_ROUGH)


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
        By how much the scatter about a smooth curve exceeds what the noise explains (1: not at all); the points'
        standard deviations are those that explain it.
    """

    points: StripePoints
    width_px: float
    dark_ratio: float
    inflation: float


@dataclass(frozen=True, eq=False)
class State:
    """What the fit has found so far of bands and their profiles.

    height, centre, background : (B, N); width, dark_ratio : (B,); noise : (B, 3); information : (B, N) on the centre,
    1 / px^2 along v.
    """

    height: FloatArray
    centre: FloatArray
    background: FloatArray
    width: FloatArray
    dark_ratio: FloatArray
    noise: FloatArray
    information: FloatArray


@dataclass(frozen=True, eq=False)
class Smooth:
    """Smooth curves through the centres, the weight (B, N) that each profile is left with, and its residual (B, N).

    `problems` (B,) are why a band shows no stripe: which of `_PROBLEMS`, 0 where it does.
    """

    curves: Curves
    weight: FloatArray
    residual: FloatArray
    problems: IntArray


def smoothed(bands: Bands, state: State) -> Smooth:
    """Smooth curves through the centres, robust against the profiles that show something else."""
    if pays(0.0, KERNELS):
        return _smooth_compiled(bands, state)
    sigma = 1.0 / np.sqrt(state.information)
    known = bands.valid & (sigma * bands.cosine < _WORST_SIGMA_PX)
    weight = np.where(known, state.information, 0.0)
    robust = weight
    cubic = np.count_nonzero(known, axis=1) > 60
    enough = np.ones(len(sigma), dtype=bool)
    powers = Powers.of(bands, 3)
    for _ in range(3):
        enough &= np.count_nonzero(robust, axis=1) >= MIN_POINTS
        curves = fit_curves(powers, state.centre, robust, cubic)
        residual = state.centre - curves.at(bands.u)
        standardised = residual / sigma
        scale = np.maximum(np.where(enough, spreads(standardised, known), 1.0), 1.0)[:, None]
        robust = weight * tukey_weights(standardised / scale)
    kept = np.where(np.abs(standardised) < 4.0 * scale, weight, 0.0)
    narrow = spreads(residual * bands.cosine, kept > 0) < 0.5 * np.maximum(state.width, 1.0)
    return Smooth(curves, kept, residual, np.where(enough, np.where(narrow, 0, 2), 1))


def _smooth_compiled(bands: Bands, state: State) -> Smooth:
    """`smoothed` by kernels."""
    from lidarpose.detect import stripe_profile_kernels

    curves, problems = np.empty((len(state.width), 6)), np.empty(len(state.width), np.int64)
    kept, residual = np.empty_like(state.centre), np.empty_like(state.centre)
    profiles = (bands.u, bands.valid, state.centre, state.information, bands.cosine, state.width)
    stripe_profile_kernels.smooth(*profiles, _WORST_SIGMA_PX, MIN_POINTS, curves, kept, residual, problems)
    return Smooth(Curves(curves[:, :4], curves[:, 4:5], curves[:, 5:6]), kept, residual, problems)


def _stated_sigma(offset: FloatArray, sigma: FloatArray) -> NDArray[np.float64]:
    """What points' offsets (n,) from the curve say their standard deviations are: that of their pixels' noise, times a
    factor, beside a part that all share.

    Speckle that the lens has smeared over neighbours moves strong and faint points by the same; a factor alone would
    state strong points too well and faint ones too badly. The likelier of some factors, each with its shared part.
    """
    scaled = _NOISE_FACTORS * sigma
    far = np.abs(offset)
    middle = int(0.5 * (len(offset) - 1))

    def spread(sigmas: FloatArray) -> FloatArray:
        return MAD_TO_SIGMA * np.partition(far / sigmas, middle, axis=1)[:, middle : middle + 1]

    # The shared part with which each factor's spread is 1, by halving what it lies between.
    low, high = np.zeros((len(scaled), 1)), np.full((len(scaled), 1), MAD_TO_SIGMA * quantile(far, 0.5))
    for _ in range(_HALVINGS):
        between = 0.5 * (low + high)
        wide = spread(np.hypot(scaled, between)) > 1.0
        low, high = np.where(wide, between, low), np.where(wide, high, between)
    stated = np.where(spread(scaled) > 1.0, np.hypot(scaled, high), scaled)
    misfit = (np.log(stated) + 0.5 * np.minimum((far / stated) ** 2, 9.0)).sum(axis=1)
    return np.asarray(stated[int(np.argmin(misfit))], dtype=np.float64)


def merged(bands: Bands, smooth: Smooth, steep: bool, state: State) -> list[StripeFit | str]:
    """The points of each band, or why there are none."""
    if pays(0.0, KERNELS):
        return _merged_compiled(bands, smooth, steep, state)
    return [
        _PROBLEMS[problem] or _points(bands, smooth, steep, state, b)
        for b, problem in enumerate(smooth.problems.tolist())
    ]


def _merged_compiled(bands: Bands, smooth: Smooth, steep: bool, state: State) -> list[StripeFit | str]:
    """`merged` by kernels."""
    from lidarpose.detect import stripe_profile_kernels

    curves = np.concatenate([smooth.curves.coefficients, smooth.curves.middle, smooth.curves.half], axis=1)
    inflation, sigma = np.empty(len(curves)), np.empty(bands.u.shape)
    pixels, normals = np.empty((*bands.u.shape, 2)), np.empty((*bands.u.shape, 2))
    profiles = (bands.u, bands.valid, smooth.weight, smooth.residual, bands.cosine, bands.sine, curves)
    bounds = ((_BLOCK, _SHORT, MIN_POINTS), (_WORST_SIGMA_PX, _MODEL_SIGMA_PX), _NOISE_FACTORS[:, 0], _HALVINGS)
    points = (inflation, pixels, normals, sigma)
    counts = stripe_profile_kernels.merge(*profiles, *bounds, steep, smooth.problems, *points)
    found: list[StripeFit | str] = []
    for b, problem in enumerate(smooth.problems.tolist()):
        if problem:
            found.append(_PROBLEMS[problem])
            continue
        points_b = StripePoints(*(x[b, : counts[b]].copy() for x in (pixels, normals, sigma)))
        found.append(StripeFit(points_b, float(state.width[b]), float(state.dark_ratio[b]), float(inflation[b])))
    return found


def _points(bands: Bands, smooth: Smooth, steep: bool, state: State, b: int) -> StripeFit | str:
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
    if len(u) < MIN_POINTS:
        return _TOO_FEW
    freedom = np.sqrt(max(len(u) - 4, 1) / len(u))
    inflation = max(MAD_TO_SIGMA * quantile(np.abs(offset / sigma), 0.5) / freedom, 1.0)
    sigma = _stated_sigma(offset / freedom, sigma)
    norm = np.hypot(cosine, sine)
    cosine, sine = cosine / norm, sine / norm
    sigma = np.hypot(sigma, _MODEL_SIGMA_PX) * cosine
    # Points on dark squares beside points on light ones: a hundredth of their weight, and mostly trouble.
    best = quantile(sigma, 0.2)
    worth = sigma < np.clip(8.0 * best, 0.1, _WORST_SIGMA_PX)
    if np.count_nonzero(worth) < max(MIN_POINTS, len(u) // 2):
        return _TOO_ROUGH
    u, offset, cosine, sine, sigma = u[worth], offset[worth], cosine[worth], sine[worth], sigma[worth]
    only = np.arange(len(smooth.problems)) == b
    v = smooth.curves.take(only).at(u[None])[0] + offset
    normals = np.stack([cosine, -sine] if steep else [-sine, cosine], axis=-1)
    points = StripePoints(as_pixels(u, v, steep), normals, sigma)
    return StripeFit(points, float(state.width[b]), float(state.dark_ratio[b]), inflation)
