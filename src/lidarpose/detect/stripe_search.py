"""Where on a panel the stripe runs, to a few pixels: ridge maxima in a reduced image, and the line they support."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from lidarpose.detect.albedo import PanelAlbedo
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.image import GrayImage

# Panels are reduced to about this many pixels across; a stripe keeps most of its height at a quarter of the size.
_SMALL_SIDE = 180
_HYPOTHESES = 150
# A second line with this share of the first one's support makes the choice between them a guess.
_AMBIGUOUS = 0.5


@dataclass(frozen=True, eq=False)
class PanelView:
    """A panel's part of the image, made ready for one stripe image after the other.

    Attributes
    ----------
    low, high : (2,)
        The part: pixels x, y from `low` up to, not including, `high`.
    bright : (height, width) float32
        The bright image there.
    factor
        How many pixels of the image one pixel of the reduced one has each way.
    small_bright, small_mask
        The bright image and the usable area, reduced.
    light, dark
        Reduced pixels inside light, and dark, squares: they tell the ambient light.
    """

    albedo: PanelAlbedo
    low: tuple[int, int]
    high: tuple[int, int]
    bright: FloatArray
    factor: int
    small_bright: FloatArray
    small_mask: BoolArray
    light: BoolArray
    dark: BoolArray

    @staticmethod
    def make(albedo: PanelAlbedo, bright: FloatArray) -> PanelView:
        """From the panel's albedo and the whole bright image."""
        outline = albedo.grid_map.outline()
        height, width = bright.shape
        low = np.clip(np.floor(outline.min(axis=0)).astype(int), 0, [width, height])
        high = np.clip(np.ceil(outline.max(axis=0)).astype(int) + 1, 0, [width, height])
        factor = int(np.clip(round(float((high - low).min()) / _SMALL_SIDE), 1, 4))
        high = low + (high - low) // factor * factor
        part = np.ascontiguousarray(bright[low[1] : high[1], low[0] : high[0]], dtype=np.float32)
        small = reduce_image(part, factor)
        y, x = np.indices(small.shape)
        centres = np.stack([x, y], axis=-1) * factor + (factor - 1) / 2.0 + low
        grid = _dense_grid(albedo, centres, factor)
        inside = albedo.is_usable(grid)
        away = np.abs(grid - np.round(grid)).min(axis=-1) > 0.2
        is_light = albedo.sign_at(grid[..., 0], grid[..., 1], np.array(0.01), np.array(0.01)) > 0
        return PanelView(
            albedo,
            (int(low[0]), int(low[1])),
            (int(high[0]), int(high[1])),
            part,
            factor,
            small,
            inside,
            inside & away & is_light,
            inside & away & ~is_light,
        )

    def crop(self, image: GrayImage) -> GrayImage:
        return image[self.low[1] : self.high[1], self.low[0] : self.high[0]]


def reduce_image(image: GrayImage | FloatArray, factor: int) -> FloatArray:
    """Mean of blocks of factor x factor pixels (float32)."""
    if factor == 1:
        return np.asarray(image, dtype=np.float32)
    size = (image.shape[1] // factor, image.shape[0] // factor)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _dense_grid(albedo: PanelAlbedo, pixels: FloatArray, factor: int) -> FloatArray:
    """Grid coordinates of a dense field of pixels, exact on every eighth and interpolated between."""
    step = max(8 // factor, 1)
    height, width = pixels.shape[:2]
    y, x = np.mgrid[0 : height + step : step, 0 : width + step : step]
    nodes = albedo.grid_map.grid(np.stack([x, y], axis=-1) * factor + pixels[0, 0])
    rows, columns = (np.asarray(index / step, dtype=np.float32) for index in np.indices((height, width)))
    channels = [cv2.remap(nodes[..., k].astype(np.float32), columns, rows, cv2.INTER_LINEAR) for k in (0, 1)]
    return np.stack([np.asarray(channel, dtype=np.float64) for channel in channels], axis=-1)


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
    """The one line of light on the panel, or why there is none, in words."""
    small = reduce_image(view.crop(image), view.factor)
    ridge, share = _without_ambient(view, small)
    noise = _noise(ridge, view.small_mask)
    threshold = max(6.0 * noise, 1.5)
    first = _best_line(ridge, threshold)
    if first is None:
        return "no stripe on the panel: nothing stands out in a line"
    line, support, length = first
    if length < 0.15 * min(ridge.shape):
        return "no stripe on the panel: the only bright line is too short"
    rest = ridge.copy()
    _erase(rest, line)
    second = _best_line(rest, max(threshold, 0.3 * line.level))
    if second is not None and second[1] > _AMBIGUOUS * support:
        return "two lines of light on the panel, and nothing tells which one is the laser's"
    return _to_image(line, view, share)


@dataclass(frozen=True, eq=False)
class _SmallLine:
    steep: bool
    start: float
    end: float
    slope: float
    intercept: float
    level: float


def _without_ambient(view: PanelView, small: FloatArray) -> tuple[FloatArray, float]:
    """What the bright image does not explain, made flat, zero off the panel; and the ambient share."""
    light, dark = np.median(small[view.light]), np.median(small[view.dark])
    bright_light, bright_dark = np.median(view.small_bright[view.light]), np.median(view.small_bright[view.dark])
    share = max(float(light - dark) / max(float(bright_light - bright_dark), 1.0), 0.0)
    rest = small - share * view.small_bright
    rest -= float(np.median(rest[view.light | view.dark]))
    rest = np.where(view.small_mask, rest, 0.0).astype(np.float32)
    # Glare and haze are wide, the stripe is narrow.
    return np.asarray(np.where(view.small_mask, rest - cv2.blur(rest, (15, 15)), 0.0)), share


def _noise(ridge: FloatArray, mask: BoolArray) -> float:
    values = ridge[mask]
    return float(1.4826 * np.median(np.abs(values[::3]))) if values.size else 0.0


def _best_line(ridge: FloatArray, threshold: float) -> tuple[_SmallLine, float, float] | None:
    """Line, its support, and its length in reduced pixels."""
    candidates = []
    for steep in (False, True):
        field = ridge.T if steep else ridge
        peak = np.argmax(field, axis=0)
        height = field[peak, np.arange(field.shape[1])]
        strong = height > threshold
        if strong.sum() >= 6:
            x = np.flatnonzero(strong).astype(np.float64)
            found = _consensus(x, peak[strong].astype(np.float64), height[strong], field.shape[0])
            if found is not None:
                slope, intercept, inliers, support = found
                level = float(np.median(height[strong][inliers]))
                line = _SmallLine(steep, x[inliers].min(), x[inliers].max(), slope, intercept, level)
                candidates.append((line, support, float(inliers.sum())))
    return max(candidates, key=lambda c: c[1]) if candidates else None


def _consensus(
    x: FloatArray, y: FloatArray, height: FloatArray, extent: int
) -> tuple[float, float, BoolArray, float] | None:
    """RANSAC for y = intercept + slope x, |slope| <= 1.5, among the maxima; None if chance explains the support."""
    rng = np.random.default_rng(0)
    weight = np.minimum(height, np.median(height))
    a, b = rng.integers(0, len(x), (2, _HYPOTHESES))
    apart = np.abs(x[a] - x[b]) >= 4
    if not apart.any():
        return None
    a, b = a[apart], b[apart]
    slope = (y[b] - y[a]) / (x[b] - x[a])
    intercept = y[a] - slope * x[a]
    near = np.abs(intercept[:, None] + slope[:, None] * x - y) <= 1.5
    support = (near * weight).sum(axis=1) * (np.abs(slope) <= 1.5)
    best = int(np.argmax(support))
    inliers = near[best]
    for _ in range(2):
        design = np.column_stack([np.ones(inliers.sum()), x[inliers], x[inliers] ** 2])
        if len(design) < 6:
            return None
        # A little bend: lenses.
        c = np.linalg.lstsq(design, y[inliers], rcond=None)[0]
        inliers = np.abs(c[0] + c[1] * x + c[2] * x**2 - y) <= 1.5
    by_chance = len(x) * 4.0 / extent
    if inliers.sum() < max(6.0, 3.0 * by_chance):
        return None
    fit = np.polyfit(x[inliers], y[inliers], 1)
    return float(fit[0]), float(fit[1]), inliers, float(weight[inliers].sum())


def _erase(ridge: FloatArray, line: _SmallLine) -> None:
    field = ridge.T if line.steep else ridge
    y, x = np.indices(field.shape)
    # Wide enough for the skirts of a saturated stripe.
    field[np.abs(line.intercept + line.slope * x - y) <= max(6.0, 0.08 * min(ridge.shape))] = 0.0


def _to_image(line: _SmallLine, view: PanelView, share: float) -> CoarseLine:
    f = view.factor
    along, across = (view.low[1], view.low[0]) if line.steep else (view.low[0], view.low[1])
    half = (f - 1) / 2.0
    intercept = line.intercept * f + half + across - line.slope * (half + along)
    start, end = line.start * f + along, line.end * f + f - 1 + along
    return CoarseLine(line.steep, start, end, line.slope, intercept, line.level, share)
