"""The passes over pixels of `stripe_bands` and `stripe_fit`, compiled by numba; imported only where they pay.

Each gives the very bits that the NumPy way gives: the same operations in the same precision and order (a sum over a
profile's pixels runs from the first to the last in both), while exponentials are left to NumPy. So it does not matter
to the result which way was taken, and every decision on the way falls alike.

Tables are (P, B, N) as in `stripe_bands`. They are gone through in pieces of `_PIECE` profiles, which are copied to one
small array first: the compiler then sees that nothing overlaps and works on several profiles at once, and what is
summed stays in the fastest memory.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.geometry.compiled import kernel

_PIECE = 128


@kernel
def _copy(source: Any, target: Any, count: int) -> None:
    for i in range(count):
        target[i] = source[i]


@kernel
def exponents(v: Any, centre: Any, cosine: Any, by_width: Any, found: Any) -> None:
    """-d^2 / 2 (P, B, N) of the pixels' distances d in widths; `by_width` (B,) is 1 / width."""
    profile_pixels, bands, profiles = v.shape
    half = np.float32(-0.5)
    for p in range(profile_pixels):
        for b in range(bands):
            at, middle, tilt, out, scale = v[p, b], centre[b], cosine[b], found[p, b], by_width[b]
            for n in range(profiles):
                d = (at[n] - middle[n]) * tilt[n] * scale
                out[n] = half * (d * d)


@kernel
def normal_equations(
    v: Any,
    values: Any,
    ambient: Any,
    good: Any,
    light: Any,
    bell: Any,
    centre: Any,
    cosine: Any,
    slant: Any,
    height: Any,
    background: Any,
    each: Any,
    rows: Any,
) -> None:
    """The sums of `stripe_fit._normal_equations` (14, B, N), one row after the other.

    `slant` (B, N) is cosine over width; `each` (B, 6) has 1 / width, light from dark squares, 1 less that, and the
    noise's three numbers.
    """
    profile_pixels, bands, profiles = v.shape
    zero, size = np.float32(0.0), _PIECE
    s = np.zeros(25 * _PIECE, np.float32)
    at, value, around = s[:size], s[size : 2 * size], s[2 * size : 3 * size]
    counts, share, peak = s[3 * size : 4 * size], s[4 * size : 5 * size], s[5 * size : 6 * size]
    middle, tilt, slope = s[6 * size : 7 * size], s[7 * size : 8 * size], s[8 * size : 9 * size]
    high, base = s[9 * size : 10 * size], s[10 * size : 11 * size]
    s00, s01, s02 = s[11 * size : 12 * size], s[12 * size : 13 * size], s[13 * size : 14 * size]
    s03, s04, s11 = s[14 * size : 15 * size], s[15 * size : 16 * size], s[16 * size : 17 * size]
    s12, s13, s14 = s[17 * size : 18 * size], s[18 * size : 19 * size], s[19 * size : 20 * size]
    s22, s23, s24 = s[20 * size : 21 * size], s[21 * size : 22 * size], s[22 * size : 23 * size]
    s33, s34 = s[23 * size : 24 * size], s[24 * size : 25 * size]
    for b in range(bands):
        scale, dark, rest, reading, shots, speckle = each[b]
        for first in range(0, profiles, size):
            last = min(first + size, profiles)
            count = last - first
            _copy(centre[b, first:last], middle, count)
            _copy(cosine[b, first:last], tilt, count)
            _copy(slant[b, first:last], slope, count)
            _copy(height[b, first:last], high, count)
            _copy(background[b, first:last], base, count)
            for i in range(11 * size, 25 * size):
                s[i] = zero
            for p in range(profile_pixels):
                _copy(v[p, b, first:last], at, count)
                _copy(values[p, b, first:last], value, count)
                _copy(ambient[p, b, first:last], around, count)
                _copy(good[p, b, first:last], counts, count)
                _copy(light[p, b, first:last], share, count)
                _copy(bell[p, b, first:last], peak, count)
                for i in range(size):
                    d = (at[i] - middle[i]) * tilt[i] * scale
                    by_height = peak[i] * (dark + rest * share[i])
                    signal = high[i] * by_height
                    residual = value[i] - base[i] - signal
                    level = value[i] + around[i]
                    level = level if level > zero else zero
                    weight = counts[i] / (reading + shots * level + speckle * signal * signal)
                    by_centre, by_width = signal * d * slope[i], signal * (d * d)
                    w1, w2, w3 = by_height * weight, by_centre * weight, by_width * weight
                    s00[i] += weight
                    s01[i] += weight * by_height
                    s02[i] += weight * by_centre
                    s03[i] += weight * by_width
                    s04[i] += weight * residual
                    s11[i] += w1 * by_height
                    s12[i] += w1 * by_centre
                    s13[i] += w1 * by_width
                    s14[i] += w1 * residual
                    s22[i] += w2 * by_centre
                    s23[i] += w2 * by_width
                    s24[i] += w2 * residual
                    s33[i] += w3 * by_width
                    s34[i] += w3 * residual
            for k in range(14):
                _copy(s[(11 + k) * size : (12 + k) * size], rows[k, b, first:last], count)


@kernel
def start(values: Any, good: Any, light: Any, bell: Any, each: Any, height: Any, background: Any) -> None:
    """Heights and backgrounds (B, N) of `stripe_fit._start`; `each` (B, 2) has the light from dark squares, and 1 less
    that."""
    one, least = np.float32(1.0), np.float32(1e-3)
    profile_pixels, bands, profiles = values.shape
    zero, size = np.float32(0.0), _PIECE
    s = np.zeros(9 * _PIECE, np.float32)
    value, counts = s[:size], s[size : 2 * size]
    share, peak = s[2 * size : 3 * size], s[3 * size : 4 * size]
    n, b1, v1 = s[4 * size : 5 * size], s[5 * size : 6 * size], s[6 * size : 7 * size]
    bb, bv = s[7 * size : 8 * size], s[8 * size : 9 * size]
    for b in range(bands):
        dark, rest = each[b]
        for first in range(0, profiles, size):
            last = min(first + size, profiles)
            count = last - first
            for i in range(4 * size, 9 * size):
                s[i] = zero
            for p in range(profile_pixels):
                _copy(values[p, b, first:last], value, count)
                _copy(good[p, b, first:last], counts, count)
                _copy(light[p, b, first:last], share, count)
                _copy(bell[p, b, first:last], peak, count)
                for i in range(size):
                    top = peak[i] * (dark + rest * share[i])
                    weighted = counts[i] * top
                    n[i] += counts[i]
                    b1[i] += weighted
                    v1[i] += counts[i] * value[i]
                    bb[i] += weighted * top
                    bv[i] += weighted * value[i]
            for i in range(count):
                det = n[i] * bb[i] - b1[i] * b1[i]
                high = (n[i] * bv[i] - b1[i] * v1[i]) / (det if det > least else least)
                high = high if high > one else one
                height[b, first + i] = high
                background[b, first + i] = (v1[i] - high * b1[i]) / (n[i] if n[i] > one else one)


@kernel
def beside(
    v: Any, values: Any, good: Any, background: Any, centre: Any, cosine: Any, by_width: Any, beyond: Any, found: Any
) -> None:
    """Mean distance (B,) from the background of the pixels further than `beyond` widths from the stripe."""
    profile_pixels, bands, profiles = v.shape
    zero, one, size = np.float32(0.0), np.float32(1.0), _PIECE
    s = np.zeros(8 * _PIECE, np.float32)
    at, value, counts = s[:size], s[size : 2 * size], s[2 * size : 3 * size]
    middle, tilt, base = s[3 * size : 4 * size], s[4 * size : 5 * size], s[5 * size : 6 * size]
    far, number = s[6 * size : 7 * size], s[7 * size :]
    for b in range(bands):
        total, count_all = 0.0, 0.0
        for first in range(0, profiles, size):
            last = min(first + size, profiles)
            count = last - first
            _copy(centre[b, first:last], middle, count)
            _copy(cosine[b, first:last], tilt, count)
            _copy(background[b, first:last], base, count)
            for i in range(size):
                far[i] = zero
                number[i] = zero
            for p in range(profile_pixels):
                _copy(v[p, b, first:last], at, count)
                _copy(values[p, b, first:last], value, count)
                _copy(good[p, b, first:last], counts, count)
                for i in range(size):
                    d = (at[i] - middle[i]) * tilt[i] * by_width[b]
                    flank = counts[i] * (one if abs(d) > beyond else zero)
                    far[i] += abs(value[i] - base[i]) * flank
                    number[i] += flank
            for i in range(count):
                total += np.float64(far[i])
                count_all += np.float64(number[i])
        found[b] = total / max(count_all, 1.0)


@kernel
def ambient_products(
    v: Any, values: Any, bright: Any, good: Any, centre: Any, cosine: Any, beyond: Any, own: Any, cross: Any
) -> None:
    """Sums (B, N) of bright * bright and bright * values over the pixels further than `beyond` (B,) from the centre,
    both less their means there."""
    profile_pixels, bands, profiles = v.shape
    zero, one, size = np.float32(0.0), np.float32(1.0), _PIECE
    s = np.zeros(11 * _PIECE, np.float32)
    at, value, board = s[:size], s[size : 2 * size], s[2 * size : 3 * size]
    counts, middle, tilt = s[3 * size : 4 * size], s[4 * size : 5 * size], s[5 * size : 6 * size]
    n, of_value, of_board = s[6 * size : 7 * size], s[7 * size : 8 * size], s[8 * size : 9 * size]
    mine, mixed = s[9 * size : 10 * size], s[10 * size : 11 * size]
    for b in range(bands):
        for first in range(0, profiles, size):
            last = min(first + size, profiles)
            count = last - first
            _copy(centre[b, first:last], middle, count)
            _copy(cosine[b, first:last], tilt, count)
            for i in range(6 * size, 11 * size):
                s[i] = zero
            for means in (True, False):
                for p in range(profile_pixels):
                    _copy(v[p, b, first:last], at, count)
                    _copy(values[p, b, first:last], value, count)
                    _copy(bright[p, b, first:last], board, count)
                    _copy(good[p, b, first:last], counts, count)
                    if means:
                        for i in range(size):
                            d = (at[i] - middle[i]) * tilt[i]
                            flank = counts[i] * (one if abs(d) > beyond[b] else zero)
                            n[i] += flank
                            of_value[i] += value[i] * flank
                            of_board[i] += board[i] * flank
                    else:
                        for i in range(size):
                            d = (at[i] - middle[i]) * tilt[i]
                            flank = counts[i] * (one if abs(d) > beyond[b] else zero)
                            x, y = flank * (board[i] - of_board[i]), flank * (value[i] - of_value[i])
                            mine[i] += x * x
                            mixed[i] += x * y
                if means:
                    for i in range(size):
                        total = n[i] if n[i] > one else one
                        of_value[i] = of_value[i] / total
                        of_board[i] = of_board[i] / total
            _copy(mine, own[b, first:last], count)
            _copy(mixed, cross[b, first:last], count)


@kernel
def _wave_entries(x: Any, scale: Any, low: Any, high: Any, last: Any, index: Any) -> None:
    """Entries of a table with this `last` one that `albedo.soft_square_wave` has at x kept from `low` to `high`."""
    one, two, half, none = np.float32(1.0), np.float32(2.0), np.float32(0.5), np.float32(0.0)
    middle = half * last + half
    for i in range(_PIECE):
        kept = x[i] if x[i] > low else low
        kept = kept if kept < high else high
        turn = half * kept + np.float32(0.25)
        distance = half - abs(two * (turn - np.floor(turn)) - one)
        step = distance * scale[i] + middle
        step = step if step > none else none
        index[i] = np.int32(step if step < last else last)


@kernel
def _step_entries(x: Any, sign: Any, offset: Any, scale: Any, last: Any, index: Any) -> None:
    """The same of `albedo._soft_step` at sign * x + offset."""
    half, none = np.float32(0.5), np.float32(0.0)
    middle = half * last + half
    for i in range(_PIECE):
        step = (sign * x[i] + offset) * scale[i] + middle
        step = step if step > none else none
        index[i] = np.int32(step if step < last else last)


@kernel
def _behind_edge(share: Any, table: Any, index: Any, count: int) -> None:
    """Let shares become light beyond an edge, by the table's entries there."""
    one, half = np.float32(1.0), np.float32(0.5)
    for i in range(count):
        share[i] = one - (one - share[i]) * (half + half * table[np.uint32(index[i])])


@kernel
def light_shares(
    v: Any,
    centre: Any,
    grid: Any,
    per_v: Any,
    scales: Any,
    size: Any,
    near: Any,
    first_is_dark: bool,
    table: Any,
    found: Any,
) -> None:
    """`PanelAlbedo.light_share` (P, B, N) at pixels; `grid`, `per_v`, `scales` are (2, B, N), for x and y.

    `size` (2,) is how many corners, `near` (2, 2) whether the board's lower and upper end are near; `table` is of the
    error function.
    """
    profile_pixels, bands, profiles = v.shape
    one, half, last = np.float32(1.0), np.float32(0.5), np.float32(len(table) - 1)
    sign = -half if first_is_dark else half
    low, high_x, high_y = np.float32(-0.5), size[0] - half, size[1] - half
    piece = _PIECE
    s = np.zeros(11 * _PIECE, np.float32)
    at, centres = s[:piece], s[piece : 2 * piece]
    x0, y0 = s[2 * piece : 3 * piece], s[3 * piece : 4 * piece]
    slope_x, slope_y = s[4 * piece : 5 * piece], s[5 * piece : 6 * piece]
    scale_x, scale_y, share = s[6 * piece : 7 * piece], s[7 * piece : 8 * piece], s[8 * piece : 9 * piece]
    x, y = s[9 * piece : 10 * piece], s[10 * piece :]
    index = np.zeros(2 * _PIECE, np.int32)
    index_x, index_y = index[:piece], index[piece:]
    for b in range(bands):
        for first in range(0, profiles, piece):
            end = min(first + piece, profiles)
            count = end - first
            _copy(centre[b, first:end], centres, count)
            _copy(grid[0, b, first:end], x0, count)
            _copy(grid[1, b, first:end], y0, count)
            _copy(per_v[0, b, first:end], slope_x, count)
            _copy(per_v[1, b, first:end], slope_y, count)
            _copy(scales[0, b, first:end], scale_x, count)
            _copy(scales[1, b, first:end], scale_y, count)
            for p in range(profile_pixels):
                _copy(v[p, b, first:end], at, count)
                for i in range(piece):
                    x[i] = (at[i] - centres[i]) * slope_x[i] + x0[i]
                    y[i] = (at[i] - centres[i]) * slope_y[i] + y0[i]
                _wave_entries(x, scale_x, low, high_x, last, index_x)
                _wave_entries(y, scale_y, low, high_y, last, index_y)
                for i in range(count):
                    share[i] = half + sign * (table[np.uint32(index_x[i])] * table[np.uint32(index_y[i])])
                if near[0, 0]:
                    _step_entries(x, one, one, scale_x, last, index_x)
                    _behind_edge(share, table, index_x, count)
                if near[0, 1]:
                    _step_entries(x, -one, size[0], scale_x, last, index_x)
                    _behind_edge(share, table, index_x, count)
                if near[1, 0]:
                    _step_entries(y, one, one, scale_y, last, index_y)
                    _behind_edge(share, table, index_y, count)
                if near[1, 1]:
                    _step_entries(y, -one, size[1], scale_y, last, index_y)
                    _behind_edge(share, table, index_y, count)
                _copy(share, found[p, b, first:end], count)


@kernel
def _take(image: Any, middle: Any, along: Any, shift: int, steep: bool, row: int, column: int, found: Any) -> None:
    """Pixels of an image, whose first one is at `row` and `column`, at one distance from the middles of profiles."""
    if steep:
        for n in range(len(found)):
            found[n] = image[np.uint64(along[n] - row), np.uint64(middle[n] + shift - column)]
    else:
        for n in range(len(found)):
            found[n] = image[np.uint64(middle[n] + shift - row), np.uint64(along[n] - column)]


@kernel
def cut_band(
    image: Any,
    bright: Any,
    steep: bool,
    low: Any,
    high: Any,
    limit: float,
    band: int,
    u: Any,
    centre: Any,
    valid: Any,
    half: int,
    reach: int,
    v: Any,
    values: Any,
    levels: Any,
    good: Any,
) -> None:
    """One band of `stripe_bands.cut`, into the tables' [:, band]; `low` and `high` are of the panel in the image."""
    across = 0 if steep else 1
    least, most = low[across], high[across] - 1
    count = u.shape[1]
    middle, along = np.empty(count, np.int64), np.empty(count, np.int64)
    counts, at, good_at = np.empty(count, np.float32), np.empty(count, np.float32), np.empty(count, np.float32)
    first, last, bound = most, least, np.float32(limit)
    for n in range(count):
        middle[n], along[n] = np.int64(np.rint(centre[band, n])), np.int64(u[band, n])
        counts[n] = np.float32(1.0) if valid[band, n] else np.float32(0.0)
        first, last = min(first, middle[n]), max(last, middle[n])
    is_inside = first - reach >= least and last + reach <= most
    for k in range(2 * reach + 1):
        shift = k - reach
        value_row, level_row = values[k, band], levels[k, band]
        if is_inside:
            _take(image, middle, along, shift, steep, 0, 0, value_row)
            _take(bright, middle, along, shift, steep, low[1], low[0], level_row)
        else:
            for n in range(count):
                safe = min(max(middle[n] + shift, least), most)
                row, column = (along[n], safe) if steep else (safe, along[n])
                value_row[n] = image[np.uint64(row), np.uint64(column)]
                level_row[n] = bright[np.uint64(row - low[1]), np.uint64(column - low[0])]
        within = abs(shift) <= half
        for n in range(count):
            at[n] = np.float32(middle[n] + shift)
            there = (at[n] >= least) & (at[n] <= most) & (value_row[n] < bound)
            good_at[n] = counts[n] if there and within else np.float32(0.0)
        _copy(at, v[k, band], count)
        _copy(good_at, good[k, band], count)


@kernel
def samples(
    values: Any,
    ambient: Any,
    good: Any,
    light: Any,
    bell: Any,
    height: Any,
    background: Any,
    ratio: Any,
    most: int,
    found: Any,
) -> Any:
    """`stripe_noise.Samples.of`: residual, level and signal (B, 3, M) of pixels, and how many each (B,)."""
    profile_pixels, bands, profiles = values.shape
    zero, one = np.float32(0.0), np.float32(1.0)
    counts = np.zeros(bands, np.int64)
    for b in range(bands):
        total = 0
        for p in range(profile_pixels):
            for n in range(profiles):
                total += good[p, b, n] != zero
        step, dark, rest = max(total // most, 1), ratio[b], one - ratio[b]
        number, taken = 0, 0
        for p in range(profile_pixels):
            for n in range(profiles):
                if good[p, b, n] != zero:
                    if number == 0:
                        signal = height[b, n] * (bell[p, b, n] * (dark + rest * light[p, b, n]))
                        level = values[p, b, n] + ambient[p, b, n]
                        found[b, 0, taken] = values[p, b, n] - background[b, n] - signal
                        found[b, 1, taken] = level if level > zero else zero
                        found[b, 2, taken] = signal
                        taken += 1
                        number = step
                    number -= 1
        counts[b] = taken
    return counts


@kernel
def _usable(x: Any, y: Any, lowest: Any, two: Any, board: Any) -> bool:
    """`PanelAlbedo.is_usable` at grid coordinates; `lowest` and `two` have the precision of x and y.

    `board` are how far it reaches along x and along y, the margin included, and which squares are usable.
    """
    right, bottom, usable = board
    if not (x > lowest and y > lowest and x < right and y < bottom):
        return False
    rows, columns = usable.shape
    i = min(max(np.int64(np.floor(x + two)), 0), columns - 1)
    j = min(max(np.int64(np.floor(y + two)), 0), rows - 1)
    return bool(usable[j, i])


@kernel
def _from_nodes(nodes: Any, px: Any, py: Any, at: Any) -> None:
    """`PanelView._at`: the first values of a table of nodes, at a pixel, into `at`.

    `nodes` are the table, its rows and columns, the pixels between them, and the pixel of the first.
    """
    table, node_rows, node_columns, node_step, low = nodes
    one = np.float32(1.0)
    column, row = (px - low[0]) / node_step, (py - low[1]) / node_step
    i = min(max(np.int64(column), 0), node_columns - 2)
    j = min(max(np.int64(row), 0), node_rows - 2)
    x, y = np.float32(column - i), np.float32(row - j)
    first = j * node_columns + i
    for k in range(len(at)):
        upper = table[first, k] * (one - x) + table[first + 1, k] * x
        lower = table[first + node_columns, k] * (one - x) + table[first + node_columns + 1, k] * x
        at[k] = upper * (one - y) + lower * y


@kernel
def usable_ranges(
    nodes: Any, board: Any, lowest: Any, high: Any, first: Any, last: Any, lines: Any, steep: bool, u: Any
) -> Any:
    """`stripe_bands.usable_ranges`: those coordinates from `first` to `last` (B,) whose centre on the `lines` (B, 2),
    intercept and slope, lies in a usable square, to the front of `u` (B, N), and how many (B,)."""
    across, low = 0 if steep else 1, nodes[4]
    lowest, two = np.float32(lowest), np.float32(2.0)
    at = np.empty(2, np.float32)
    counts = np.zeros(len(u), np.int64)
    for b in range(len(u)):
        n = 0
        for along in range(first[b], last[b] + 1):
            v = lines[b, 1] * along + lines[b, 0]
            if v > low[across] + 3 and v < high[across] - 4:
                px, py = (v, np.float64(along)) if steep else (np.float64(along), v)
                _from_nodes(nodes, px, py, at)
                if _usable(at[0], at[1], lowest, two, board):
                    u[b, n] = along
                    n += 1
        counts[b] = n
    return counts


@kernel
def squares(
    nodes: Any,
    board: Any,
    lowest: Any,
    u: Any,
    centre: Any,
    cosine: Any,
    sine: Any,
    width: Any,
    blur: Any,
    steep: Any,
    grid: Any,
    per_v: Any,
    edges: Any,
    inside: Any,
) -> None:
    """`stripe_bands._squares`, into `grid`, `per_v`, `edges` (2, B, N) and `inside` (B, N)."""
    two, lowest_single = np.float32(2.0), np.float32(lowest)
    at = np.empty(6, np.float32)
    across = np.empty(2)
    for b in range(u.shape[0]):
        smaller = min(blur, width[b])
        blur2 = smaller * smaller
        thickness = 1.0 - blur2 / (width[b] * width[b])
        reach = 2.5 * width[b]
        for n in range(u.shape[1]):
            px, py = (centre[b, n], u[b, n]) if steep else (u[b, n], centre[b, n])
            _from_nodes(nodes, px, py, at)
            c, s = cosine[b, n], sine[b, n]
            for k in range(2):
                by_first, by_second = at[2 + 2 * k], at[3 + 2 * k]
                by_u, by_v = (by_second, by_first) if steep else (by_first, by_second)
                across[k] = by_v * c - by_u * s
                along = by_u * c + by_v * s
                edges[k, b, n] = np.sqrt(blur2 * (thickness * (across[k] * across[k]) + along * along))
                per_v[k, b, n] = by_v * (c * c * thickness + s * s) + by_u * ((1.0 - thickness) * c * s)
                grid[k, b, n] = at[k]
            dx, dy = reach * across[0], reach * across[1]
            fine = _usable(at[0], at[1], lowest_single, two, board)
            fine = fine and _usable(at[0] - dx, at[1] - dy, lowest, 2.0, board)
            fine = fine and _usable(at[0] + dx, at[1] + dy, lowest, 2.0, board)
            inside[b, n] = np.float32(1.0) if fine else np.float32(0.0)
