"""Straight lines in a 2D scan: the beams that hit one flat thing each.

A line in polar coordinates is linear in the inverse range: ``1/r = a cos(angle) + b sin(angle)``, and a range's
standard deviation becomes that of 1/r by ``sigma / r^2``. So fits, comparisons of one line with two, and noise
estimates are sums over beams. Nothing has to be tuned: the noise is estimated from the scan, and what counts as
straight follows from it.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass
from functools import cached_property
from itertools import pairwise

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.circles import fit_circle2
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.lines import Line2
from lidarpose.geometry.robust import mad_sigma, median, quantile, tukey_weights
from lidarpose.model.observation import ScanLine
from lidarpose.model.scan import LidarSpec, Scan

# Beams in the sliding windows that tell straight stretches from breaks.
WINDOW = 7
LEAST_BEAMS = 6
# One line becomes two (or two lines one) where the sum of squares in units of sigma says so beyond chance: the best of
# many places to split, two more numbers, at odds of about one in a thousand.
SPLIT_GAIN = 25.0
# ... and only where the two differ by more than this many sigma: real panels and real ranges are wavy.
LEAST_DEVIATION = 0.4
# A line whose direction is known no better than this tells nothing.
LARGEST_DIRECTION_SIGMA_RAD = np.deg2rad(3.0)
# Real ranges are rougher than their noise: black squares seem nearer or farther than white ones, and averaging many
# sweeps leaves what they have in common. Where that shows (less than this share of the beams is explained, or lines are
# in fragments), lines are looked for at these many times the noise, and averages count as the mean of no more than this
# many sweeps.
EXPLAINED = 0.8
ROUGHNESS = (3.0, 6.0)
# The second, wider look is for instruments whose squares' steps are many times their noise, not for noisy ones.
LARGEST_STEP_M = 0.012
MOST_SWEEPS = 9
# What scatters by more than this many times the noise is no line at all.
LARGEST_SCATTER = 6.0
# Chords of a curve bend by less than this from one to the next.
LARGEST_BEND_RAD = math.radians(40.0)
# Ranges finer than this are rounding, not noise.
LEAST_SIGMA_M = 1e-7

KERNELS = "detect.scan_line_kernels"
# What they save of a scan of some hundred beams.
SAVED_S_PER_SCAN = 0.001


@dataclass(frozen=True, eq=False)
class Beams:
    """The beams with a return, in ascending angle, one a direction.

    Attributes
    ----------
    angle_rad, range_m : (N,)
    count : (N,)
        How many sweeps each range is the mean of.
    intensity : (N,) or None
    """

    angle_rad: FloatArray
    range_m: FloatArray
    count: IntArray
    intensity: FloatArray | None

    def __len__(self) -> int:
        return len(self.angle_rad)

    @cached_property
    def rays(self) -> FloatArray:
        """Directions (2, N) of the beams."""
        return np.stack([np.cos(self.angle_rad), np.sin(self.angle_rad)])

    @cached_property
    def points(self) -> FloatArray:
        """Points (N, 2)."""
        return np.asarray((self.range_m * self.rays).T)

    @cached_property
    def weight_m(self) -> FloatArray:
        """Range times the root of the sweeps that count (N,): over the noise, an inverse range in units of sigma."""
        return np.asarray(self.range_m * np.sqrt(np.minimum(self.count, MOST_SWEEPS)))

    @cached_property
    def _columns(self) -> dict[float, tuple[FloatArray, FloatArray]]:
        return {}

    def columns(self, noise: float) -> tuple[FloatArray, FloatArray]:
        """What lines are fitted with at a given noise: columns of cos and sin (2, N), and inverse ranges (N,), both
        in units of sigma."""
        if noise not in self._columns:
            weight = self.weight_m * self.range_m / noise
            self._columns[noise] = self.rays * weight, self.weight_m / noise
        return self._columns[noise]

    @cached_property
    def polar(self) -> FloatArray:
        """Directions, ranges, and the sweeps that count (4, N), as the kernels take them."""
        return np.vstack([self.rays, self.range_m, np.minimum(self.count, MOST_SWEEPS)])

    @cached_property
    def _tables(self) -> dict[float, FloatArray]:
        return {}

    def table(self, noise: float) -> FloatArray:
        """Columns and inverse ranges (3, N) in units of sigma, as the kernels take them."""
        if noise not in self._tables:
            rows, q = self.columns(noise)
            self._tables[noise] = np.vstack([rows, q])
        return self._tables[noise]


def find_lines(scan: Scan, spec: LidarSpec | None = None) -> tuple[ScanLine, ...]:
    """The straight lines of a scan, in ascending angle.

    Parameters
    ----------
    scan
        One or several sweeps; sweeps of the same beams are averaged robustly.
    spec
        What is known of the LiDAR. A stated range noise is kept unless a line scatters more.

    Returns
    -------
    Lines without the mixed pixels at their ends and without single stray ranges in between. The standard deviation of
    a line's ranges is that of their scatter about it (for averaged sweeps: of the averages).
    """
    beams = merge_sweeps(scan)
    if len(beams) < LEAST_BEAMS:
        return ()
    pays(SAVED_S_PER_SCAN, KERNELS)
    noise = range_noise(beams)
    stated = spec.range_sigma_m if spec is not None else None
    segments, curved = _segments(beams, noise)
    for roughness in ROUGHNESS:
        too_wide = roughness > ROUGHNESS[0] and roughness * noise > LARGEST_STEP_M
        if too_wide or not _fragmented(beams, noise, segments, curved):
            break
        coarse, _ = _segments(beams, roughness * noise)
        segments = _preferred(segments, coarse, curved)
    found = [_finished(beams, noise, stated, segment) for segment in _without_curves(beams, noise, segments)]
    return tuple(line for line in found if line is not None)


def _segments(beams: Beams, noise: float) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    """Straight stretches [first, last) of beams, and curved ones, at a given noise."""
    curved: list[tuple[int, int]] = []
    pieces = _straight_runs(beams, noise)
    if pieces and pays(0.0, KERNELS):
        return _segments_compiled(beams, noise, pieces)
    segments = [segment for piece in pieces for segment in _split(beams, noise, *piece, curved)]
    return _merged(beams, noise, _away_from_curves(segments, curved)), curved


def _segments_compiled(
    beams: Beams, noise: float, pieces: list[tuple[int, int]]
) -> tuple[list[tuple[int, int]], list[tuple[int, int]]]:
    from lidarpose.detect.scan_line_kernels import segments_of

    limits = WINDOW, LEAST_BEAMS, SPLIT_GAIN, LEAST_DEVIATION
    found = segments_of(beams.table(noise), beams.polar, np.array(pieces), noise, limits)
    straight, curved = ([(first, last) for first, last in each.tolist()] for each in found)
    return straight, curved


def _fragmented(beams: Beams, noise: float, segments: list[tuple[int, int]], curved: list[tuple[int, int]]) -> bool:
    """Whether much of the scan lies in no line, or four lines follow each other without a step between them."""
    if sum(last - first for first, last in (*segments, *curved)) < EXPLAINED * len(beams):
        return True
    touching = [_touch(beams, noise, a, b) for a, b in pairwise(segments)]
    return any(all(touching[k : k + 3]) for k in range(len(touching) - 2))


def _touch(beams: Beams, noise: float, a: tuple[int, int], b: tuple[int, int]) -> bool:
    """Whether one segment begins where the other ends, but for a few beams and a few sigma."""
    gap = b[0] - a[1]
    if gap > WINDOW:
        return False
    here, there = beams.points[a[0] : a[1]], beams.points[b[0] : b[1]]
    ends = here[[-WINDOW // 2, -1]].tolist(), there[[0, WINDOW // 2]].tolist()
    spacing = max(math.dist(*e) for e in ends) / (WINDOW // 2)
    return math.dist(ends[1][0], ends[0][1]) < (abs(gap) + 2) * spacing + 8.0 * noise


def _preferred(
    fine: list[tuple[int, int]], coarse: list[tuple[int, int]], curved: list[tuple[int, int]]
) -> list[tuple[int, int]]:
    """Coarse stretches in place of the fragments that fine ones are in where ranges are rough but the thing is flat.

    Two fine ones that fill most of a coarse one are a shallow fold, and stay.
    """
    kept: list[tuple[int, int]] = []
    replaced: set[tuple[int, int]] = set()
    for first, last in coarse:
        length = last - first
        inside = [s for s in fine if min(s[1], last) - max(s[0], first) > 0.5 * (s[1] - s[0])]
        covered = sum(sorted(s[1] - s[0] for s in inside)[-2:])
        bent = sum(max(0, min(c[1], last) - max(c[0], first)) for c in curved)
        if covered >= 0.85 * length or bent > 0.3 * length or length <= 2 * WINDOW:
            continue
        kept.append((first, last))
        replaced.update(inside)
    return sorted([*kept, *(s for s in fine if s not in replaced)])


def merge_sweeps(scan: Scan) -> Beams:
    """One range a direction: the mean of the ranges near the middle one of all sweeps.

    A direction whose sweeps disagree (an edge, hit now before and now behind) is dropped.
    """
    use = scan.has_return & np.isfinite(scan.angle_rad)
    order = np.flatnonzero(use)[np.argsort(scan.angle_rad[use], kind="stable")]
    angle, ranges = scan.angle_rad[order], scan.range_m[order]
    intensity = None if scan.intensity is None else scan.intensity[order]
    if len(angle) == 0:
        return Beams(angle, ranges, np.zeros(0, dtype=np.int64), intensity)
    # The same direction, to a thousandth of a degree (sensors repeat their angles, files round them).
    starts = np.flatnonzero(np.concatenate([[True], np.diff(angle) > 2e-5]))
    if len(starts) == len(angle):
        return _from_a_gap(Beams(angle, ranges, np.ones(len(angle), dtype=np.int64), intensity))
    count = np.diff(np.append(starts, len(angle)))
    group = np.repeat(np.arange(len(starts)), count)
    by_range = np.lexsort((ranges, group))
    # Of an even number the mean of both in the middle: the lower of two would leave half of all distances zero.
    ordered = ranges[by_range]
    middle = 0.5 * (ordered[starts + (count - 1) // 2] + ordered[starts + count // 2])
    off = np.abs(ranges - middle[group])
    spread = median(off[count[group] > 1]) * 1.6 if np.any(count > 1) else 0.0
    near = off <= max(5.0 * spread, 1e-9)
    kept = np.bincount(group, near)
    mean = np.bincount(group, np.where(near, ranges, 0.0)) / np.maximum(kept, 1.0)
    steady = kept >= 0.6 * count
    mean_angle = np.bincount(group, angle) / count
    merged = None
    if intensity is not None:
        merged = (np.bincount(group, np.where(near, intensity, 0.0)) / np.maximum(kept, 1.0))[steady]
    return _from_a_gap(Beams(mean_angle[steady], mean[steady], kept[steady].astype(np.int64), merged))


def _from_a_gap(beams: Beams) -> Beams:
    """A scan that goes all round begins anew at its largest step in range, so that no line lies across its seam."""
    angle = beams.angle_rad
    if len(angle) < LEAST_BEAMS:
        return beams
    gaps = np.diff(angle)
    seam = 2.0 * np.pi - (angle[-1] - angle[0])
    if seam > 4.0 * median(gaps):
        return beams
    steps = np.abs(np.diff(np.log(beams.range_m), append=np.log(beams.range_m[0])))
    if steps[-1] == steps.max():
        return beams
    first = int(np.argmax(steps)) + 1
    turned = np.concatenate([angle[first:], angle[:first] + 2.0 * np.pi])
    intensity = None if beams.intensity is None else np.roll(beams.intensity, -first)
    return Beams(turned, np.roll(beams.range_m, -first), np.roll(beams.count, -first), intensity)


def range_noise(beams: Beams) -> float:
    """Standard deviation of a single range, from how far each lies off the line through its neighbours.

    The lower part of the distribution counts, so that edges and clutter do not; ranges written in coarse steps give
    at least the deviation of their rounding.
    """
    if len(beams) < 3:
        return LEAST_SIGMA_M
    off, factor = _second_differences(beams)
    # 0.35 of the standard normal's absolute values are below 0.4538.
    noise = quantile(np.abs(off) / factor, 0.35) / 0.4538
    steps = np.diff(np.unique(np.round(beams.range_m, 7)))
    rounding = float(steps.min()) / np.sqrt(12.0) if len(steps) and len(steps) < 0.5 * len(beams) else 0.0
    return max(noise, rounding, LEAST_SIGMA_M)


def _second_differences(beams: Beams) -> tuple[FloatArray, FloatArray]:
    """How far each inner range lies off the line through its two neighbours, and that in units of one range's sigma."""
    t, r = beams.angle_rad, beams.range_m
    whole = np.sin(t[2:] - t[:-2])
    left, right = np.sin(t[2:] - t[1:-1]) / whole, np.sin(t[1:-1] - t[:-2]) / whole
    off = r[1:-1] ** 2 * (1.0 / r[1:-1] - left / r[:-2] - right / r[2:])
    weights = 1.0 / beams.count
    factor = np.sqrt(
        weights[1:-1]
        + (left * (r[1:-1] / r[:-2]) ** 2) ** 2 * weights[:-2]
        + (right * (r[1:-1] / r[2:]) ** 2) ** 2 * weights[2:]
    )
    return off, factor


def _straight_runs(beams: Beams, noise: float) -> list[tuple[int, int]]:
    """Runs [first, last) of beams in which every window of a few is straight within the noise."""
    n = len(beams)
    if n < WINDOW:
        return []
    good = (_straight_compiled if pays(0.0, KERNELS) else _straight)(beams, noise)
    # A long way without returns is a break, unless few beams return at all.
    step = np.diff(beams.angle_rad)
    far = step > max(40.0 * median(step), np.deg2rad(3.0))
    good &= ~sliding_window_view(far, WINDOW - 1).any(axis=1)
    edges = np.flatnonzero(np.diff(np.concatenate([[False], good, [False]]).astype(np.int8)))
    return [(int(a), int(b) + WINDOW - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]


def _straight(beams: Beams, noise: float) -> BoolArray:
    """Which windows (N - WINDOW + 1,) are straight within the noise."""
    n = len(beams)
    weight = beams.range_m**2 * np.sqrt(np.minimum(beams.count, MOST_SWEEPS)) / noise
    angle = sliding_window_view(beams.angle_rad, WINDOW)
    middle = angle[:, WINDOW // 2, None]
    w = sliding_window_view(weight, WINDOW)
    # Relative to the window's middle beam: the sums lose no digits.
    inverse = 1.0 / beams.range_m
    q = (sliding_window_view(inverse, WINDOW) - inverse[WINDOW // 2 : n - WINDOW // 2, None]) * w
    offset = angle - middle
    sine, cosine = np.sin(offset) * w, np.cos(offset) * w
    # The middle beam's own inverse range times (1 - cos) is what subtracting it left behind.
    q = q + (w - cosine) * inverse[WINDOW // 2 : n - WINDOW // 2, None]
    cc, cs, ss = (np.einsum("ij,ij->i", a, b) for a, b in ((cosine, cosine), (cosine, sine), (sine, sine)))
    qc, qs, qq = (np.einsum("ij,ij->i", q, b) for b in (cosine, sine, q))
    det = np.maximum(cc * ss - cs * cs, 1e-300)
    chi2 = qq - (ss * qc * qc - 2 * cs * qc * qs + cc * qs * qs) / det
    # Five degrees of freedom: one good window in ten thousand is above this.
    return np.asarray(chi2 < 4.0 * (WINDOW - 2) + 6.0)


def _straight_compiled(beams: Beams, noise: float) -> BoolArray:
    from lidarpose.detect.scan_line_kernels import straight

    return np.asarray(straight(beams.table(noise), beams.polar, WINDOW))


@dataclass(frozen=True, eq=False)
class _Fit:
    """A line through beams [first, last): coefficients of cos and sin of the angle, and chi-squared."""

    first: int
    last: int
    coefficients: FloatArray
    chi2: float
    residuals: FloatArray


def _columns(beams: Beams, noise: float, first: int, last: int) -> tuple[FloatArray, FloatArray]:
    rows, q = beams.columns(noise)
    return rows[:, first:last], q[first:last]


def _fit(beams: Beams, noise: float, first: int, last: int, weights: FloatArray | None = None) -> _Fit:
    """Least squares line of the inverse ranges; residuals in units of sigma, positive where the beam ends too early."""
    rows, q = _columns(beams, noise, first, last)
    w = rows if weights is None else rows * weights
    normal = w @ rows.T
    coefficients = _solved(normal, w @ q)
    # One step of refinement: the plain normal equations lose half of the digits.
    coefficients = coefficients + _solved(normal, w @ (q - coefficients @ rows))
    residuals = q - coefficients @ rows
    chi2 = float(residuals @ residuals if weights is None else residuals @ (weights * residuals))
    return _Fit(first, last, coefficients, chi2, residuals)


def _solved(A: FloatArray, b: FloatArray) -> FloatArray:
    """The solution (2,) of two linear equations (numpy's own costs ten times as much for so few)."""
    (p, q), (r, s) = A.tolist()
    x, y = b.tolist()
    det = p * s - q * r
    if det == 0.0:
        det = sys.float_info.min
    return np.array([(s * x - q * y) / det, (p * y - r * x) / det])


def _split(beams: Beams, noise: float, first: int, last: int, curved: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Cut a run wherever two lines explain it better than one; what a circle explains better still goes to `curved`."""
    if last - first < LEAST_BEAMS:
        return []
    fit = _fit(beams, noise, first, last)
    cut, gain, deviation = _best_cut(beams, noise, fit)
    if gain < SPLIT_GAIN or deviation < LEAST_DEVIATION:
        return [(first, last)]
    if _is_curved(beams, noise, first, last, fit.chi2 - gain):
        curved.append((first, last))
        return []
    return _split(beams, noise, first, cut, curved) + _split(beams, noise, cut, last, curved)


def _away_from_curves(segments: list[tuple[int, int]], curved: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Drop short segments beside curves: stretches of them whose bend the noise hides."""
    return [
        (first, last)
        for first, last in segments
        if last - first > 2 * WINDOW
        or not any(first <= end + 2 * WINDOW and last >= start - 2 * WINDOW for start, end in curved)
    ]


def _best_cut(beams: Beams, noise: float, fit: _Fit) -> tuple[int, float, float]:
    """Where two lines gain most over one: the cut, by how much chi-squared drops, the rms difference in sigma."""
    n = fit.last - fit.first
    if n < 6:
        return fit.first, 0.0, 0.0
    rows, _ = _columns(beams, noise, fit.first, fit.last)
    e = fit.residuals
    c, s = rows
    sums = np.empty((5, n))
    for k, (a, b) in enumerate(((c, c), (c, s), (s, s), (c, e), (s, e))):
        np.multiply(a, b, out=sums[k])
    np.cumsum(sums, axis=1, out=sums)
    left, right = sums[:, 2:-3], sums[:, -1:] - sums[:, 2:-3]
    gain = np.zeros(left.shape[1])
    for cc, cs, ss, ec, es in (left, right):
        det = np.maximum(cc * ss - cs * cs, 1e-12 * cc * ss)
        gain = gain + (ss * ec * ec - 2 * cs * ec * es + cc * es * es) / det
    best = int(np.argmax(gain))
    return fit.first + best + 3, float(gain[best]), float(np.sqrt(max(gain[best], 0.0) / n))


def _is_curved(beams: Beams, noise: float, first: int, last: int, chi2_two_lines: float) -> bool:
    """True where a circle explains the beams better than two lines do."""
    points = beams.points[first:last]
    try:
        circle = fit_circle2(points)
    except ValueError:
        return False
    outward = (points - circle.centre) / np.maximum(np.linalg.norm(points - circle.centre, axis=1), 1e-12)[:, None]
    rays = points / beams.range_m[first:last, None]
    # The distance along the beam is what the noise is stated for.
    along = circle.distance(points) / np.maximum(np.abs((outward * rays).sum(axis=1)), 0.2)
    chi2 = float(np.sum((along / noise) ** 2 * np.minimum(beams.count[first:last], MOST_SWEEPS)))
    return chi2 < chi2_two_lines


def _merged(beams: Beams, noise: float, segments: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Neighbours on one line become one, across stray ranges and short gaps between them."""
    done: list[tuple[int, int]] = []
    for segment in segments:
        current = segment
        while done and _on_one_line(beams, noise, done[-1], current):
            current = (done.pop()[0], current[1])
        done.append(current)
    return done


def _on_one_line(beams: Beams, noise: float, a: tuple[int, int], b: tuple[int, int]) -> bool:
    # Windows that see a stray range are lost on both of its sides.
    if b[0] - a[1] > 2 * WINDOW:
        shorter = min(_distance(beams, s[0], s[1] - 1) for s in (a, b))
        if _distance(beams, a[1] - 1, b[0]) > 0.25 * shorter:
            return False
    one, other = _fit(beams, noise, *a), _fit(beams, noise, *b)
    rows, q = _columns(beams, noise, a[0], b[1])
    if b[0] > a[1]:
        inside = np.r_[0 : a[1] - a[0], b[0] - a[0] : b[1] - a[0]]
        rows, q = rows[:, inside], q[inside]
    normal = rows @ rows.T
    coefficients = _solved(normal, rows @ q)
    coefficients = coefficients + _solved(normal, rows @ (q - coefficients @ rows))
    chi2 = float(np.sum((q - coefficients @ rows) ** 2))
    gain = chi2 - one.chi2 - other.chi2
    return gain < SPLIT_GAIN or gain / len(q) < LEAST_DEVIATION**2


def _distance(beams: Beams, i: int, j: int) -> float:
    """Distance of two beams' points."""
    return math.dist(beams.points[i].tolist(), beams.points[j].tolist())


def _without_curves(beams: Beams, noise: float, segments: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Drop chains of three and more segments that touch and bend to one side by little each: chords of a curve."""
    kept = [s for s in segments if s[1] - s[0] >= LEAST_BEAMS]
    if len(kept) < 3:
        return kept
    ends = [beams.points[[first, last - 1]].tolist() for first, last in kept]
    lengths = [math.dist(*e) for e in ends]
    bends = []
    for k in range(len(kept) - 1):
        touching = kept[k + 1][0] - kept[k][1] <= 2 * WINDOW
        length = min(lengths[k : k + 2])
        touching = touching and math.dist(ends[k + 1][0], ends[k][1]) < 0.3 * length + 5.0 * noise
        (a, b), (c, d) = ([q - p for p, q in zip(*e, strict=True)] for e in ends[k : k + 2])
        bend = math.atan2(a * d - b * c, a * c + b * d)
        bends.append(bend if touching and abs(bend) < LARGEST_BEND_RAD else 0.0)
    curved: BoolArray = np.zeros(len(kept), dtype=bool)
    for k in range(len(bends) - 1):
        # Chords of one curve are about equally long; a wall beside bits and pieces is not.
        alike = max(lengths[k : k + 3]) < 3.0 * min(lengths[k : k + 3])
        if bends[k] * bends[k + 1] > 0.0 and alike:
            curved[k : k + 3] = True
    return [s for s, drop in zip(kept, curved, strict=True) if not drop]


def _finished(beams: Beams, noise: float, stated: float | None, segment: tuple[int, int]) -> ScanLine | None:
    """Final robust fit: reach out to the ends, trim them, drop stray ranges, state the scatter."""
    if pays(0.0, KERNELS):
        return _finished_compiled(beams, noise, stated, segment)
    first, last = segment
    weights: FloatArray = np.ones(last - first)
    fit, scale = _fit(beams, noise, first, last), 1.0
    for _ in range(5):
        # Rough ranges scatter by more than the noise, but never without bound.
        scale = min(max(1.0, mad_sigma(fit.residuals, centred=True)), LARGEST_SCATTER)
        previous, weights = weights, tukey_weights(fit.residuals / (1.5 * scale))
        if np.count_nonzero(weights) < LEAST_BEAMS:
            return None
        fit = _fit(beams, noise, first, last, weights)
        if np.abs(weights - previous).max() < 0.02:
            break
    good = np.abs(fit.residuals) < 3.5 * scale
    first, good = _trimmed(first, good)
    if np.count_nonzero(good) < LEAST_BEAMS:
        return None
    index = first + np.flatnonzero(good)
    line = Line2(fit.coefficients, 1.0)
    t, r = beams.angle_rad[index], beams.range_m[index]
    incidence = np.abs(np.cos(t) * line.normal[0] + np.sin(t) * line.normal[1])
    across = line.distance(np.column_stack([r * np.cos(t), r * np.sin(t)]))
    residuals = across / np.maximum(incidence, 0.05) * np.sqrt(beams.count[index])
    # Ten beams' worth of what the whole scan says, against the line's own scatter.
    scatter = np.sqrt((10.0 * noise**2 + residuals @ residuals) / (8.0 + len(index)))
    if scatter > LARGEST_SCATTER * noise:
        return None
    along = np.column_stack([r * np.cos(t), r * np.sin(t)]) @ line.direction
    reach = float(np.sqrt(np.sum((along - along.mean()) ** 2)))
    if not scatter * float(incidence.mean()) < LARGEST_DIRECTION_SIGMA_RAD * reach:
        return None
    return _line(beams, index, float(scatter), stated)


def _finished_compiled(beams: Beams, noise: float, stated: float | None, segment: tuple[int, int]) -> ScanLine | None:
    from lidarpose.detect.scan_line_kernels import finished

    limits = LEAST_BEAMS, LARGEST_SCATTER, float(LARGEST_DIRECTION_SIGMA_RAD)
    index, scatter = finished(beams.table(noise), beams.polar, beams.count, segment, noise, limits)
    return _line(beams, index, scatter, stated) if len(index) else None


def _line(beams: Beams, index: IntArray, scatter: float, stated: float | None) -> ScanLine:
    """The line of some beams, which scatter by so much."""
    sigma = max(scatter, stated) if stated is not None else scatter
    intensity = None if beams.intensity is None else beams.intensity[index]
    return ScanLine(beams.angle_rad[index], beams.range_m[index], sigma / np.sqrt(beams.count[index]), intensity)


def _trimmed(first: int, good: BoolArray) -> tuple[int, BoolArray]:
    """Cut both ends back to where two good beams follow each other; long lines lose one beam more at each end.

    The outermost beam's spot may lie half beside the edge, and its range then is a little off, too little to show.
    """
    pairs = np.flatnonzero(good[:-1] & good[1:])
    if len(pairs) == 0:
        return first, good[:0]
    start, stop = int(pairs[0]), int(pairs[-1]) + 2
    if stop - start > 20:
        start, stop = start + 1, stop - 1
    return first + start, good[start:stop]
