"""What `stripe_fit`, `stripe_points` and `stripe_noise` do with profiles, compiled by numba: curves through their
centres, their steps, the noise, and their merging into points; imported only where `stripe_kernels` are.

The same as the NumPy way but for rounding in double precision: sums here run from the first profile to the last, small
systems of equations are solved by Gauss's elimination. What is selected (medians, maxima) is the same.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel
from lidarpose.geometry.robust import MAD_TO_SIGMA

# What `merge` says of a band, and `smooth`: the indices of `stripe_points._PROBLEMS`.
FINE, TOO_FEW, NOT_NARROW, TOO_ROUGH = range(4)


@kernel
def select(values: Any, count: int, k: int) -> Any:
    """The value that `k` of the first `count` are not above (Hoare's quickselect); changes their order."""
    low, high = 0, count - 1
    while low < high:
        pivot, i, j = values[k], low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while pivot < values[j]:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if j < k:
            low = i
        if k < i:
            high = j
    return values[k]


@kernel
def _quantile(values: Any, count: int, share: float) -> float:
    """As `stripe_bands.quantiles`; infinite if there are none."""
    if count == 0:
        return np.inf
    return np.float64(select(values, count, int(share * (count - 1))))


@kernel
def _solve(normal: Any, right: Any) -> None:
    """Solve a small system in place, with pivots; the answer is left in `right`."""
    size = len(right)
    for k in range(size):
        best = k
        for i in range(k + 1, size):
            if abs(normal[i, k]) > abs(normal[best, k]):
                best = i
        if best != k:
            for j in range(k, size):
                normal[k, j], normal[best, j] = normal[best, j], normal[k, j]
            right[k], right[best] = right[best], right[k]
        for i in range(k + 1, size):
            share = normal[i, k] / normal[k, k]
            for j in range(k + 1, size):
                normal[i, j] -= share * normal[k, j]
            right[i] -= share * right[k]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            right[k] -= normal[k, j] * right[j]
        right[k] /= normal[k, k]


@kernel
def _fit_curve(x: Any, v: Any, weight: Any, size: int, held: bool, normal: Any, found: Any) -> None:
    """`stripe_bands.fit_curves` of one band, `size` unknowns, x from -1 to 1; without the cube if `held`."""
    sums, trace = np.zeros(8), 0.0
    for i in range(size):
        found[i] = 0.0
    for n in range(len(x)):
        if weight[n] != 0.0:
            power = weight[n]
            for k in range(size):
                found[k] += power * v[n]
                sums[k] += power
                power *= x[n]
            for k in range(size, 2 * size - 1):
                sums[k] += power
                power *= x[n]
    for i in range(size):
        trace += sums[2 * i]
        for j in range(size):
            normal[i, j] = sums[i + j]
    trace = max(trace, 1e-30)
    for i in range(size):
        normal[i, i] += 1e-12 * trace
    if held:
        normal[3, 3] += 1e9 * trace
    _solve(normal[:size, :size], found[:size])


@kernel
def _scale_of(u: Any, valid: Any) -> Any:
    """Middle and half of the range of u, as `stripe_bands.Powers` has them."""
    count = 0
    for n in range(len(u)):
        count += valid[n]
    last = u[max(count - 1, 0)]
    return 0.5 * (u[0] + last), max(0.5 * (last - u[0]), 1.0)


@kernel
def _horner(coefficients: Any, size: int, x: float) -> float:
    value = coefficients[size - 1]
    for k in range(size - 2, -1, -1):
        value = value * x + coefficients[k]
    return float(value)


@kernel
def take_out(own: Any, cross: Any, u: Any, middle: Any, half: Any, bright: Any, values: Any, ambient: Any) -> None:
    """`stripe_bands._ambient` from the sums of `ambient_products`: writes `ambient`, and takes it out of `values`."""
    pixels, bands, profiles = values.shape
    normal, right = np.empty((3, 3)), np.empty(3)
    sums, share = np.empty(5), np.empty(profiles, np.float32)
    for b in range(bands):
        for k in range(5):
            sums[k] = 0.0
        for k in range(3):
            right[k] = 0.0
        for n in range(profiles):
            x = (u[b, n] - middle[b, 0]) / half[b, 0]
            power, mine = np.float64(own[b, n]), np.float64(cross[b, n])
            for k in range(5):
                sums[k] += power
                power *= x
            for k in range(3):
                right[k] += mine
                mine *= x
        pull = 1e-6 * (sums[0] + sums[2] + sums[4]) + 1.0
        for i in range(3):
            for j in range(3):
                normal[i, j] = sums[i + j] + (pull if i == j else 0.0)
        _solve(normal, right)
        for n in range(profiles):
            share[n] = _horner(right, 3, (u[b, n] - middle[b, 0]) / half[b, 0])
        for p in range(pixels):
            for n in range(profiles):
                ambient[p, b, n] = share[n] * bright[p, b, n]
                values[p, b, n] -= ambient[p, b, n]


@kernel
def _without_ambient(values: Any, bright: Any, band: int, share: Any, rest: Any) -> None:
    """What is left of a band's pixels (P, N) without a share of the bright image and each profile's mean."""
    pixels, profiles = rest.shape
    mean, number = np.zeros(profiles, np.float32), np.float32(pixels)
    for p in range(pixels):
        for n in range(profiles):
            rest[p, n] = values[p, band, n] - share * bright[p, band, n]
            mean[n] += rest[p, n]
    for n in range(profiles):
        mean[n] /= number
    for p in range(pixels):
        for n in range(profiles):
            rest[p, n] -= mean[n]


@kernel
def _brightest(rest: Any, peak: Any, top: Any) -> None:
    """Where profiles (P, N) are highest, all pixels but the ends smoothed with their neighbours, and how high."""
    pixels, profiles = rest.shape
    quarter, half = np.float32(0.25), np.float32(0.5)
    for n in range(profiles):
        top[n], peak[n] = rest[0, n], 0
    smooth = np.empty(profiles, np.float32)
    for p in range(1, pixels):
        if p < pixels - 1:
            for n in range(profiles):
                smooth[n] = quarter * rest[p - 1, n] + half * rest[p, n] + quarter * rest[p + 1, n]
        else:
            smooth[:] = rest[p]
        for n in range(profiles):
            if smooth[n] > top[n]:
                top[n], peak[n] = smooth[n], p


@kernel
def _rough_width(rest: Any, peak: Any, top: Any, near: Any, x: Any, curve: Any, half: float, some: Any) -> float:
    """A stripe's width from the light around the peaks of profiles that are `near` (N,) its curve."""
    last, lowest, none = rest.shape[0] - 1, np.float32(1e-3), np.float32(0.0)
    count = 0
    for n in range(len(x)):
        if near[n] > 0.0:
            total = none
            for k in range(-9, 10):
                value = rest[min(max(peak[n] + k, 0), last), n]
                total += value if value > none else none
            slope = 2.0 * curve[2] / half * x[n] + curve[1] / half
            total = total / (top[n] if top[n] > lowest else lowest)
            some[count] = total * (1.0 / np.sqrt(1.0 + slope**2))
            count += 1
    width = 1.15 * _quantile(some, count, 0.5) / np.sqrt(2.0 * np.pi)
    return float(min(max(width, 0.6), 6.0))


@kernel
def first_curves(
    values: Any, bright: Any, share: Any, v0: Any, u: Any, valid: Any, straight: Any, least: int, found: Any
) -> None:
    """`stripe_fit._first_curves`, into `found` (B, 7): coefficients, middle, half, width, and 1 for a ridge.

    `straight` (B, N) are the first curves' v, `share` and `v0` as the tables', single.
    """
    pixels, bands, profiles = values.shape
    rest = np.empty((pixels, profiles), np.float32)
    top, height = np.empty(profiles, np.float32), np.empty(profiles, np.float32)
    peak, chosen = np.empty(profiles, np.int64), np.empty(profiles, np.bool_)
    x, v, at = np.empty(profiles), np.empty(profiles), np.empty(profiles)
    near, some = np.empty(profiles), np.empty(profiles)
    normal, curve = np.empty((4, 4)), np.empty(4)
    for b in range(bands):
        _without_ambient(values, bright, b, share[b], rest)
        _brightest(rest, peak, top)
        count = 0
        for n in range(profiles):
            if valid[b, n]:
                height[count] = top[n]
                count += 1
        threshold = 0.4 * _quantile(height, count, 0.75)
        middle, half = _scale_of(u[b], valid[b])
        for n in range(profiles):
            chosen[n] = valid[b, n] and top[n] > threshold
            x[n], v[n], at[n] = (u[b, n] - middle) / half, np.float64(v0[b, n]) + peak[n], straight[b, n]
        is_ridge = True
        for reach in (8.0, 4.0, 2.5):
            count = 0
            for n in range(profiles):
                inside = chosen[n] and abs(v[n] - at[n]) <= reach
                near[n] = 1.0 if inside else 0.0
                count += inside
            is_ridge = is_ridge and count >= least
            _fit_curve(x, v, near, 3, False, normal, curve)
            for n in range(profiles):
                at[n] = _horner(curve, 3, x[n])
        for k in range(3):
            found[b, k] = curve[k]
        found[b, 3], found[b, 4] = middle, half
        found[b, 5] = _rough_width(rest, peak, top, near, x, curve, half, some)
        found[b, 6] = 1.0 if is_ridge else 0.0


@kernel
def take_step(
    rows: Any,
    valid: Any,
    curve: Any,
    pull: float,
    by_sigmas: float,
    by_share: float,
    moving: Any,
    height: Any,
    centre: Any,
    background: Any,
    width: Any,
    information: Any,
) -> None:
    """One step of the bands that are `moving`, from the sums (14, B, N) of `normal_equations`, in place; `stripe_fit`'s
    `_step`, `_solve` and `_has_settled`.

    `curve` (B, N) is what profiles are pulled to; `moving` is true after it only for the bands whose centres have moved
    `by_sigmas`, typically, or their width `by_share`.
    """
    bands, profiles = centre.shape
    r, a, moved = np.empty((12, profiles)), np.empty(14), np.empty(profiles)
    for b in range(bands):
        if not moving[b]:
            continue
        normal, goal = 0.0, 0.0
        for n in range(profiles):
            for k in range(14):
                a[k] = rows[k, b, n]
            a[0] += 1e-9
            a[5] += 1e-9
            a[9] += pull
            a[11] += (curve[b, n] - centre[b, n]) * pull
            # The upper triangle, row by row, of three rows of their own, and what they leave of the common one.
            first = 0
            for i in range(3):
                below = first + 5 - i
                for j in range(1, 4 - i):
                    share = a[first + j] / a[first]
                    for k in range(j, 5 - i):
                        a[below] -= share * a[first + k]
                        below += 1
                first += 5 - i
            normal += a[12]
            goal += a[13]
            for k in range(12):
                r[k, n] = a[k]
        by_width = min(max(goal / (normal + 1e-6), -0.3), 0.3)
        count = 0
        for n in range(profiles):
            by_centre = (r[11, n] - r[10, n] * by_width) / r[9, n]
            by_height = (r[8, n] - r[7, n] * by_width - r[6, n] * by_centre) / r[5, n]
            by_ground = (r[4, n] - r[3, n] * by_width - r[1, n] * by_height - r[2, n] * by_centre) / r[0, n]
            before = centre[b, n]
            height[b, n] = max(height[b, n] + by_height, 1e-3)
            centre[b, n] = before + min(max(by_centre, -1.0), 1.0)
            background[b, n] += by_ground
            information[b, n] = r[9, n]
            if valid[b, n]:
                moved[count] = abs(centre[b, n] - before) * np.sqrt(r[9, n])
                count += 1
        before = width[b]
        width[b] = min(max(before * np.exp(by_width), 0.4), 10.0)
        small = _quantile(moved, count, 0.5) < by_sigmas
        moving[b] = not (small and abs(np.log(width[b] / before)) < by_share)


@kernel
def smooth(
    u: Any,
    valid: Any,
    centre: Any,
    information: Any,
    cosine: Any,
    width: Any,
    worst: float,
    least: int,
    curves: Any,
    kept: Any,
    residual: Any,
    problems: Any,
) -> None:
    """`stripe_points.smoothed`: into `curves` (B, 6), four coefficients, middle and half, `kept` and `residual` (B, N),
    and `problems` (B,)."""
    bands, profiles = u.shape
    x, sigma, weight = np.empty(profiles), np.empty(profiles), np.empty(profiles)
    robust, standardised, some = np.empty(profiles), np.empty(profiles), np.empty(profiles)
    normal = np.empty((4, 4))
    for b in range(bands):
        middle, half = _scale_of(u[b], valid[b])
        known = 0
        for n in range(profiles):
            x[n] = (u[b, n] - middle) / half
            sigma[n] = 1.0 / np.sqrt(information[b, n])
            there = valid[b, n] and sigma[n] * cosine[b, n] < worst
            weight[n] = information[b, n] if there else 0.0
            robust[n] = weight[n]
            known += there
        enough, scale = True, 1.0
        for _ in range(3):
            used, count = 0, 0
            for n in range(profiles):
                used += robust[n] != 0.0
            enough = enough and used >= least
            _fit_curve(x, centre[b], robust, 4, known <= 60, normal, curves[b])
            for n in range(profiles):
                residual[b, n] = centre[b, n] - _horner(curves[b], 4, x[n])
                standardised[n] = residual[b, n] / sigma[n]
                if weight[n] != 0.0:
                    some[count] = abs(standardised[n])
                    count += 1
            scale = max(MAD_TO_SIGMA * _quantile(some, count, 0.5), 1.0) if enough else 1.0
            for n in range(profiles):
                r = standardised[n] / scale / 4.685
                robust[n] = weight[n] * (1.0 - r**2) ** 2 if abs(r) < 1.0 else 0.0
        count = 0
        for n in range(profiles):
            kept[b, n] = weight[n] if abs(standardised[n]) < 4.0 * scale else 0.0
            if kept[b, n] > 0.0:
                some[count] = abs(residual[b, n] * cosine[b, n])
                count += 1
        curves[b, 4], curves[b, 5] = middle, half
        narrow = MAD_TO_SIGMA * _quantile(some, count, 0.5) < 0.5 * max(width[b], 1.0)
        problems[b] = TOO_FEW if not enough else FINE if narrow else NOT_NARROW


@kernel
def _spread(far: Any, sigma: Any, factor: float, beside: float, some: Any, count: int) -> float:
    """Robust spread of points in units of a factor times their sigma beside a shared part."""
    for i in range(count):
        some[i] = far[i] / np.hypot(factor * sigma[i], beside)
    return MAD_TO_SIGMA * float(select(some, count, int(0.5 * (count - 1))))


@kernel
def _stated_sigma(far: Any, sigma: Any, factors: Any, halvings: int, some: Any, count: int) -> Any:
    """`stripe_points._stated_sigma`: the likeliest factor and shared part; `far` are the offsets without sign."""
    for i in range(count):
        some[i] = far[i]
    widest = MAD_TO_SIGMA * float(select(some, count, int(0.5 * (count - 1))))
    best, chosen, shared = np.inf, 1.0, 0.0
    for factor in factors:
        high = 0.0
        if _spread(far, sigma, factor, 0.0, some, count) > 1.0:
            low, high = 0.0, widest
            for _ in range(halvings):
                between = 0.5 * (low + high)
                if _spread(far, sigma, factor, between, some, count) > 1.0:
                    low = between
                else:
                    high = between
        misfit = 0.0
        for i in range(count):
            stated = np.hypot(factor * sigma[i], high)
            misfit += np.log(stated) + 0.5 * min((far[i] / stated) ** 2, 9.0)
        if misfit < best:
            best, chosen, shared = misfit, factor, high
    return chosen, shared


@kernel
def _blocks(u: Any, valid: Any, kept: Any, residual: Any, cosine: Any, sine: Any, length: int, found: Any) -> int:
    """Blocks of a band's neighbouring profiles: weighted means of u, residual, cosine and sine, and the mean's sigma,
    as columns of `found` (5, N); how many blocks have enough of them."""
    profiles = len(u)
    m, n = 0, 0
    while n < profiles and valid[n]:
        block, seen = np.floor(u[n] / length), 0
        w0, wu, wr, wc, ws = 0.0, 0.0, 0.0, 0.0, 0.0
        while n < profiles and valid[n] and np.floor(u[n] / length) == block:
            w = kept[n]
            seen += w > 0.0
            w0, wu, wr = w0 + w, wu + w * u[n], wr + w * residual[n]
            wc, ws = wc + w * cosine[n], ws + w * sine[n]
            n += 1
        if seen >= length // 2 and w0 > 0.0:
            found[0, m], found[1, m], found[2, m], found[3, m] = wu / w0, wr / w0, wc / w0, ws / w0
            found[4, m] = 1.0 / np.sqrt(w0)
            m += 1
    return m


@kernel
def merge(
    u: Any,
    valid: Any,
    kept: Any,
    residual: Any,
    cosine: Any,
    sine: Any,
    curves: Any,
    sizes: Any,
    limits: Any,
    factors: Any,
    halvings: int,
    steep: bool,
    problems: Any,
    inflation: Any,
    pixels: Any,
    normals: Any,
    sigmas: Any,
) -> Any:
    """`stripe_points._points` of all bands that `smooth` found no problem with: pixels and normals (B, N, 2) and sigma
    (B, N) of their points, and how many (B,).

    `sizes` are the length of a block, what a stripe is short below, and the fewest points; `limits` the worst sigma
    and what the model is known to.
    """
    bands, profiles = u.shape
    found, far, some = np.empty((5, profiles)), np.empty(profiles), np.empty(profiles)
    numbers = np.zeros(bands, np.int64)
    for b in range(bands):
        if problems[b] != FINE:
            continue
        used = 0
        for n in range(profiles):
            used += valid[b, n] and kept[b, n] != 0.0
        length = sizes[0] if used > sizes[1] else sizes[0] // 2
        m = _blocks(u[b], valid[b], kept[b], residual[b], cosine[b], sine[b], length, found)
        if m < sizes[2]:
            problems[b] = TOO_FEW
            continue
        freedom = np.sqrt(max(m - 4, 1) / m)
        for i in range(m):
            some[i] = abs(found[1, i] / found[4, i])
            far[i] = abs(found[1, i] / freedom)
        middle = float(select(some, m, int(0.5 * (m - 1))))
        inflation[b] = max(MAD_TO_SIGMA * middle / freedom, 1.0)
        factor, shared = _stated_sigma(far, found[4], factors, halvings, some, m)
        for i in range(m):
            norm = np.hypot(found[2, i], found[3, i])
            found[2, i], found[3, i] = found[2, i] / norm, found[3, i] / norm
            found[4, i] = np.hypot(np.hypot(factor * found[4, i], shared), limits[1]) * found[2, i]
            some[i] = found[4, i]
        best = float(select(some, m, int(0.2 * (m - 1))))
        bound = min(max(8.0 * best, 0.1), limits[0])
        count = 0
        for i in range(m):
            if found[4, i] < bound:
                along = found[0, i]
                across = _horner(curves[b], 4, (along - curves[b, 4]) / curves[b, 5]) + found[1, i]
                c, s = found[2, i], found[3, i]
                pixels[b, count, 0], pixels[b, count, 1] = (across, along) if steep else (along, across)
                normals[b, count, 0], normals[b, count, 1] = (c, -s) if steep else (-s, c)
                sigmas[b, count] = found[4, i]
                count += 1
        numbers[b] = count
        if count < max(sizes[2], m // 2):
            problems[b] = TOO_ROUGH
    return numbers


@kernel
def _not_negative(design: Any, count: int, found: Any) -> None:
    """`stripe_noise.not_negative` for one band: rows (count, 3) of three unknowns, each to make 1."""
    scale, normal, right = np.zeros(3), np.zeros((3, 3)), np.zeros(3)
    for k in range(3):
        for i in range(count):
            scale[k] += design[i, k] * design[i, k]
        scale[k] = max(np.sqrt(scale[k]), 1e-30)
        for i in range(count):
            design[i, k] /= scale[k]
            right[k] += design[i, k]
    for i in range(count):
        for j in range(3):
            for k in range(3):
                normal[j, k] += design[i, j] * design[i, k]
    system, guess = np.empty((3, 3)), np.empty(3)
    best = np.inf
    for choice in range(8):
        for j in range(3):
            free_j = (choice >> (2 - j)) & 1
            guess[j] = right[j] * free_j
            for k in range(3):
                system[j, k] = normal[j, k] * free_j * ((choice >> (2 - k)) & 1)
            system[j, j] += 1.0 - free_j + 1e-12
        _solve(system, guess)
        rest = 0.0
        for i in range(count):
            value = design[i, 0] * guess[0] + design[i, 1] * guess[1] + design[i, 2] * guess[2]
            rest += (value - 1.0) ** 2
        if min(guess[0], guess[1], guess[2]) >= 0.0 and rest < best:
            best = rest
            for k in range(3):
                found[k] = guess[k] / scale[k]


@kernel
def learn_noise(samples: Any, per_bin: Any, learnt: Any, order: Any, bins: int, noise: Any) -> None:
    """`stripe_noise.learn_noise` in place: from `samples` (B, 3, M), and their `order` (B, M) by the signal."""
    design = np.empty((bins, 3))
    some = np.empty(samples.shape[2], np.float32)
    for b in range(len(learnt)):
        if not learnt[b]:
            continue
        size = per_bin[b]
        residual, level, signal = samples[b, 0], samples[b, 1], samples[b, 2]
        for k in range(bins):
            by_level, by_signal = 0.0, 0.0
            for i in range(size):
                at = order[b, k * size + i]
                some[i] = abs(residual[at])
                by_level += np.float64(level[at])
                by_signal += np.float64(signal[at]) * np.float64(signal[at])
            middle = np.float64(select(some, size, size // 2))
            variance = max(1.2 * (MAD_TO_SIGMA * middle) ** 2, 0.05)
            design[k, 0], design[k, 1] = 1.0 / variance, by_level / size / variance
            design[k, 2] = by_signal / size / variance
        _not_negative(design, bins, noise[b])
        noise[b, 0] = max(noise[b, 0], 0.05)
