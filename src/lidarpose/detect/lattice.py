"""Grids of chessboard corners of any size: saddles of the image, linked to their neighbours along the squares' edges.

Nothing is assumed of the number of corners, so that a board of another size than was asked for can be named, and two
boards are found at once. After Geiger et al., "Automatic camera and range sensor calibration using a single shot"
(2012), with links in place of an energy: every saddle knows the directions of its two edges and which quadrants are
light; the next corner along an edge has light and dark exchanged.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from lidarpose.detect.grid_map import fit_grid_map
from lidarpose.geometry.arrays import FloatArray, IntArray

Image8 = NDArray[np.uint8]

_RING_SAMPLES = 24
_RING_ANGLES = np.arange(_RING_SAMPLES) * (2.0 * np.pi / _RING_SAMPLES)
_RING = np.column_stack([np.cos(_RING_ANGLES), np.sin(_RING_ANGLES)])
_RING_RADIUS = 4.5
_MOST_SADDLES = 4000
# Links may deviate from the edges' directions by this much (lens, tilt, noise).
_LINK_COSINE = np.cos(np.radians(22.0))
_LEAST_NODES = 9
# Saddles whose distances are all computed, one by one; more go through a tree.
_FEW = 3000


@dataclass(frozen=True, eq=False)
class Lattice:
    """Corners with whole-number grid coordinates, from 0 on each axis.

    pixels : (N, 2); grid : (N, 2) integers.
    """

    pixels: FloatArray
    grid: IntArray

    @property
    def size(self) -> tuple[int, int]:
        """Corners along the two axes."""
        extent = self.grid.max(axis=0) + 1
        return int(extent[0]), int(extent[1])


@dataclass(frozen=True, eq=False)
class _Saddles:
    """pixels : (N, 2); phase : (N,), turns by pi from a corner to the next; edges : (N, 2, 2) unit directions."""

    pixels: FloatArray
    phase: NDArray[np.complex128]
    edges: FloatArray


def find_lattices(image: Image8, blur_px: float = 1.0, least_contrast: float = 1.0) -> list[Lattice]:
    """All chessboard-like grids of at least 3 x 3 corners in an image, the largest first.

    Squares must be at least some 10 pixels wide; `blur_px` smooths the image's noise,
    `least_contrast` is in grey levels of the smoothed image.
    """
    blurred = cv2.GaussianBlur(np.asarray(image, dtype=np.float32), (0, 0), blur_px)
    smooth = np.asarray(blurred, dtype=np.float32)
    saddles = _find_saddles(smooth, least_contrast)
    if len(saddles.pixels) < _LEAST_NODES:
        return []
    neighbours = _link(saddles)
    lattices = []
    for nodes, grid in _grow(saddles, neighbours):
        if len(nodes) >= _LEAST_NODES and (np.ptp(grid, axis=0) >= 2).all():
            lattices.append(_trim(_complete(smooth, Lattice(saddles.pixels[nodes], grid))))
    return sorted(lattices, key=lambda lattice: -len(lattice.grid))


def _find_saddles(smooth: FloatArray, least_contrast: float) -> _Saddles:
    xx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=5)
    yy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=5)
    xy = cv2.Sobel(smooth, cv2.CV_32F, 1, 1, ksize=5)
    response = np.asarray(xy * xy - xx * yy)
    peaks = (response >= cv2.dilate(response, np.ones((5, 5), np.uint8))) & (response > 0.0)
    border = int(np.ceil(_RING_RADIUS)) + 1
    peaks[:border] = peaks[-border:] = False
    peaks[:, :border] = peaks[:, -border:] = False
    y, x = np.nonzero(peaks)
    strength = response[y, x]
    order = np.argsort(-strength)[:_MOST_SADDLES]
    y, x = y[order], x[order]
    return _examine(smooth, np.column_stack([x, y]).astype(np.float64), least_contrast)


def ring_values(smooth: FloatArray, pixels: FloatArray, radius: float = _RING_RADIUS) -> FloatArray:
    """Values (N, samples) on circles around pixels (N, 2)."""
    if len(pixels) == 0:
        return np.zeros((0, _RING_SAMPLES))
    points = (pixels[:, None] + radius * _RING).astype(np.float32)
    values = cv2.remap(
        smooth, np.ascontiguousarray(points[..., 0]), np.ascontiguousarray(points[..., 1]), cv2.INTER_LINEAR
    )
    return np.asarray(values, dtype=np.float64)


def _examine(smooth: FloatArray, pixels: FloatArray, least_contrast: float) -> _Saddles:
    """Keep the points around which light and dark alternate twice, in quadrants opposite each other."""
    values = ring_values(smooth, pixels)
    spectrum = np.fft.rfft(values - values.mean(axis=1, keepdims=True), axis=1) / _RING_SAMPLES
    power = np.abs(spectrum) ** 2
    total = power[:, 1:].sum(axis=1)
    contrast = np.abs(spectrum[:, 2])
    good = (
        (power[:, 2] + power[:, 6] > 0.55 * total)
        & (power[:, 1] + power[:, 3] < 0.25 * total)
        & (contrast > least_contrast)
    )
    pixels, values, spectrum = pixels[good], values[good], spectrum[good]
    centred = values - 0.5 * (values.min(axis=1, keepdims=True) + values.max(axis=1, keepdims=True))
    after = np.roll(centred, -1, axis=1)
    crossing = np.signbit(centred) != np.signbit(after)
    four = crossing.sum(axis=1) == 4
    pixels, centred, after, crossing = pixels[four], centred[four], after[four], crossing[four]
    if len(pixels) == 0:
        return _Saddles(pixels, np.zeros(0, dtype=complex), np.zeros((0, 2, 2)))
    index = np.nonzero(crossing)[1].reshape(-1, 4)
    rows = np.arange(len(pixels))[:, None]
    start, end = centred[rows, index], after[rows, index]
    angle = (index + start / (start - end)) * (2.0 * np.pi / _RING_SAMPLES)
    # Opposite crossings belong to one edge: average them as directions without sign.
    doubled = np.exp(2j * angle)
    axes = np.angle(doubled[:, :2] + doubled[:, 2:]) / 2.0
    straight = np.abs(doubled[:, :2] + doubled[:, 2:]).min(axis=1) > 1.6
    edges = np.stack([np.cos(axes), np.sin(axes)], axis=-1)
    return _Saddles(pixels[straight], spectrum[four][straight, 2], edges[straight])


def _link(saddles: _Saddles) -> IntArray:
    """Neighbour (N, 4) of each saddle along +edge 0, +edge 1, -edge 0, -edge 1; -1 where there is none."""
    pixels = saddles.pixels
    index = _nearest(pixels, min(14, len(pixels) - 1))
    distance = np.linalg.norm(pixels[index] - pixels[:, None], axis=-1)
    directions = np.concatenate([saddles.edges, -saddles.edges], axis=1)
    towards = (pixels[index] - pixels[:, None]) / distance[..., None]
    cosine = np.einsum("nka,nsa->nsk", towards, directions)
    turned = (saddles.phase[index] * saddles.phase[:, None].conj()).real < 0.0
    allowed = (cosine > _LINK_COSINE) & turned[:, None]
    cost = np.where(allowed, distance[:, None] / np.maximum(cosine, 0.1) ** 4, np.inf)
    best = np.argmin(cost, axis=-1)
    rows = np.arange(len(pixels))[:, None]
    chosen = np.where(np.isfinite(cost[rows, np.arange(4), best]), index[rows, best], -1)
    # Both must choose each other.
    back = (chosen[chosen] == rows[..., None]).any(axis=-1)
    mutual = np.where((chosen >= 0) & back, chosen, -1)
    length = np.where(mutual >= 0, np.linalg.norm(pixels[mutual] - pixels[:, None], axis=-1), np.nan)
    # A link much longer than the one that it continues leads off the board.
    opposite = np.roll(length, 2, axis=1)
    return np.asarray(np.where(length > 1.7 * np.where(np.isfinite(opposite), opposite, np.inf), -1, mutual))


def _nearest(pixels: FloatArray, k: int) -> IntArray:
    """Each pixel's k nearest others (N, k), nearest first."""
    if len(pixels) <= _FEW:  # faster than a tree, and much faster than importing one
        points = pixels.astype(np.float32)
        _, index = cv2.batchDistance(points, points, cv2.CV_32F, normType=cv2.NORM_L2, K=k + 1)
        return np.asarray(index[:, 1:], dtype=np.int64)
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(pixels).query(pixels, k=k + 1)[1], dtype=np.int64)[:, 1:]


def _grow(saddles: _Saddles, neighbours: IntArray) -> list[tuple[IntArray, IntArray]]:
    """Connected saddles with their grid coordinates, shifted to start from 0."""
    links = neighbours.tolist()
    edges = saddles.edges.tolist()
    seen: set[int] = set()
    components = []
    for seed in range(len(links)):
        if seed in seen:
            continue
        placed = _grow_from(seed, links, edges, seen)
        if len(placed) >= _LEAST_NODES:
            nodes = np.array(list(placed), dtype=np.int64)
            grid = np.array(list(placed.values()), dtype=np.int64)
            components.append((nodes, grid - grid.min(axis=0)))
    return components


def _grow_from(
    seed: int, links: list[list[int]], edges: list[list[list[float]]], seen: set[int]
) -> dict[int, tuple[int, int]]:
    """Breadth-first from one saddle; each node carries which of its four links is the grid's +x and +y."""
    placed = {seed: (0, 0)}
    taken = {(0, 0)}
    frames = {seed: (0, 1)}
    seen.add(seed)
    queue = [seed]
    for node in queue:
        x_slot, y_slot = frames[node]
        x, y = placed[node]
        for slot, step in (
            (x_slot, (1, 0)),
            (y_slot, (0, 1)),
            ((x_slot + 2) % 4, (-1, 0)),
            ((y_slot + 2) % 4, (0, -1)),
        ):
            other = links[node][slot]
            where = (x + step[0], y + step[1])
            if other < 0 or other in seen or where in taken:
                continue
            frame = _carry_frame(node, other, (x_slot, y_slot), edges)
            if frame is None:
                continue
            placed[other], frames[other] = where, frame
            taken.add(where)
            seen.add(other)
            queue.append(other)
    return placed


def _carry_frame(
    node: int, other: int, frame: tuple[int, int], edges: list[list[list[float]]]
) -> tuple[int, int] | None:
    """The other node's slots that point as the grid's +x and +y do at this one."""

    def slot_like(slot: int) -> tuple[int, float]:
        ex, ey = edges[node][slot % 2]
        sign = 1.0 if slot < 2 else -1.0
        dots = [sign * (ex * f[0] + ey * f[1]) for f in edges[other]]
        k = 0 if abs(dots[0]) >= abs(dots[1]) else 1
        return (k if dots[k] > 0 else k + 2), abs(dots[k])

    (x_slot, x_like), (y_slot, y_like) = slot_like(frame[0]), slot_like(frame[1])
    if x_slot % 2 == y_slot % 2 or min(x_like, y_like) < 0.8:
        return None
    return x_slot, y_slot


def _complete(smooth: FloatArray, lattice: Lattice) -> Lattice:
    """Add corners that the smooth map predicts and the image confirms, within the grid and one line around it."""
    for _ in range(4):
        width, height = lattice.size
        if len(lattice.grid) < 2 * _LEAST_NODES:
            return lattice
        fit = fit_grid_map(width, height, lattice.grid.astype(np.float64), lattice.pixels)
        keep = np.abs(fit.residuals_px).max(axis=1) < 2.5
        grid, pixels = lattice.grid[keep], lattice.pixels[keep]
        x, y = np.meshgrid(np.arange(-1, width + 1), np.arange(-1, height + 1))
        wanted = np.column_stack([x.ravel(), y.ravel()])
        have = {tuple(g) for g in grid.tolist()}
        wanted = np.array([g for g in wanted.tolist() if tuple(g) not in have], dtype=np.int64).reshape(-1, 2)
        predicted = fit.map.pixels(wanted.astype(np.float64))
        confirmed = is_corner(smooth, predicted, wanted, *_polarity(smooth, pixels, grid))
        confirmed &= _beside(wanted, have)
        if not confirmed.any() and keep.all():
            break
        grid, pixels = np.concatenate([grid, wanted[confirmed]]), np.concatenate([pixels, predicted[confirmed]])
        lattice = Lattice(pixels, grid - grid.min(axis=0))
    return lattice


def _trim(lattice: Lattice) -> Lattice:
    """Drop outer lines of which less than half is there: corners of frames and letters that happen to be in line."""
    grid, pixels = lattice.grid, lattice.pixels
    trimmed = True
    while trimmed and len(grid) >= _LEAST_NODES:
        trimmed = False
        for axis in (0, 1):
            across = np.ptp(grid[:, 1 - axis]) + 1
            for edge in (grid[:, axis].min(), grid[:, axis].max()):
                line = grid[:, axis] == edge
                if line.sum() < 0.5 * across:
                    grid, pixels, trimmed = grid[~line], pixels[~line], True
    return Lattice(pixels, grid - grid.min(axis=0)) if len(grid) else lattice


def _beside(wanted: IntArray, have: set[tuple[int, ...]]) -> NDArray[np.bool_]:
    """Whether at least one of the four neighbours is there."""
    steps = ((1, 0), (-1, 0), (0, 1), (0, -1))
    return np.array([any((x + i, y + j) in have for i, j in steps) for x, y in wanted.tolist()], dtype=bool)


def _polarity(smooth: FloatArray, pixels: FloatArray, grid: IntArray) -> tuple[NDArray[np.complex128], float]:
    """The phase that corners at even coordinates have here, and their median contrast."""
    values = ring_values(smooth, pixels)
    second = np.fft.rfft(values, axis=1)[:, 2] / _RING_SAMPLES
    sign = 1.0 - 2.0 * (grid.sum(axis=1) % 2)
    mean = np.asarray((second * sign / np.maximum(np.abs(second), 1e-9)).mean())
    return mean, float(np.median(np.abs(second)))


def is_corner(
    smooth: FloatArray, pixels: FloatArray, grid: IntArray, phase: NDArray[np.complex128], contrast: float
) -> NDArray[np.bool_]:
    """Whether the image has a corner of the right colours at predicted places (N, 2)."""
    if len(pixels) == 0:
        return np.zeros(0, dtype=bool)
    height, width = smooth.shape
    inside = ((pixels > _RING_RADIUS) & (pixels < np.array([width, height]) - 1 - _RING_RADIUS)).all(axis=1)
    values = ring_values(smooth, pixels)
    spectrum = np.fft.rfft(values, axis=1) / _RING_SAMPLES
    power = np.abs(spectrum) ** 2
    sign = 1.0 - 2.0 * (grid.sum(axis=1) % 2)
    second = spectrum[:, 2] * sign
    cosine = (second * np.conj(phase)).real / np.maximum(np.abs(second) * np.abs(phase), 1e-9)
    shape = power[:, 2] + power[:, 6] > 0.5 * power[:, 1:].sum(axis=1)
    return np.asarray(inside & shape & (cosine > 0.7) & (np.abs(second) > 0.15 * contrast))
