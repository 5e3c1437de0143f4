"""The search for straight stretches of a scan, and the final fit of each, compiled by numba; imported only where they
pay.

The same as the NumPy way in `scan_lines`, which explains it, but for rounding: sums run from the first beam to the
last, angles between neighbours come from their directions, and a circle's singular vectors from Jacobi's rotations.

Beams come as two tables, see `scan_lines.Beams`: `rows` (3, N) are the columns of cos and sin and
the inverse ranges, in units of sigma, `polar` (4, N) cos and sin of the angle, the range, and how many sweeps count.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from lidarpose.detect.stripe_profile_kernels import select
from lidarpose.geometry.compiled import kernel
from lidarpose.geometry.robust import MAD_TO_SIGMA

# The least floating-point number of full precision.
_TINY = 2.2250738585072014e-308
_EPSILON = 2.220446049250313e-16


@kernel
def straight(rows: Any, polar: Any, window: int) -> Any:
    """Which windows (N - window + 1,) are straight within the noise."""
    count = polar.shape[1] - window + 1
    good = np.empty(count, np.bool_)
    half = window // 2
    for i in range(count):
        c, s, inverse = polar[0, i + half], polar[1, i + half], 1.0 / polar[2, i + half]
        cc = cs = ss = qc = qs = qq = 0.0
        for j in range(i, i + window):
            w = rows[2, j] * polar[2, j]
            cosine = (polar[0, j] * c + polar[1, j] * s) * w
            sine = (polar[1, j] * c - polar[0, j] * s) * w
            q = (1.0 / polar[2, j] - inverse) * w + (w - cosine) * inverse
            cc, cs, ss = cc + cosine * cosine, cs + cosine * sine, ss + sine * sine
            qc, qs, qq = qc + q * cosine, qs + q * sine, qq + q * q
        det = max(cc * ss - cs * cs, 1e-300)
        chi2 = qq - (ss * qc * qc - 2.0 * cs * qc * qs + cc * qs * qs) / det
        good[i] = chi2 < 4.0 * (window - 2) + 6.0
    return good


@kernel
def _normal(rows: Any, weights: Any, first: int, last: int, sums: Any) -> None:
    """Add products of columns (3,) of beams [first, last)."""
    cc, cs, ss = sums[0], sums[1], sums[2]
    for k in range(first, last):
        c, s, w = rows[0, k], rows[1, k], weights[k]
        cc, cs, ss = cc + w * c * c, cs + w * c * s, ss + w * s * s
    sums[0], sums[1], sums[2] = cc, cs, ss


@kernel
def _pull(rows: Any, weights: Any, first: int, last: int, line: Any, sums: Any) -> None:
    """Add products (2,) of columns with what a line leaves of the inverse ranges, and its sum of squares."""
    x, y = line[0], line[1]
    qc, qs, qq = sums[3], sums[4], sums[5]
    for k in range(first, last):
        c, s = rows[0, k], rows[1, k]
        q = rows[2, k] - (x * c + y * s)
        weighted = weights[k] * q
        qc, qs, qq = qc + weighted * c, qs + weighted * s, qq + weighted * q
    sums[3], sums[4], sums[5] = qc, qs, qq


@kernel
def _fit(rows: Any, weights: Any, a: Any, b: Any, line: Any, sums: Any) -> float:
    """Fit a line (2,), in place, to two stretches of beams (the second may be empty); chi-squared."""
    line[0] = line[1] = 0.0
    sums[:] = 0.0
    _normal(rows, weights, a[0], a[1], sums)
    _normal(rows, weights, b[0], b[1], sums)
    p, q, s = sums[0], sums[1], sums[2]
    det = p * s - q * q
    if det == 0.0:
        det = _TINY
    # One step of refinement: the plain normal equations lose half of the digits.
    for _ in range(2):
        sums[3:] = 0.0
        _pull(rows, weights, a[0], a[1], line, sums)
        _pull(rows, weights, b[0], b[1], line, sums)
        x, y = sums[3], sums[4]
        line[0] += (s * x - q * y) / det
        line[1] += (p * y - q * x) / det
    sums[3:] = 0.0
    _pull(rows, weights, a[0], a[1], line, sums)
    _pull(rows, weights, b[0], b[1], line, sums)
    return float(sums[5])


@kernel
def _best_cut(rows: Any, first: int, last: int, line: Any, sums: Any) -> Any:
    """Where two lines gain most over one, and by how much chi-squared drops."""
    n = last - first
    cc = cs = ss = ec = es = 0.0
    for k in range(n):
        c, s = rows[0, first + k], rows[1, first + k]
        e = rows[2, first + k] - (line[0] * c + line[1] * s)
        cc, cs, ss, ec, es = cc + c * c, cs + c * s, ss + s * s, ec + c * e, es + s * e
        sums[0, k], sums[1, k], sums[2, k], sums[3, k], sums[4, k] = cc, cs, ss, ec, es
    best, most = 0, -np.inf
    for k in range(2, n - 3):
        a, b, d, e, f = sums[0, k], sums[1, k], sums[2, k], sums[3, k], sums[4, k]
        det = max(a * d - b * b, 1e-12 * a * d)
        gain = (d * e * e - 2.0 * b * e * f + a * f * f) / det
        a, b, d, e, f = cc - a, cs - b, ss - d, ec - e, es - f
        det = max(a * d - b * b, 1e-12 * a * d)
        gain += (d * e * e - 2.0 * b * e * f + a * f * f) / det
        if gain > most:
            best, most = k, gain
    return first + best + 1, most


@kernel
def _smallest(columns: Any) -> Any:
    """Right singular vector (3,) of the smallest singular value of a table given by columns (3, N), by Jacobi's
    rotations of them; the table is changed."""
    v = np.eye(3)
    for _ in range(30):
        turned = False
        for p in range(2):
            for q in range(p + 1, 3):
                pp = qq = pq = 0.0
                for k in range(columns.shape[1]):
                    x, y = columns[p, k], columns[q, k]
                    pp, qq, pq = pp + x * x, qq + y * y, pq + x * y
                if not abs(pq) > 2.0 * _EPSILON * np.sqrt(pp * qq):
                    continue
                turned = True
                slope = (qq - pp) / (2.0 * pq)
                t = np.copysign(1.0 / (abs(slope) + np.sqrt(1.0 + slope * slope)), slope)
                c = 1.0 / np.sqrt(1.0 + t * t)
                s = c * t
                for k in range(columns.shape[1]):
                    x, y = columns[p, k], columns[q, k]
                    columns[p, k], columns[q, k] = c * x - s * y, s * x + c * y
                for k in range(3):
                    x, y = v[k, p], v[k, q]
                    v[k, p], v[k, q] = c * x - s * y, s * x + c * y
        if not turned:
            break
    least, which = np.inf, 0
    for p in range(3):
        size = 0.0
        for k in range(columns.shape[1]):
            size += columns[p, k] * columns[p, k]
        if size < least:
            least, which = size, p
    return v[:, which].copy()


@kernel
def _circle_chi2(polar: Any, first: int, last: int, noise: float) -> float:
    """Chi-squared of the circle through beams, by Taubin's fit (`fit_circle2`); infinite where there is none."""
    n = last - first
    r = polar[2, first:last]
    x, y = polar[0, first:last] * r, polar[1, first:last] * r
    mean_x = mean_y = squares = mean_z = 0.0
    for k in range(n):
        mean_x, mean_y = mean_x + x[k] / n, mean_y + y[k] / n
    for k in range(n):
        squares += ((x[k] - mean_x) ** 2 + (y[k] - mean_y) ** 2) / n
    spread = np.sqrt(squares)
    if not spread > 0.0:
        return np.inf
    columns = np.empty((3, n))
    for k in range(n):
        columns[1, k], columns[2, k] = (x[k] - mean_x) / spread, (y[k] - mean_y) / spread
        columns[0, k] = columns[1, k] ** 2 + columns[2, k] ** 2
        mean_z += columns[0, k] / n
    scale = 2.0 * np.sqrt(mean_z)
    for k in range(n):
        columns[0, k] = (columns[0, k] - mean_z) / scale
    found = _smallest(columns)
    a = found[0] / scale
    if abs(a) < 1e-12:
        return np.inf
    u, v = -found[1] / (2.0 * a), -found[2] / (2.0 * a)
    radius = spread * np.sqrt(u * u + v * v + mean_z)
    u, v = mean_x + spread * u, mean_y + spread * v
    chi2 = 0.0
    for k in range(n):
        dx, dy = x[k] - u, y[k] - v
        distance = np.sqrt(dx * dx + dy * dy)
        outward = (dx * polar[0, first + k] + dy * polar[1, first + k]) / max(distance, 1e-12)
        # The distance along the beam is what the noise is stated for.
        along = (distance - radius) / max(abs(outward), 0.2)
        chi2 += (along / noise) ** 2 * polar[3, first + k]
    return chi2


@kernel
def _split(rows: Any, polar: Any, runs: Any, noise: float, limits: Any, segments: Any, curved: Any) -> Any:
    """Cut runs wherever two lines explain them better than one; how many segments and curves there are now."""
    _, fewest, least_gain, least_deviation = limits
    ones, line, sums = np.ones(rows.shape[1]), np.empty(2), np.empty(6)
    none = np.zeros(2, np.int64)
    scratch = np.empty((5, rows.shape[1]))
    waiting = np.empty((rows.shape[1] + 1, 2), np.int64)
    kept = bent = 0
    for k in range(len(runs)):
        waiting[0, 0], waiting[0, 1] = runs[k, 0], runs[k, 1]
        left = 1
        while left > 0:
            left -= 1
            first, last = waiting[left, 0], waiting[left, 1]
            if last - first < fewest:
                continue
            chi2 = _fit(rows, ones, waiting[left], none, line, sums)
            cut, gain = _best_cut(rows, first, last, line, scratch)
            if gain < least_gain or np.sqrt(max(gain, 0.0) / (last - first)) < least_deviation:
                segments[kept, 0], segments[kept, 1] = first, last
                kept += 1
            elif _circle_chi2(polar, first, last, noise) < chi2 - gain:
                curved[bent, 0], curved[bent, 1] = first, last
                bent += 1
            else:
                waiting[left, 0], waiting[left, 1] = cut, last
                waiting[left + 1, 0], waiting[left + 1, 1] = first, cut
                left += 2
    return kept, bent


@kernel
def _distance(polar: Any, i: int, j: int) -> float:
    x = polar[2, i] * polar[0, i] - polar[2, j] * polar[0, j]
    y = polar[2, i] * polar[1, i] - polar[2, j] * polar[1, j]
    return float(np.sqrt(x * x + y * y))


@kernel
def _on_one_line(rows: Any, polar: Any, a: Any, b: Any, limits: Any, ones: Any, line: Any, sums: Any) -> bool:
    window, _, least_gain, least_deviation = limits
    if b[0] - a[1] > 2 * window:
        shorter = min(_distance(polar, a[0], a[1] - 1), _distance(polar, b[0], b[1] - 1))
        if _distance(polar, a[1] - 1, b[0]) > 0.25 * shorter:
            return False
    none = np.zeros(2, np.int64)
    apart = _fit(rows, ones, a, none, line, sums) + _fit(rows, ones, b, none, line, sums)
    together = a[1] - a[0] + b[1] - b[0]
    if b[0] <= a[1]:  # windows that see a stray range are few, so that stretches beside it may overlap
        a, b = np.array([a[0], b[1]]), none
        together = a[1] - a[0]
    gain = _fit(rows, ones, a, b, line, sums) - apart
    return bool(gain < least_gain or gain / together < least_deviation**2)


@kernel
def segments_of(rows: Any, polar: Any, runs: Any, noise: float, limits: Any) -> Any:
    """Straight stretches (S, 2) and curved ones (C, 2) within runs (R, 2) of beams, all of them [first, last).

    `limits` are `scan_lines.WINDOW`, LEAST_BEAMS, SPLIT_GAIN and LEAST_DEVIATION.
    """
    window = limits[0]
    segments, curved = np.empty((rows.shape[1], 2), np.int64), np.empty((rows.shape[1], 2), np.int64)
    kept, bent = _split(rows, polar, runs, noise, limits, segments, curved)
    ones, line, sums = np.ones(rows.shape[1]), np.empty(2), np.empty(6)
    done = 0
    for k in range(kept):
        first, last = segments[k, 0], segments[k, 1]
        beside = False
        for c in range(bent):
            beside = beside or (first <= curved[c, 1] + 2 * window and last >= curved[c, 0] - 2 * window)
        if beside and last - first <= 2 * window:
            continue
        while done > 0:
            current = np.array([first, last])
            if not _on_one_line(rows, polar, segments[done - 1], current, limits, ones, line, sums):
                break
            done -= 1
            first = segments[done, 0]
        segments[done, 0], segments[done, 1] = first, last
        done += 1
    return segments[:done], curved[:bent]


@kernel
def _mad_sigma(values: Any, scratch: Any) -> float:
    """`mad_sigma` of values about zero."""
    n = len(values)
    for k in range(n):
        scratch[k] = abs(values[k])
    upper = select(scratch, n, n // 2)
    if n % 2 == 0:
        lower = scratch[0]
        for k in range(1, n // 2):
            lower = max(lower, scratch[k])
        upper = 0.5 * (lower + upper)
    return MAD_TO_SIGMA * float(upper)


@kernel
def _left(rows: Any, first: int, line: Any, residuals: Any) -> None:
    """What a line leaves of the inverse ranges, into `residuals` (n,), from a beam on."""
    for k in range(len(residuals)):
        residuals[k] = rows[2, first + k] - (line[0] * rows[0, first + k] + line[1] * rows[1, first + k])


@kernel
def _robust(rows: Any, stretch: Any, residuals: Any, line: Any, limits: Any) -> float:
    """Fit a line (2,) to beams [first, last) with Tukey's weights; the scatter in units of the noise, 0 if there are
    too few beams left."""
    fewest, largest, _ = limits
    first, n = stretch[0], stretch[1] - stretch[0]
    sums, none, scratch, weights = np.empty(6), np.zeros(2, np.int64), np.empty(n), np.ones(rows.shape[1])
    _fit(rows, weights, stretch, none, line, sums)
    _left(rows, first, line, residuals)
    scale = 1.0
    for _ in range(5):
        scale = min(max(1.0, _mad_sigma(residuals, scratch)), largest)
        change, some = 0.0, 0
        for k in range(n):
            t = residuals[k] / (1.5 * scale) / 4.685
            weight = (1.0 - t * t) ** 2 if abs(t) < 1.0 else 0.0
            change = max(change, abs(weight - weights[first + k]))
            some += weight != 0.0
            weights[first + k] = weight
        if some < fewest:
            return 0.0
        _fit(rows, weights, stretch, none, line, sums)
        _left(rows, first, line, residuals)
        if change < 0.02:
            break
    return scale


@kernel
def finished(rows: Any, polar: Any, counts: Any, stretch: Any, noise: float, limits: Any) -> Any:
    """The beams of a stretch [first, last) that are kept, and their scatter; none where it is no line.

    `counts` (N,) is how many sweeps each range is the mean of. `limits` are `scan_lines.LEAST_BEAMS`, LARGEST_SCATTER
    and LARGEST_DIRECTION_SIGMA_RAD.
    """
    fewest, largest, largest_direction = limits
    first, n = stretch[0], stretch[1] - stretch[0]
    line, residuals, nothing = np.empty(2), np.empty(n), np.empty(0, np.int64)
    scale = _robust(rows, stretch, residuals, line, limits)
    if scale == 0.0:
        return nothing, 0.0
    start, stop = n, 0
    for k in range(n - 1):
        if abs(residuals[k]) < 3.5 * scale and abs(residuals[k + 1]) < 3.5 * scale:
            start, stop = min(start, k), k + 2
    if stop - start > 20:
        start, stop = start + 1, stop - 1
    index, some = np.empty(n, np.int64), 0
    for k in range(start, stop):
        if abs(residuals[k]) < 3.5 * scale:
            index[some] = first + k
            some += 1
    if some < fewest:
        return nothing, 0.0
    length = np.sqrt(line[0] * line[0] + line[1] * line[1])
    a, b = line[0] / length, line[1] / length
    incidence = squares = middle = reach = 0.0
    along = np.empty(some)
    for j in range(some):
        k = index[j]
        c, s, r = polar[0, k], polar[1, k], polar[2, k]
        lean = abs(c * a + s * b)
        across = (r * c * a + r * s * b - 1.0 / length) / max(lean, 0.05)
        incidence, squares = incidence + lean, squares + across * across * counts[k]
        along[j] = r * c * b - r * s * a
        middle += along[j]
    for j in range(some):
        reach += (along[j] - middle / some) ** 2
    scatter = np.sqrt((10.0 * noise * noise + squares) / (8.0 + some))
    if scatter > largest * noise or not scatter * (incidence / some) < largest_direction * np.sqrt(reach):
        return nothing, 0.0
    return index[:some], scatter
