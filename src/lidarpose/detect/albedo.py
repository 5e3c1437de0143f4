"""How light or dark a chessboard is at every point of the image, sharp edges and the lens's blur kept apart.

The bright image alone says how much light every pixel sends back, but already blurred: a laser's stripe is multiplied
by the board's albedo before the lens blurs it, not after. So the board is modelled: squares whose edges are where the
corners say, light and dark levels as the bright image shows them (they vary over the board), and the blur of the lens,
measured on the squares' edges.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np

from lidarpose.detect.grid_map import GridMap
from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.model.image import GrayImage

# How much of a light margin around the squares is used, in squares: boards may end soon after.
MARGIN = 0.9
# Inside a square, away from its blurred edges, as fractions of it.
_INNER = np.linspace(0.25, 0.75, 5)
_SQRT2 = math.sqrt(2.0)
# The error function in steps of 0.002: a table is ten times as fast as the function, and as good as 12 bits.
_ERF_REACH, _ERF_STEPS = 3.2, 3200


@dataclass(frozen=True, eq=False)
class PanelAlbedo:
    """A panel's squares as the bright image shows them.

    Squares are counted from the outer ring: square (i, j) reaches from grid coordinate i - 1 to i, and j - 1 to j.
    Around them may lie a light margin: `MARGIN` squares wide it is used where the bright image shows it.

    Attributes
    ----------
    grid_map
        From grid coordinates (squares) to pixels.
    light, dark : (rows + 1, columns + 1)
        Grey level that a light, and a dark, surface has at each square's place.
    usable : (rows + 3, columns + 3)
        False for squares that are not as a chessboard's are (cut short, covered, glaring); with a ring around them
        for the margin, true where it is as light as the light squares.
    first_is_dark
        Whether the square before the first corner, at (0, 0), is dark.
    blur_px
        Standard deviation of the lens's blur, pixels, the pixel's own width included.
    """

    grid_map: GridMap
    light: FloatArray
    dark: FloatArray
    usable: BoolArray
    first_is_dark: bool
    blur_px: float

    def levels(self, grid: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Light and dark level (...) at grid coordinates (..., 2), interpolated between the squares' centres."""
        light, dark = (sample(table, grid + 0.5) for table in (self.light, self.dark))
        return light, dark

    def near_ends(
        self,
        x_range: tuple[FloatArray, FloatArray],
        y_range: tuple[FloatArray, FloatArray],
        edges: tuple[FloatArray, ...],
    ) -> BoolArray:
        """Whether any grid coordinates between bounds are near the squares' lower and upper end: (2, 2), x and y."""
        near = np.zeros((2, 2), dtype=bool)
        sizes = (self.grid_map.columns, self.grid_map.rows)
        for k, ((low, high), edge, size) in enumerate(zip((x_range, y_range), edges, sizes, strict=True)):
            reach = 4.0 * float(np.max(edge))
            near[k] = float(np.min(low)) < -1.0 + reach, float(np.max(high)) > size - reach
        return near

    def light_share(
        self, x: FloatArray, y: FloatArray, edge_x: FloatArray, edge_y: FloatArray, *, near: BoolArray | None = None
    ) -> FloatArray:
        """Share from 0 (all dark) to 1 (all light) of what is seen at grid coordinates `x`, `y` (arrays of one shape).

        Edges are blurred by Gaussians of width `edge_x`, `edge_y` squares. The blur is taken to be small against the
        squares, so that only the nearest edge each way matters. `near` is what `near_ends` says, if it is known.
        """
        if near is None:
            near = self.near_ends((x, x), (y, y), (edge_x, edge_y))
        columns, rows = self.grid_map.columns, self.grid_map.rows
        inner_x, inner_y = np.clip(x, -0.5, columns - 0.5), np.clip(y, -0.5, rows - 0.5)
        wave = soft_square_wave(inner_x, edge_x) * soft_square_wave(inner_y, edge_y)
        share = 0.5 - 0.5 * wave if self.first_is_dark else 0.5 + 0.5 * wave
        for value, edge, size, (at_low, at_high) in ((x, edge_x, columns, near[0]), (y, edge_y, rows, near[1])):
            if at_low:
                share = 1.0 - (1.0 - share) * _soft_step(value + 1.0, edge)
            if at_high:
                share = 1.0 - (1.0 - share) * _soft_step(size - value, edge)
        return np.asarray(share)

    def is_usable(self, grid: FloatArray) -> BoolArray:
        """True (...) for grid coordinates (..., 2) in squares that are as a chessboard's are, and in a light margin."""
        size = np.array([self.grid_map.columns, self.grid_map.rows])
        inside = ((grid > -1.0 - MARGIN) & (grid < size + MARGIN)).all(-1)
        index = np.clip(np.floor(grid + 2.0).astype(int), 0, size + 2)
        return np.asarray(inside & self.usable[index[..., 1], index[..., 0]])

    def without_margin(self) -> PanelAlbedo:
        """The same without the margin."""
        return replace(self, usable=np.pad(self.usable[1:-1, 1:-1], 1))

    def apart_from(self, other: FloatArray) -> PanelAlbedo:
        """The same without the margin where it may be another panel's: within a polygon (M, 2) of pixels."""
        usable = self.usable.copy()
        rows, columns = usable.shape
        polygon = other.astype(np.float32)
        ring = usable.copy()
        ring[1:-1, 1:-1] = False
        cells = np.argwhere(ring)[:, ::-1]
        pixels = self.grid_map.pixels(_ring_centre(cells, np.array([columns, rows])))
        for (i, j), (u, v) in zip(cells.tolist(), pixels.tolist(), strict=True):
            if cv2.pointPolygonTest(polygon, (u, v), False) >= 0:
                usable[j, i] = False
        return replace(self, usable=usable)


def _ring_centre(index: IntArray, shape: IntArray) -> FloatArray:
    """Grid coordinates (..., 2) of the middle of cells (..., 2) of `usable`; those of the ring are narrow."""
    centre = index - 1.5
    centre = np.where(index == 0, -1.0 - 0.5 * MARGIN, centre)
    return np.asarray(np.where(index == shape - 1, shape - 3.0 + 0.5 * MARGIN, centre))


@lru_cache(maxsize=1)
def erf_table() -> FloatArray:
    values = [math.erf(x) for x in np.linspace(-_ERF_REACH, _ERF_REACH, 2 * _ERF_STEPS + 1).tolist()]
    return np.asarray(values, dtype=np.float32)


def edge_scale(sigma: FloatArray) -> FloatArray:
    """Steps of `erf_table` a square, at an edge blurred by `sigma` squares."""
    return np.asarray(_ERF_STEPS / (_ERF_REACH * _SQRT2) / np.maximum(sigma, 1e-6))


def soft_square_wave(x: FloatArray, sigma: FloatArray) -> FloatArray:
    """Square wave of period 2 with edges at whole numbers, 1 for x in (0, 1), blurred by a Gaussian (`sigma`)."""
    half = 0.5 * x + 0.25
    # Distance to the nearest edge, positive on the side where the wave is 1.
    distance = 0.5 - np.abs(2.0 * (half - np.floor(half)) - 1.0)
    index = np.clip(distance * edge_scale(sigma) + (_ERF_STEPS + 0.5), 0, 2 * _ERF_STEPS).astype(np.intp)
    return np.asarray(erf_table()[index])


def _soft_step(x: FloatArray, sigma: FloatArray) -> FloatArray:
    """Step from 0 (x < 0) to 1, blurred by a Gaussian (`sigma`)."""
    index = np.clip(x * edge_scale(sigma) + (_ERF_STEPS + 0.5), 0, 2 * _ERF_STEPS).astype(np.intp)
    return np.asarray(0.5 + 0.5 * erf_table()[index])


def measure_albedo(grid_map: GridMap, image: GrayImage | FloatArray) -> PanelAlbedo:
    """Levels, colour and blur of a panel's squares in a bright image (the mean or median of the shots)."""
    centres, medians = _square_medians(grid_map, image)
    rows, columns = medians.shape
    parity = (np.add.outer(np.arange(rows), np.arange(columns)) % 2).astype(bool)
    first_is_dark = bool(np.median(medians[~parity]) < np.median(medians[parity]))
    is_dark = ~parity if first_is_dark else parity
    light, dark = _fill(medians, ~is_dark), _fill(medians, is_dark)
    squares = _as_expected(medians, is_dark, light, dark) & _in_image(centres, image.shape)
    albedo = PanelAlbedo(grid_map, light, dark, _with_margin(grid_map, image, squares, light), first_is_dark, 1.0)
    return replace(albedo, blur_px=_measure_blur(albedo, image))


def _with_margin(grid_map: GridMap, image: GrayImage | FloatArray, squares: BoolArray, light: FloatArray) -> BoolArray:
    """`squares` with a ring around them: where the margin is even and as light as the light squares beside it."""
    rows, columns = squares.shape
    usable = np.pad(squares, 1)
    ring = np.argwhere(np.pad(np.zeros_like(squares), 1, constant_values=True))[:, ::-1]
    shape = np.array([columns + 2, rows + 2])
    centres = _ring_centre(ring, shape)
    half = np.where((ring == 0) | (ring == shape - 1), 0.35 * MARGIN, 0.35)
    spots = np.stack(np.meshgrid([-1.0, -0.5, 0.0, 0.5, 1.0], [-1.0, -0.5, 0.0, 0.5, 1.0]), axis=-1).reshape(-1, 2)
    pixels = grid_map.pixels(centres[:, None] + spots * half[:, None])
    values = np.sort(sample(image, pixels), axis=1)
    beside = np.clip(ring - 1, 0, [columns - 1, rows - 1])
    level = light[beside[:, 1], beside[:, 0]]
    even = (values[:, -3] - values[:, 2] < 0.15 * level) & (np.abs(values[:, 12] - level) < 0.2 * level)
    usable[ring[:, 1], ring[:, 0]] = even & _in_image(pixels, image.shape).all(axis=1)
    return usable


def _square_medians(grid_map: GridMap, image: GrayImage | FloatArray) -> tuple[FloatArray, FloatArray]:
    columns, rows = grid_map.columns + 1, grid_map.rows + 1
    x = (np.arange(columns)[:, None] - 1.0 + _INNER).ravel()
    y = (np.arange(rows)[:, None] - 1.0 + _INNER).ravel()
    pixels = grid_map.pixels(np.stack(np.meshgrid(x, y), axis=-1))
    values = sample(image, pixels).reshape(rows, len(_INNER), columns, len(_INNER))
    centres = pixels[len(_INNER) // 2 :: len(_INNER), len(_INNER) // 2 :: len(_INNER)]
    return centres, np.median(values.transpose(0, 2, 1, 3).reshape(rows, columns, -1), axis=-1)


def sample(image: GrayImage | FloatArray, pixels: FloatArray) -> FloatArray:
    """Values (...) of an image at pixels (..., 2), bilinear; beyond the border that of the border."""
    if pixels.size == 0:
        return np.zeros(pixels.shape[:-1])
    # In rows of 1024: remap takes no more than 32767 columns.
    count = pixels.size // 2
    wide = min(count, 1024)
    x, y = (np.resize(np.asarray(pixels[..., k], dtype=np.float32).ravel(), (-(-count // wide), wide)) for k in (0, 1))
    # Remap of integers rounds its results: the part that matters is made float.
    low_x, low_y = (max(int(np.floor(c.min())) - 1, 0) for c in (x, y))
    high_x, high_y = (max(int(np.ceil(c.max())) + 2, low + 1) for c, low in ((x, low_x), (y, low_y)))
    part = np.asarray(image[low_y:high_y, low_x:high_x], dtype=np.float32)
    if part.size == 0:
        return np.zeros(pixels.shape[:-1])
    values = cv2.remap(part, x - low_x, y - low_y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(values, dtype=np.float64).ravel()[:count].reshape(pixels.shape[:-1])


def _fill(medians: FloatArray, known: BoolArray) -> FloatArray:
    """Levels of one colour everywhere: known squares smoothed, the others from their neighbours.

    Medians of the known squares among the 5 x 5 around: a glare or a stripe on one square does not spread.
    """
    rows, columns = medians.shape
    padded = np.pad(np.where(known, medians, np.nan), 2, constant_values=np.nan)
    windows = np.lib.stride_tricks.sliding_window_view(padded, (5, 5)).reshape(rows, columns, 25)
    smooth = np.nanmedian(windows, axis=-1)
    # A square's own level counts where it is not far from its neighbours'.
    spread = 0.15 * np.abs(smooth) + 1.0
    own = known & (np.abs(medians - smooth) <= spread)
    nearest = np.pad(np.where(own, medians, np.nan), 1, constant_values=np.nan)
    around = np.stack([nearest[:-2, 1:-1], nearest[2:, 1:-1], nearest[1:-1, :-2], nearest[1:-1, 2:]])
    counts = np.isfinite(around).sum(axis=0)
    mean = np.where(counts > 0, np.nansum(around, axis=0) / np.maximum(counts, 1), smooth)
    return np.asarray(np.where(own, medians, mean))


def _as_expected(medians: FloatArray, is_dark: BoolArray, light: FloatArray, dark: FloatArray) -> BoolArray:
    """Squares nearer to their own colour's level than to the other's."""
    expected, other = np.where(is_dark, dark, light), np.where(is_dark, light, dark)
    return np.asarray((np.abs(medians - expected) < 0.4 * np.abs(expected - other)) & (light > dark))


def _in_image(centres: FloatArray, shape: tuple[int, ...]) -> BoolArray:
    return np.asarray((centres >= 0).all(-1) & (centres[..., 0] < shape[1]) & (centres[..., 1] < shape[0]))


def _measure_blur(albedo: PanelAlbedo, image: GrayImage | FloatArray) -> float:
    """Width of the squares' edges: the Gaussian blur of the model that fits the pixels around them best."""
    grid, gradient, values = _edge_pixels(albedo, image)
    if len(values) < 100:
        return 0.8

    per_pixel = [np.linalg.norm(gradient[:, k], axis=-1) for k in (0, 1)]

    def misfit(log_blur: float) -> float:
        edges = [np.exp(log_blur) * scale for scale in per_pixel]
        share = albedo.light_share(grid[:, 0], grid[:, 1], edges[0], edges[1])
        return float(np.minimum(np.abs(share - values), 0.5).mean())

    return float(np.exp(_lowest(misfit, float(np.log(0.2)), float(np.log(6.0)), 2e-3)))


def _lowest(function: Callable[[float], float], low: float, high: float, tolerance: float) -> float:
    """Where a function with one minimum is lowest, by golden sections.

    Importing scipy for this would take longer than the whole search.
    """
    golden = 0.5 * (math.sqrt(5.0) - 1.0)
    a, b = high - golden * (high - low), low + golden * (high - low)
    at_a, at_b = function(a), function(b)
    while high - low > 2.0 * tolerance:
        if at_a < at_b:
            high, b, at_b = b, a, at_a
            a = high - golden * (high - low)
            at_a = function(a)
        else:
            low, a, at_a = a, b, at_b
            b = low + golden * (high - low)
            at_b = function(b)
    return a if at_a < at_b else b


def _edge_pixels(albedo: PanelAlbedo, image: GrayImage | FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Pixels around the middles of edges between usable squares: grid coordinates (M, 2), their gradient (M, 2, 2) by
    the pixel, and the value (M,) from 0 (dark) to 1 (light)."""
    grid_map = albedo.grid_map
    usable = albedo.usable[1:-1, 1:-1]
    j, i = np.nonzero(usable[:, :-1] & usable[:, 1:])
    upright = np.column_stack([i, j - 0.5])
    j, i = np.nonzero(usable[:-1] & usable[1:])
    level = np.column_stack([i - 0.5, j])
    middles = np.concatenate([upright, level]).astype(np.float64)
    middles = middles[:: max(len(middles) // 100, 1)]
    pixels = grid_map.pixels(middles)
    offsets = np.stack(np.meshgrid(np.arange(-3, 4), np.arange(-3, 4)), -1).reshape(-1, 2)
    whole = np.round(pixels).astype(int)[:, None] + offsets
    inside = np.asarray(((whole >= 0) & (whole < [image.shape[1], image.shape[0]])).all(-1))
    safe = np.where(inside[..., None], whole, 0)
    gradient = np.linalg.inv(grid_map.jacobian(middles))
    grid = middles[:, None] + np.einsum("mab,mkb->mka", gradient, whole - pixels[:, None])
    light, dark = albedo.levels(grid)
    values = (image[safe[..., 1], safe[..., 0]] - dark) / np.maximum(light - dark, 1.0)
    gradients = np.broadcast_to(gradient[:, None], (*grid.shape, 2))
    return grid[inside], gradients[inside], values[inside]
