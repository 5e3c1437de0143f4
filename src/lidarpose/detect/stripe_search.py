"""Where on a panel the stripe runs, to a few pixels: ridge maxima in a reduced image, and the line they support."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import cv2
import numpy as np

from lidarpose.detect.albedo import MARGIN, PanelAlbedo
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.geometry.compiled import pays
from lidarpose.geometry.robust import median
from lidarpose.model.image import GrayImage

# Panels are reduced to about this many pixels across; a stripe keeps most of its height at a quarter of the size.
_SMALL_SIDE = 180
KERNELS = "detect.stripe_kernels"
# Random places, the same for all images, at which pairs of maxima are drawn.
_DRAWS = np.random.default_rng(0).random((2, 80))
# Votes of a column whose maximum is as high as is typical, or higher.
_VOTE = 256
# A second line with this share of the first one's support makes the choice between them a guess.
_AMBIGUOUS = 0.5
# A stripe, saturated or not, is narrower than twice this many reduced pixels.
_RIDGE_REACH = 4
# Reduced pixels; see `find_line`.
_SMOOTHING_PX = 1.5
_NO_LINE = "no stripe on the panel: nothing stands out in a line"
_ELSEWHERE = "the board is not where the bright images show it: it or the camera was moved"
_TOO_SHORT = "no stripe on the panel: the only bright line is too short"
# Lines of fewer reduced pixels than this share of the panel are too short.
_LEAST_LENGTH = 0.15
_TWO_LINES = "two lines of light on the panel, and nothing tells which one is the laser's"
# A lit stripe image shows the board elsewhere if it correlates with the bright image by less than this.
_LEAST_CORRELATION = 0.5
_LIT_SHARE = 0.3
# Lines in the bright image itself must stand out more than the model of the squares errs, as a share of their contrast.
_MISFIT = 0.12
# Lines sharper than the one, and wider than the other, are told apart (see `_sharpness`).
_NARROW, _WIDE = 0.65, 0.45
# Pixels between the places where grid coordinates are computed; between them they are interpolated (to 0.01 px).
NODE_STEP = 8
# Reduced pixels of each colour that tell the ambient light.
_LEVEL_SAMPLES = 400


@dataclass(frozen=True, eq=False)
class PanelView:
    """A panel's part of the image, made ready for one stripe image after the other.

    Attributes
    ----------
    low, high : (2,)
        The part: pixels x, y from `low` up to, not including, `high`.
    bright : (height, width) float32
        The bright image there, or its model where the bright image has a stripe itself.
    factor
        How many pixels of the image one pixel of the reduced one has each way.
    small_bright, small_mask
        The bright image and the usable area, reduced.
    light, dark : (M,)
        Flat indices of some reduced pixels inside light, and dark, squares: they tell the ambient light.
    nodes : (h, w, 2), slopes : (h, w, 4)
        Grid coordinates, and their derivatives (x by u, x by v, y by u, y by v), at every eighth pixel from `low`.
    """

    albedo: PanelAlbedo
    low: tuple[int, int]
    high: tuple[int, int]
    bright: FloatArray
    factor: int
    small_bright: FloatArray
    small_mask: BoolArray
    light: IntArray
    dark: IntArray
    nodes: FloatArray
    slopes: FloatArray

    @cached_property
    def inner(self) -> IntArray:
        """`light` and `dark`, one after the other."""
        return np.concatenate([self.light, self.dark])

    @cached_property
    def nodes_and_slopes(self) -> FloatArray:
        """Both, one row (h * w, 6) a node."""
        return np.concatenate([self.nodes, self.slopes], axis=-1).reshape(-1, 6)

    @staticmethod
    def make(albedo: PanelAlbedo, bright: GrayImage | FloatArray) -> PanelView:
        """From the panel's albedo and the whole bright image."""
        outline = albedo.grid_map.outline(1.0 + MARGIN)
        height, width = bright.shape
        low = np.clip(np.floor(outline.min(axis=0)).astype(int), 0, [width, height])
        high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 1, 0, [width, height])
        factor = int(np.clip(round(float((high - low).min()) / _SMALL_SIDE), 1, 4))
        high = low + (high - low) // factor * factor
        part = np.array(bright[low[1] : high[1], low[0] : high[0]], dtype=np.float32)
        small = reduce_image(part, factor)
        nodes, slopes = _nodes(albedo, low, high)
        grid = interpolate(nodes, *_pixel_centres(small.shape, factor))
        inside = _usable_pixels(albedo, grid)
        away = inside & (np.abs(grid - np.round(grid)).min(axis=-1) > 0.2)
        share = albedo.light_share(grid[..., 0], grid[..., 1], np.array(0.01), np.array(0.01))
        light, dark = (np.flatnonzero(away & side) for side in (share > 0.5, share <= 0.5))
        return PanelView(
            albedo,
            (int(low[0]), int(low[1])),
            (int(high[0]), int(high[1])),
            part,
            factor,
            small,
            inside,
            light[:: max(len(light) // _LEVEL_SAMPLES, 1)],
            dark[:: max(len(dark) // _LEVEL_SAMPLES, 1)],
            nodes,
            slopes,
        )

    def reduced(self, image: GrayImage) -> FloatArray:
        """The panel's part of an image, reduced (float32)."""
        if self.factor > 1 and image.dtype == np.uint8 and pays(0.0, KERNELS):
            from lidarpose.detect import stripe_search_kernels

            return np.asarray(stripe_search_kernels.block_means(image, self.low, self.high, self.factor))
        return reduce_image(image[self.low[1] : self.high[1], self.low[0] : self.high[0]], self.factor)

    @cached_property
    def template(self) -> Template:
        """The bright image, reduced, as what stripe images are compared with."""
        return Template.of(self, self.small_bright)

    @cached_property
    def smooth_template(self) -> Template:
        """The same for images that are smoothed."""
        return Template.of(self, _smoothed(self.small_bright))

    def grid_at(self, pixels: FloatArray) -> FloatArray:
        """Grid coordinates (..., 2) at pixels (..., 2)."""
        return self._at(self.nodes.reshape(-1, 2), pixels)

    def grid_and_slopes(self, pixels: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Grid coordinates (..., 2) at pixels (..., 2), and their derivatives (..., 4) as in `slopes`."""
        found = self._at(self.nodes_and_slopes, pixels)
        return found[..., :2], found[..., 2:]

    def _at(self, table: FloatArray, pixels: FloatArray) -> FloatArray:
        """Values (..., k) at pixels (..., 2) of a table with one row (k,) a node."""
        # By hand: remap rounds to 1/32 of a node's distance, which is a quarter of a pixel.
        column, row = ((pixels[..., k] - self.low[k]) / NODE_STEP for k in (0, 1))
        height, width = self.nodes.shape[:2]
        i = np.clip(column.astype(np.intp), 0, width - 2)
        j = np.clip(row.astype(np.intp), 0, height - 2)
        x, y = (column - i).astype(np.float32)[..., None], (row - j).astype(np.float32)[..., None]
        first = j * width + i
        upper = table.take(first, axis=0) * (1 - x) + table.take(first + 1, axis=0) * x
        lower = table.take(first + width, axis=0) * (1 - x) + table.take(first + width + 1, axis=0) * x
        return np.asarray(upper * (1 - y) + lower * y)

    def with_model(self) -> PanelView:
        """The same with the bright image as squares, levels and blur make it: without what else there is in it.

        Without the margin too: the outer squares' outer edges are extrapolated, and lines of misfit may run along them.
        """
        model = self._model(*_pixel_centres(self.bright.shape, 1), self.albedo.blur_px)
        return replace(self.without_margin(), bright=model, small_bright=reduce_image(model, self.factor))

    def without_margin(self) -> PanelView:
        """The same without the margin around the squares."""
        albedo = self.albedo.without_margin()
        grid = interpolate(self.nodes, *_pixel_centres(self.small_bright.shape, self.factor))
        return replace(self, albedo=albedo, small_mask=_usable_pixels(albedo, grid))

    def small_model(self) -> FloatArray:
        """The modelled bright image, reduced."""
        f = self.factor
        blur = float(np.hypot(self.albedo.blur_px, np.sqrt((f * f - 1) / 12.0)))
        return self._model(*_pixel_centres(self.small_bright.shape, f), blur)

    def _model(self, columns: FloatArray, rows: FloatArray, blur: float) -> FloatArray:
        grid = interpolate(self.nodes, columns, rows)
        slopes = interpolate(self.slopes, columns, rows)
        edges = [blur * np.hypot(slopes[..., k], slopes[..., k + 1]) for k in (0, 2)]
        share = self.albedo.light_share(grid[..., 0], grid[..., 1], edges[0], edges[1])
        light, dark = self.albedo.levels(grid)
        return np.asarray(dark + (light - dark) * share, dtype=np.float32)


@dataclass(frozen=True, eq=False)
class Template:
    """A reduced image that others are compared with: median level of its light and of its dark squares, what a tenth
    and eight tenths of the pixels inside squares are below, and these pixels less their mean, of length 1."""

    image: FloatArray
    light: float
    dark: float
    low: float
    high: float
    shape: FloatArray

    @staticmethod
    def of(view: PanelView, image: FloatArray) -> Template:
        flat = image.ravel()
        light, dark = (median(flat[index]) if len(index) else 0.0 for index in (view.light, view.dark))
        if len(view.inner) < 10:
            return Template(image, light, dark, 0.0, 0.0, np.zeros(0))
        shape = flat[view.inner].astype(np.float64)
        shape -= shape.mean()
        shape /= max(float(np.sqrt((shape * shape).sum())), 1e-12)
        return Template(image, light, dark, *_low_and_high(flat[view.inner]), shape)


def _usable_pixels(albedo: PanelAlbedo, grid: FloatArray) -> BoolArray:
    """Reduced pixels on usable ground, without the rim, where what lies around the board shines in."""
    usable = np.pad(albedo.is_usable(grid), 1).astype(np.uint8)
    return np.asarray(cv2.erode(usable, np.ones((5, 5), np.uint8))[1:-1, 1:-1] > 0)


def _nodes(albedo: PanelAlbedo, low: IntArray, high: IntArray) -> tuple[FloatArray, FloatArray]:
    y, x = np.mgrid[low[1] : high[1] + NODE_STEP : NODE_STEP, low[0] : high[0] + NODE_STEP : NODE_STEP]
    grid = albedo.grid_map.grid(np.stack([x, y], axis=-1))
    # By u and by v, from the neighbouring nodes: far closer than the nodes' own bilinear interpolation needs.
    edge_order: Literal[1, 2] = 2 if min(grid.shape[:2]) > 2 else 1
    by_u, by_v = (np.gradient(grid, float(NODE_STEP), axis=k, edge_order=edge_order) for k in (1, 0))
    slopes = np.stack([by_u[..., 0], by_v[..., 0], by_u[..., 1], by_v[..., 1]], axis=-1)
    return grid.astype(np.float32), slopes.astype(np.float32)


def _pixel_centres(shape: tuple[int, ...], factor: int) -> tuple[FloatArray, FloatArray]:
    """Columns and rows (float32), in full pixels from the corner, of the pixels of an image reduced by `factor`."""
    rows, columns = np.indices(shape, dtype=np.float32)
    return np.asarray(columns * factor + (factor - 1) / 2.0), np.asarray(rows * factor + (factor - 1) / 2.0)


def interpolate(nodes: FloatArray, u: FloatArray, v: FloatArray) -> FloatArray:
    """Values (..., channels) of a table of nodes at pixels u, v (...) from its corner; bilinear, to a quarter pixel."""
    step = np.float32(NODE_STEP)
    return np.asarray(cv2.remap(nodes, u / step, v / step, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE))


def reduce_image(image: GrayImage | FloatArray, factor: int) -> FloatArray:
    """Mean of blocks of factor x factor pixels (float32)."""
    if factor == 1:
        return np.asarray(image, dtype=np.float32)
    if image.dtype == np.uint8:
        # Sums of rows, then of columns: faster than OpenCV, and exact.
        rows = sum((image[k::factor] for k in range(1, factor)), image[::factor].astype(np.uint16))
        total = sum((rows[:, k::factor] for k in range(1, factor)), rows[:, ::factor])
        return np.asarray(total * np.float32(1.0 / factor**2))
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _smoothed(image: FloatArray) -> FloatArray:
    """Where noise is a fifth of what it was, and a stripe keeps most of its height."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), _SMOOTHING_PX))


@dataclass(frozen=True, eq=False)
class CoarseLine:
    """A stripe to a few pixels.

    Attributes
    ----------
    steep
        True where the stripe runs along y: x is then a function of y.
    start, end
        Range of the pixel coordinate along the stripe (x, or y if steep).
    slope, intercept
        Other coordinate = intercept + slope * coordinate, image pixels.
    level
        Height of the stripe above its surroundings, grey levels, in the reduced image.
    ambient_share
        The light of the bright image that is in this one too, as a share of it.
    """

    steep: bool
    start: float
    end: float
    slope: float
    intercept: float
    level: float
    ambient_share: float = 0.0


def find_line(view: PanelView, image: GrayImage) -> CoarseLine | str:
    """The one line of light on the panel, or why there is none, in words.

    What noise hides in dark parts of an image, which a camera's gamma spreads over many grey levels, may show once it
    is smoothed: the line, and the squares that tell whether the board is where it was.
    """
    small = view.reduced(image)
    found = _find_in_reduced(view, small, view.template)
    if found in (_NO_LINE, _TOO_SHORT, _ELSEWHERE):
        return _find_in_reduced(view, _smoothed(small), view.smooth_template)
    return found


def has_line(view: PanelView) -> bool:
    """Whether the bright image itself has a line of light on the panel: a stripe that must not pass for albedo."""
    squares = view.without_margin()
    contrast = median(view.albedo.light - view.albedo.dark)
    model = Template.of(squares, squares.small_model())
    found = _find_in_reduced(squares, squares.small_bright, model, _MISFIT * contrast)
    return not isinstance(found, str) or found == _TWO_LINES


def _find_in_reduced(view: PanelView, small: FloatArray, template: Template, least: float = 1.5) -> CoarseLine | str:
    if pays(0.0, KERNELS):
        return _find_compiled(view, small, template, least)
    share, offset = _ambient(view, small, template)
    if _is_elsewhere(view, small, template):
        return _ELSEWHERE
    rest, ridges = _rest_and_ridges(view, small, template.image, share, offset)
    threshold = max(6.0 * _noise(view, ridges), least)
    first = _best_line(ridges, threshold)
    if first is None:
        return _NO_LINE
    line, support, length = first
    if length < _LEAST_LENGTH * min(small.shape):
        return _TOO_SHORT
    for ridge, steep in zip(ridges, (False, True), strict=True):
        _erase(ridge, line, steep)
    second = _best_line(ridges, max(threshold, 0.3 * line.level))
    if second is not None and second[1] > _AMBIGUOUS * support:
        chosen = _sharper(rest, line, second[0])
        if chosen is None:
            return _TWO_LINES
        line = chosen
    return _to_image(line, view, share)


def _find_compiled(view: PanelView, small: FloatArray, template: Template, least: float) -> CoarseLine | str:
    """`_find_in_reduced` by kernels."""
    from lidarpose.detect import stripe_search_kernels as kernels

    rest, first, second = np.empty_like(small), np.zeros(8), np.zeros(8)
    squares = (view.light, view.dark, view.inner, template.shape)
    levels = (template.light, template.dark, template.low, template.high)
    parts = (template.image, view.small_mask, *squares, levels, (_LIT_SHARE, _LEAST_CORRELATION))
    share, noise, is_elsewhere = kernels.without_light(small, *parts, _RIDGE_REACH, rest)
    if is_elsewhere:
        return _ELSEWHERE
    threshold = max(6.0 * noise, least)
    if not kernels.best_line(rest, _RIDGE_REACH, threshold, second, 0, _DRAWS, _VOTE, first):
        return _NO_LINE
    line, support, length = _as_line(first)
    if length < _LEAST_LENGTH * min(small.shape):
        return _TOO_SHORT
    threshold, apart = max(threshold, 0.3 * line.level), _reach_of(line, small)
    if kernels.best_line(rest, _RIDGE_REACH, threshold, first, apart, _DRAWS, _VOTE, second):
        other, others_support, _ = _as_line(second)
        if others_support > _AMBIGUOUS * support:
            chosen = _sharper(rest, line, other)
            if chosen is None:
                return _TWO_LINES
            line = chosen
    return _to_image(line, view, share)


def _as_line(found: FloatArray) -> tuple[_SmallLine, float, float]:
    """Line, its support and its length from what the kernel found."""
    slope, intercept, start, end, level, support, length, steep = found.tolist()
    return _SmallLine(steep > 0.0, start, end, slope, intercept, level), support, length


def _sharper(rest: FloatArray, a: _SmallLine, b: _SmallLine) -> _SmallLine | None:
    """The one of two lines that is a narrow one beside a wide one (a long glare), if it is so."""
    sharpness = [_sharpness(rest.T if line.steep else rest, line) for line in (a, b)]
    if min(sharpness) > _WIDE or max(sharpness) < _NARROW:
        return None
    return a if sharpness[0] > sharpness[1] else b


def _sharpness(field: FloatArray, line: _SmallLine) -> float:
    """Share of the ridge's height that is lost within half of its reach: 1 for a narrow line, 1/4 for a wide one."""
    x = np.arange(int(line.start), int(line.end) + 1)
    middle = np.rint(line.intercept + line.slope * x).astype(int)
    k = _RIDGE_REACH
    kept = (middle >= k + 1) & (middle < field.shape[0] - k - 1)
    x, middle = x[kept], middle[kept]
    if len(x) == 0:
        return 0.0
    near = np.stack([field[middle + d, x] for d in (-1, 0, 1)])
    middle = middle + np.argmax(near, axis=0) - 1
    top = near.max(axis=0)
    half, full = (top - np.maximum(field[middle - d, x], field[middle + d, x]) for d in (k // 2, k))
    return median(half) / max(median(full), 1e-6)


def _is_elsewhere(view: PanelView, small: FloatArray, template: Template) -> bool:
    """Whether the image is lit, but shows other squares than these."""
    if len(view.inner) < 10:
        return False
    seen = small.ravel()[view.inner]
    low, high = _low_and_high(seen)
    if high - low < _LIT_SHARE * (template.high - template.low):
        return False
    # Clipped: a glare or the stripe itself must not decide.
    clipped = np.clip(seen, low, high).astype(np.float64)
    clipped -= clipped.mean()
    correlation = (clipped * template.shape).sum() / max(float(np.sqrt((clipped * clipped).sum())), 1e-12)
    return bool(correlation < _LEAST_CORRELATION)


def _low_and_high(values: FloatArray) -> tuple[float, float]:
    """What a tenth, and eight tenths, of the values are below."""
    tenth, eighth = len(values) // 10, 8 * len(values) // 10
    low, high = np.partition(values, (tenth, eighth))[[tenth, eighth]]
    return float(low), float(high)


def _ridge(field: FloatArray) -> FloatArray:
    """How far each pixel stands out above those `_RIDGE_REACH` above and below it; glare and haze are too wide to."""
    k = _RIDGE_REACH
    ridge = np.zeros_like(field)
    middle = field[k:-k]
    np.minimum(middle - field[: -2 * k], middle - field[2 * k :], out=ridge[k:-k])
    return ridge


@dataclass(frozen=True, eq=False)
class _SmallLine:
    steep: bool
    start: float
    end: float
    slope: float
    intercept: float
    level: float


def _ambient(view: PanelView, small: FloatArray, template: Template) -> tuple[float, float]:
    """The light of the bright image (`template`) that is in this one too: a share of it, and a level beside."""
    if len(view.light) == 0 or len(view.dark) == 0:
        return 0.0, 0.0
    light, dark = (median(small.ravel()[index]) for index in (view.light, view.dark))
    share = max((light - dark) / max(template.light - template.dark, 1.0), 0.0)
    return share, dark - share * template.dark


def _rest_and_ridges(
    view: PanelView, small: FloatArray, template: FloatArray, share: float, offset: float
) -> tuple[FloatArray, tuple[FloatArray, FloatArray]]:
    """What the bright image (`template`) does not explain, zero off the panel; its ridges along x and along y."""
    if len(view.light) == 0 or len(view.dark) == 0:
        rest = np.zeros_like(small)
    else:
        rest = np.asarray(small - np.float32(share) * template)
        rest -= np.float32(offset)
        rest *= view.small_mask
    return rest, (_ridge(rest), _ridge(rest.T))


def _noise(view: PanelView, ridges: tuple[FloatArray, FloatArray]) -> float:
    """Standard deviation of what stands out by chance, from pixels inside the squares."""
    if len(view.inner) == 0:
        return 0.0
    # The smaller of two differences is below zero on average; its spread is what counts.
    values = ridges[0].ravel()[view.inner]
    return 1.4826 * median(np.abs(values - median(values)))


def _best_line(ridges: tuple[FloatArray, FloatArray], threshold: float) -> tuple[_SmallLine, float, float] | None:
    """Line, its support, and its length in reduced pixels."""
    candidates = []
    for ridge, steep in zip(ridges, (False, True), strict=True):
        found = _line_in(ridge, threshold)
        if found is not None:
            slope, intercept, start, end, level, support, length = found
            candidates.append((_SmallLine(steep, start, end, slope, intercept, level), support, length))
    return max(candidates, key=lambda c: c[1]) if candidates else None


_Line = tuple[float, float, float, float, float, float, float]
"""Slope, intercept, start, end, level, support, and how many columns or rows support it."""


def _line_in(ridge: FloatArray, threshold: float) -> _Line | None:
    """The line through the columns' maxima above a threshold."""
    peak = np.argmax(ridge, axis=0)
    height = ridge[peak, np.arange(ridge.shape[1])]
    x = np.flatnonzero(height > threshold)
    return _consensus(x, peak[x], height[x], len(ridge)) if len(x) >= 6 else None


def _consensus(x: IntArray, y: IntArray, height: FloatArray, extent: int) -> _Line | None:
    """RANSAC for y = intercept + slope x, |slope| <= 1.5, among the maxima; None if chance explains the support.

    A column has at most `_VOTE` votes, by its height. Votes and coordinates are whole numbers: sums of them are the
    same in any order.
    """
    typical = median(height)
    votes = np.rint(np.minimum(height / np.float32(typical), np.float32(1.0)) * np.float32(_VOTE))
    # Pairs of one from each half: far enough apart to give a direction.
    half = len(x) // 2
    a = (_DRAWS[0] * half).astype(np.intp)
    b = half + (_DRAWS[1] * (len(x) - half)).astype(np.intp)
    slope = (y[b] - y[a]) / (x[b] - x[a])
    intercept = y[a] - slope * x[a]
    near = np.abs(intercept[:, None] + slope[:, None] * x - y) <= 1.5
    best = int(np.argmax((near @ votes) * (np.abs(slope) <= 1.5)))
    inliers = near[best]
    t = x - x[0]
    powers = np.stack([np.ones_like(t), t, t * t, t * t * t, t * t * t * t, y, y * t, y * t * t])
    for _ in range(2):
        sums = powers[:, inliers].sum(axis=1).tolist()
        if sums[0] < 6:
            return None
        # A little bend: lenses.
        c0, c1, c2 = parabola(*sums)
        inliers = np.abs(c0 + c1 * t + c2 * powers[2] - y) <= 1.5
    u, v, count = x[inliers], y[inliers], int(np.count_nonzero(inliers))
    by_chance = len(x) * 4.0 / extent
    if count < max(6.0, 3.0 * by_chance):
        return None
    su, sv, suu, suv = (int(part) for part in (u.sum(), v.sum(), u @ u, u @ v))
    direction = (count * suv - su * sv) / (count * suu - su * su)
    support = float(votes[inliers].sum()) * typical / _VOTE
    intercept_fit = sv / count - direction * (su / count)
    return direction, intercept_fit, float(u[0]), float(u[-1]), median(height[inliers]), support, float(count)


def parabola(n: int, t1: int, t2: int, t3: int, t4: int, y0: int, y1: int, y2: int) -> tuple[float, float, float]:
    """Least squares of y = c0 + c1 t + c2 t^2 from sums over whole numbers: of t^0 to t^4, and of y, y t, y t^2."""
    a, b, c, d, e, p, q, r = float(n), float(t1), float(t2), float(t3), float(t4), float(y0), float(y1), float(y2)
    # Cramer's rule: [a b c; b c d; c d e] times the coefficients is [p q r].
    k0, k1, k2 = c * e - d * d, b * e - c * d, b * d - c * c
    det = a * k0 - b * k1 + c * k2
    c0 = (p * k0 - q * k1 + r * k2) / det
    c1 = (-p * k1 + q * (a * e - c * c) - r * (a * d - b * c)) / det
    c2 = (p * k2 - q * (a * d - b * c) + r * (a * c - b * b)) / det
    return c0, c1, c2


def _reach_of(line: _SmallLine, field: FloatArray) -> int:
    """How far from a line nothing else is sought: wide enough for the skirts of a saturated stripe."""
    return int(max(6.0, 0.08 * min(field.shape)) * np.sqrt(1.0 + line.slope**2))


def _erase(ridge: FloatArray, line: _SmallLine, steep: bool) -> None:
    """Blank the line in a ridge image (transposed if `steep`)."""
    reach = _reach_of(line, ridge)
    field = ridge if steep == line.steep else ridge.T
    x = np.arange(field.shape[1])
    middle = np.rint(line.intercept + line.slope * x).astype(np.intp)
    y = np.clip(middle + np.arange(-reach, reach + 1)[:, None], 0, field.shape[0] - 1)
    field[y, x] = 0.0


def _to_image(line: _SmallLine, view: PanelView, share: float) -> CoarseLine:
    f = view.factor
    along, across = (view.low[1], view.low[0]) if line.steep else (view.low[0], view.low[1])
    half = (f - 1) / 2.0
    intercept = line.intercept * f + half + across - line.slope * (half + along)
    start, end = line.start * f + along, line.end * f + f - 1 + along
    return CoarseLine(line.steep, start, end, line.slope, intercept, line.level, share)
