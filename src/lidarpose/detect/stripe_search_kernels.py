"""`stripe_search` compiled by numba: a panel's part of an image reduced, and the line of light in it; imported only
where `stripe_kernels` are.

Each gives the very bits that the NumPy way gives, but for a correlation of which only the size matters.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.detect.stripe_profile_kernels import select
from lidarpose.detect.stripe_search import parabola
from lidarpose.geometry.compiled import kernel

# Neighbouring pixels that are kept apart, so that the compiler works on them at once.
_LANES = 16


@kernel
def block_means(image: Any, low: Any, high: Any, factor: int) -> Any:
    """`stripe_search.reduce_image` of the part of an 8-bit image from `low` up to `high`, by 2, 3 or 4."""
    height, width = (high[1] - low[1]) // factor, (high[0] - low[0]) // factor
    share = np.float32(1.0 / factor**2)
    found = np.empty((height, width), np.float32)
    sums = np.empty(width * factor, np.uint16)
    for i in range(height):
        top, left, right = low[1] + i * factor, low[0], low[0] + width * factor
        a, b = image[top, left:right], image[top + 1, left:right]
        # Four rows at once whatever the factor, so that one loop does all; those not needed count nothing.
        c, d = image[top + min(2, factor - 1), left:right], image[top + factor - 1, left:right]
        third, fourth = np.uint16(factor > 2), np.uint16(factor > 3)
        for j in range(width * factor):
            sums[j] = np.uint16(a[j]) + np.uint16(b[j]) + np.uint16(c[j]) * third + np.uint16(d[j]) * fourth
        row = found[i]
        if factor == 4:
            for j in range(width):
                row[j] = np.float32(np.int32(sums[4 * j] + sums[4 * j + 1] + sums[4 * j + 2] + sums[4 * j + 3])) * share
        else:
            for j in range(width):
                total = np.int32(0)
                for k in range(factor):
                    total += sums[j * factor + k]
                row[j] = np.float32(total) * share
    return found


@kernel
def _median(values: Any, count: int) -> float:
    """As `geometry.robust.median`, of the first values, in single precision; changes their order."""
    upper = select(values, count, count // 2)
    lower = upper
    if count % 2 == 0:
        lower = values[0]
        for i in range(count // 2):
            lower = max(lower, values[i])
    return 0.5 * np.float64(lower + upper)


@kernel
def _median_at(small: Any, places: Any, room: Any) -> float:
    for i in range(len(places)):
        room[i] = small[places[i]]
    return _median(room, len(places))


@kernel
def _is_elsewhere(small: Any, inner: Any, shape: Any, contrast: float, bounds: Any, room: Any) -> bool:
    """`stripe_search._is_elsewhere`; `contrast` is the template's."""
    count = len(inner)
    for i in range(count):
        room[i] = small[inner[i]]
    low, high = np.float64(select(room, count, count // 10)), np.float64(select(room, count, 8 * count // 10))
    if high - low < bounds[0] * contrast:
        return False
    mean = 0.0
    for place in inner:
        mean += min(max(np.float64(small[place]), low), high)
    mean /= count
    mixed, own = 0.0, 0.0
    for i in range(count):
        value = min(max(np.float64(small[inner[i]]), low), high) - mean
        mixed, own = mixed + value * shape[i], own + value * value
    return bool(mixed / max(np.sqrt(own), 1e-12) < bounds[1])


@kernel
def _noise(rest: Any, inner: Any, reach: int, room: Any) -> float:
    """`stripe_search._noise`, of ridges along x."""
    height, width = rest.shape
    for k in range(len(inner)):
        i, j = inner[k] // width, inner[k] % width
        room[k] = np.float32(0.0)
        if reach <= i < height - reach:
            room[k] = min(rest[i, j] - rest[i - reach, j], rest[i, j] - rest[i + reach, j])
    middle = np.float32(_median(room, len(inner)))
    for k in range(len(inner)):
        room[k] = abs(room[k] - middle)
    return 1.4826 * _median(room, len(inner))


@kernel
def _clear(values: Any, first: int, last: int) -> None:
    # Assigning to a slice does the same, and takes numba far longer to compile.
    for j in range(first, last):
        values[j] = np.float32(0.0)


@kernel
def _stand_out(middle: Any, one: Any, other: Any, found: Any) -> None:
    """How far values stand out above those on both sides."""
    for j in range(len(found)):
        a, b = middle[j] - one[j], middle[j] - other[j]
        found[j] = a if a < b else b


@kernel
def _keep_higher(values: Any, at: Any, height: Any, place: Any) -> None:
    for j in range(len(height)):
        higher = values[j] > height[j]
        height[j] = values[j] if higher else height[j]
        place[j] = at if higher else place[j]


@kernel
def _highest(values: Any, lanes: Any) -> Any:
    """The highest of values above zero, a whole number of lanes."""
    _clear(lanes, 0, _LANES)
    for first in range(0, len(values), _LANES):
        some = values[first : first + _LANES]
        for k in range(_LANES):
            lanes[k] = some[k] if some[k] > lanes[k] else lanes[k]
    best = np.float32(0.0)
    for k in range(_LANES):
        best = lanes[k] if lanes[k] > best else best
    return best


@kernel
def _blank(values: Any, at: Any, away: Any, apart: Any) -> None:
    for j in range(len(values)):
        values[j] = values[j] if abs(at - away[j]) > apart else np.float32(0.0)


@kernel
def _peaks(rest: Any, reach: int, least: Any, away: Any, apart: int, steep: bool, found: Any) -> None:
    """Where the ridges of each column, and of each row, are highest, the first of equal places, and how high.

    `found` (4, M), single, all zeros, has the columns' places and heights, then the rows', of which only those above
    `least` are sought. With `apart` > 0, pixels that far from a line do not count: it runs at `away` (M,) in each
    column, or in each row if `steep`.
    """
    height, width = rest.shape
    ridge = np.zeros((width + _LANES - 1) // _LANES * _LANES, np.float32)
    lanes = np.empty(_LANES, np.float32)
    whole, inner, gap = ridge[:width], ridge[reach : width - reach], np.float32(apart)
    places, heights = found[0, :width], found[1, :width]
    for i in range(height):
        row, at = rest[i], np.float32(i)
        low, high = np.int64(away[i] - apart) if steep else 0, np.int64(away[i] + apart) if steep else 0
        low, high = min(max(low, 0), width), min(max(high + 1, 0), width)
        if reach <= i < height - reach:
            _stand_out(row, rest[i - reach], rest[i + reach], whole)
            if apart > 0 and steep:
                _clear(whole, low, high)
            elif apart > 0:
                _blank(whole, at, away, gap)
            _keep_higher(whole, at, heights, places)
        _clear(whole, 0, reach)
        _clear(whole, width - reach, width)
        _stand_out(row[reach : width - reach], row[: width - 2 * reach], row[2 * reach :], inner)
        if apart > 0 and steep:
            _clear(whole, low, high)
        elif apart > 0:
            _blank(whole, at, away, gap)
        best = _highest(ridge, lanes)
        if best > least:
            j = 0
            while ridge[j] != best:
                j += 1
            found[2, i], found[3, i] = j, best


_parabola = kernel(parabola)


@kernel
def _best_draw(x: Any, y: Any, votes: Any, draws: Any) -> tuple[float, float]:
    """Slope and intercept of the drawn line that has most votes near it, the first of equals."""
    half = len(x) // 2
    best, level, most = 0.0, 0.0, -1
    for k in range(draws.shape[1]):
        a = np.int64(draws[0, k] * half)
        b = half + np.int64(draws[1, k] * (len(x) - half))
        slope = (y[b] - y[a]) / (x[b] - x[a])
        intercept = y[a] - slope * x[a]
        total = 0
        if abs(slope) <= 1.5:
            for i in range(len(x)):
                near = abs(intercept + slope * x[i] - y[i]) <= 1.5
                total += votes[i] if near else 0
        if total > most:
            best, level, most = slope, intercept, total
    return best, level


@kernel
def _consensus(peak: Any, height: Any, threshold: Any, draws: Any, extent: int, unit: int, found: Any) -> bool:
    """`stripe_search._consensus`; writes slope, intercept, start, end, level, support and count to `found` (7,)."""
    n = 0
    x, y = np.empty(len(peak), np.int64), np.empty(len(peak), np.int64)
    high, room = np.empty(len(peak), np.float32), np.empty(len(peak), np.float32)
    for j in range(len(peak)):
        if height[j] > threshold:
            x[n], y[n], high[n] = j, np.int64(peak[j]), height[j]
            n += 1
    if n < 6:
        return False
    x, y, high = x[:n], y[:n], high[:n]
    for i in range(n):
        room[i] = high[i]
    typical = _median(room, n)
    votes, near = np.empty(n, np.int64), np.empty(n, np.bool_)
    for i in range(n):
        share = high[i] / np.float32(typical)
        votes[i] = np.int64(np.rint((share if share < np.float32(1.0) else np.float32(1.0)) * np.float32(unit)))
    slope, intercept = _best_draw(x, y, votes, draws)
    for i in range(n):
        near[i] = abs(intercept + slope * x[i] - y[i]) <= 1.5
    for _ in range(2):
        n0, t1, t2, t3, t4, y0, y1, y2 = 0, 0, 0, 0, 0, 0, 0, 0
        for i in range(n):
            if near[i]:
                t = x[i] - x[0]
                n0, t1, t2, t3, t4 = n0 + 1, t1 + t, t2 + t * t, t3 + t * t * t, t4 + t * t * t * t
                y0, y1, y2 = y0 + y[i], y1 + y[i] * t, y2 + y[i] * t * t
        if n0 < 6:
            return False
        c0, c1, c2 = _parabola(n0, t1, t2, t3, t4, y0, y1, y2)
        for i in range(n):
            t = x[i] - x[0]
            near[i] = abs(c0 + c1 * t + c2 * (t * t) - y[i]) <= 1.5
    count = np.count_nonzero(near)
    by_chance = n * 4.0 / extent
    if count < max(6.0, 3.0 * by_chance):
        return False
    total, su, sv, suu, suv, m = 0, 0, 0, 0, 0, 0
    for i in range(n):
        if near[i]:
            total += votes[i]
            su, sv, suu, suv = su + x[i], sv + y[i], suu + x[i] * x[i], suv + x[i] * y[i]
            x[m], high[m] = x[i], high[i]
            m += 1
    slope = (count * suv - su * sv) / (count * suu - su * su)
    found[0], found[1] = slope, sv / count - slope * (su / count)
    found[2], found[3] = x[0], x[m - 1]
    found[4] = _median(high, m)
    found[5], found[6] = np.float64(total) * typical / unit, count
    return True


@kernel
def without_light(
    small: Any,
    template: Any,
    mask: Any,
    light: Any,
    dark: Any,
    inner: Any,
    shape: Any,
    levels: Any,
    bounds: Any,
    reach: int,
    rest: Any,
) -> Any:
    """What `template` does not explain of a reduced image, into `rest`.

    Returns the share of the template's light, the noise of the ridges in `rest`, and whether the image shows other
    squares (`rest` is then left as it is).

    `levels` are the template's light, dark, low and high level.
    """
    height, width = small.shape
    flat = small.ravel()
    room = np.empty(max(len(inner), 1), np.float32)
    share, offset = 0.0, 0.0
    known = len(light) > 0 and len(dark) > 0
    if known:
        low = _median_at(flat, dark, room)
        share = max((_median_at(flat, light, room) - low) / max(levels[0] - levels[1], 1.0), 0.0)
        offset = low - share * levels[1]
    if len(inner) >= 10 and _is_elsewhere(flat, inner, shape, levels[3] - levels[2], bounds, room):
        return share, 0.0, True
    part, ground = np.float32(share), np.float32(offset)
    for i in range(height):
        for j in range(width):
            value = (small[i, j] - part * template[i, j] - ground) * np.float32(mask[i, j])
            rest[i, j] = value if known else np.float32(0.0)
    return share, _noise(rest, inner, reach, room) if len(inner) > 0 else 0.0, False


@kernel
def best_line(
    rest: Any, reach: int, threshold: float, before: Any, apart: int, draws: Any, unit: int, found: Any
) -> bool:
    """`stripe_search._best_line` among the ridges of `rest`: as `_consensus`, and 1 if it is steep, to `found` (8,).

    With `apart` > 0, among pixels that far from the line `before`.
    """
    height, width = rest.shape
    most, least, steep = max(height, width), np.float32(threshold), before[7] > 0.0
    away = np.empty(most, np.float32)
    last = (width if steep else height) - 1
    for k in range(height if steep else width):
        away[k] = min(max(np.rint(before[1] + before[0] * k), -apart), last + apart)
    peaks = np.zeros((4, most), np.float32)
    _peaks(rest, reach, least, away, apart, steep, peaks)
    line = np.empty(7)
    any_line = False
    for way in range(2):
        count, extent = (width, height) if way == 0 else (height, width)
        places, heights = peaks[2 * way, :count], peaks[2 * way + 1, :count]
        is_line = _consensus(places, heights, least, draws, extent, unit, line)
        if is_line and not (any_line and found[5] >= line[5]):
            any_line = True
            for k in range(7):
                found[k] = line[k]
            found[7] = way
    return any_line
