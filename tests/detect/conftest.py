"""A small renderer of V boards with a laser's stripe, by brute force: several rays a pixel, nothing in closed form.

It shares no code with detection or with the package's simulator, and knows lens distortion only as a bend of its rays.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import cv2
import numpy as np
import pytest

from lidarpose.model.targets import Panel

Array = np.ndarray


def turn(axis: str, degrees: float) -> Array:
    a = np.radians(degrees)
    c, s = np.cos(a), np.sin(a)
    y, z = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    R = np.eye(3)
    R[y, y] = R[z, z] = c
    R[y, z], R[z, y] = -s, s
    return R


@dataclass
class Board:
    """A chessboard: `rotation`, `centre` of its inner corners in the camera frame; outer squares and a white margin."""

    panel: Panel
    rotation: Array
    centre: Array
    margin_m: float = 0.0
    white: float = 0.9
    black: float = 0.06

    @property
    def origin(self) -> Array:
        half = np.array([self.panel.columns - 1, self.panel.rows - 1, 0.0]) * self.panel.square_m / 2
        return self.centre - self.rotation @ half

    def corners_camera(self) -> Array:
        return self.panel.corners_panel() @ self.rotation.T + self.origin

    def hit(self, rays: Array) -> tuple[Array, Array, Array]:
        """Distance along each ray (inf: missed), albedo there, and the point in the camera frame."""
        normal = self.rotation[:, 2]
        depth = (self.origin @ normal) / (rays @ normal)
        points = rays * depth[:, None]
        grid = (points - self.origin) @ self.rotation[:, :2] / self.panel.square_m
        column, row = np.floor(grid[:, 0]), np.floor(grid[:, 1])
        squares = (column >= -1) & (row >= -1) & (column < self.panel.columns) & (row < self.panel.rows)
        black = squares & ((column + row) % 2 == 0)
        reach = 1.0 + self.margin_m / self.panel.square_m
        inside = (
            np.abs(grid - [(self.panel.columns - 1) / 2, (self.panel.rows - 1) / 2])
            <= np.array([(self.panel.columns - 1) / 2 + reach, (self.panel.rows - 1) / 2 + reach])
        ).all(axis=1)
        return np.where(inside & (depth > 0), depth, np.inf), np.where(black, self.black, self.white), points


@dataclass
class Scene:
    boards: list[Board]
    width: int = 640
    height: int = 480
    focal: float = 1100.0
    k1: float = -0.08
    blur_px: float = 0.8
    samples: int = 16
    background: float = 0.3
    cache: dict[str, Array] = field(default_factory=dict)

    def ideal_rays(self, pixels: Array) -> Array:
        """Rays of distorted pixels, by fixed-point iteration of x_d = x (1 + k1 r^2)."""
        d = (pixels - [(self.width - 1) / 2, (self.height - 1) / 2]) / self.focal
        x = d.copy()
        for _ in range(5):
            x = d / (1 + self.k1 * (x**2).sum(axis=1, keepdims=True))
        return np.column_stack([x, np.ones(len(x))])

    def project(self, points: Array) -> Array:
        x = points[:, :2] / points[:, 2:]
        bent = x * (1 + self.k1 * (x**2).sum(axis=1, keepdims=True))
        return bent * self.focal + [(self.width - 1) / 2, (self.height - 1) / 2]

    def _fine(self) -> tuple[Array, Array, Array, Array]:
        if not self.cache:
            # One sample in each column and row of its cell: a regular grid would shift edges that run along it.
            k = np.arange(self.samples)[:, None]
            pattern = ((0.5 + k * [1, 7]) / self.samples) % 1.0
            pattern = pattern - pattern.mean(axis=0)
            whole = np.stack(np.meshgrid(np.arange(self.width), np.arange(self.height)), axis=-1).reshape(-1, 1, 2)
            pixels = (whole + pattern).reshape(-1, 2)
            rays = self.ideal_rays(pixels)
            depth = np.full(len(rays), np.inf)
            albedo = np.full(len(rays), self.background)
            points = np.full((len(rays), 3), np.nan)
            for board in self.boards:
                d, a, p = board.hit(rays)
                nearer = d < depth
                depth, albedo = np.where(nearer, d, depth), np.where(nearer, a, albedo)
                points[nearer] = p[nearer]
            self.cache.update(depth=depth, albedo=albedo, points=points, rays=rays)
        return self.cache["depth"], self.cache["albedo"], self.cache["points"], self.cache["rays"]

    def _to_sensor(self, fine: Array) -> Array:
        image = fine.reshape(self.height, self.width, self.samples).mean(axis=-1)
        return cv2.GaussianBlur(image, (0, 0), self.blur_px)

    def bright(self, level: float = 200.0) -> Array:
        """Noise-free board image (height, width), grey levels."""
        return self._to_sensor(level * self._fine()[1])

    def stripe(self, normal: Array, offset: float, sigma_m: float, level: float = 200.0) -> Array:
        """Noise-free stripe of the light sheet normal . x = offset, thickness sigma_m, on everything with a depth."""
        _, albedo, points, _ = self._fine()
        distance = np.nan_to_num(points @ normal - offset, nan=1e3)
        return self._to_sensor(level * albedo * np.exp(-0.5 * (distance / sigma_m) ** 2))

    def noisy(self, image: Array, rng: np.random.Generator, read: float = 1.5, gain: float = 0.02) -> Array:
        """Shot noise of variance gain * level, read noise, 8 bit."""
        noise = rng.normal(size=image.shape) * np.sqrt(read**2 + gain * np.maximum(image, 0))
        return np.clip(np.round(image + noise), 0, 255).astype(np.uint8)


def v_board(columns: int = 12, rows: int = 9, *, square_m: float = 0.02, vertical_fold: bool = True) -> list[Board]:
    """Two equal panels that meet at a fold, squares up to the fold, 1 m away."""
    panel = Panel(columns, rows, square_m)
    axis, side = ("y", np.array([1.0, 0, 0])) if vertical_fold else ("x", np.array([0, 1.0, 0]))
    half = ((columns if vertical_fold else rows) + 1) * square_m / 2
    fold = np.array([0.0, 0.0, 1.05])
    boards = []
    for sign in (-1.0, 1.0):
        R = turn(axis, 35.0 * sign * (1 if vertical_fold else -1))
        boards.append(Board(panel, R, fold + R @ (side * sign * half)))
    return boards


@pytest.fixture(scope="session")
def two_panels() -> Scene:
    return Scene(v_board())


@pytest.fixture(scope="session")
def make_scene() -> type[Scene]:
    return Scene


@pytest.fixture(scope="session")
def make_v_board() -> Callable[..., list[Board]]:
    return v_board
