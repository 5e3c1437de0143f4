"""The room around a turntable rig: the board's plates, its stand, walls, floor and clutter, all of flat pieces.

Camera and LiDAR look at the same pieces, so that the stripe in an image and the ranges of a scan agree wherever they
fall. Everything is in the camera's frame.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, unit
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.targets import Panel
from lidarpose.simulate.board_pattern import is_black
from lidarpose.simulate.rig import TurntableRig

ALBEDO_WHITE = 0.85
ALBEDO_BLACK = 0.07


@dataclass(frozen=True, eq=False)
class Surface:
    """A flat rectangle around its frame's origin: ``|x| <= half_width``, ``|y| <= half_height``, z = 0.

    Attributes
    ----------
    albedo
        Mean share of light that it gives back, in all directions alike.
    contrast, grain_m, stripes_m
        Strength of its mottled texture, the texture's grain, and the period of dark stripes across x (0: none).
    panel, T_surface_panel
        For a plate of the board: which chessboard is printed on it, and where.
    glass
        True for what reflects a LiDAR's beam away from it.
    """

    name: str
    T_camera_surface: Pose
    half_width: float
    half_height: float
    albedo: float
    contrast: float = 0.2
    grain_m: float = 0.05
    stripes_m: float = 0.0
    texture_seed: int = 0
    panel: Panel | None = None
    panel_index: int = -1
    T_panel_surface: Pose | None = None
    glass: bool = False

    @property
    def normal(self) -> FloatArray:
        return self.T_camera_surface.rotation[:, 2]

    def outline(self) -> FloatArray:
        """The four corners (4, 3) in the camera's frame."""
        w, h = self.half_width, self.half_height
        return self.T_camera_surface @ np.array([[-w, -h, 0.0], [w, -h, 0.0], [w, h, 0.0], [-w, h, 0.0]])

    def meet(self, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Along rays (N, 3) from `origin`: distances (N,) in the directions' unit, inf on a miss, and x, y (N,)."""
        R, c = self.T_camera_surface.rotation, self.T_camera_surface.translation
        with np.errstate(divide="ignore", invalid="ignore"):
            s = ((c - origin) @ R[:, 2]) / (directions @ R[:, 2])
            x = (origin - c) @ R[:, 0] + s * (directions @ R[:, 0])
            y = (origin - c) @ R[:, 1] + s * (directions @ R[:, 1])
            hit = (s > 1e-9) & (np.abs(x) <= self.half_width) & (np.abs(y) <= self.half_height)
        return np.where(hit, s, np.inf), x, y

    def albedo_at(self, x: FloatArray, y: FloatArray) -> FloatArray:
        """Albedo (N,) at points of the surface: the print of a panel, or mottled paint."""
        if self.panel is not None and self.T_panel_surface is not None:
            p = self.T_panel_surface @ np.stack([x, y, np.zeros_like(x)], axis=-1)
            return np.asarray(np.where(is_black(self.panel, p), ALBEDO_BLACK, ALBEDO_WHITE))
        value = np.full(x.shape, self.albedo)
        value *= 1.0 + self.contrast * _mottle(x / self.grain_m, y / self.grain_m, self.texture_seed)
        if self.stripes_m > 0.0:
            value = np.where((x / self.stripes_m) % 1.0 < 0.2, 0.35 * value, value)
        return np.asarray(np.clip(value, 0.01, 0.95))


@dataclass(frozen=True)
class Hits:
    """Where rays first meet a scene: distance (N,), inf where nothing is met; surface (N,), -1 likewise; its x, y."""

    distance: FloatArray
    surface: IntArray
    x: FloatArray
    y: FloatArray


@dataclass(frozen=True)
class Scene:
    """All surfaces in view while the board stays in one place; the plates come first, in the order of the panels."""

    surfaces: tuple[Surface, ...]

    def cast(self, origin: FloatArray, directions: FloatArray) -> Hits:
        """The first surface along each ray (N, 3)."""
        n = len(directions)
        hits = Hits(np.full(n, np.inf), np.full(n, -1, dtype=np.int64), np.zeros(n), np.zeros(n))
        for k, surface in enumerate(self.surfaces):
            s, x, y = surface.meet(origin, directions)
            nearer = s < hits.distance
            hits.distance[nearer], hits.surface[nearer] = s[nearer], k
            hits.x[nearer], hits.y[nearer] = x[nearer], y[nearer]
        return hits

    def albedo(self, hits: Hits) -> FloatArray:
        """Albedo (N,) where rays met a surface; 0 where they met none."""
        value = np.zeros(len(hits.distance))
        for k in np.unique(hits.surface[hits.surface >= 0]):
            on = hits.surface == k
            value[on] = self.surfaces[k].albedo_at(hits.x[on], hits.y[on])
        return value


def _mottle(x: FloatArray, y: FloatArray, seed: int) -> FloatArray:
    """Smooth noise of unit strength with a grain of 1: random values on a grid, interpolated, repeated after 64."""
    table = np.random.default_rng([seed, 77]).uniform(-1.0, 1.0, (64, 64))
    i, j = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = x - i, y - j
    i0, j0, i1, j1 = i % 64, j % 64, (i + 1) % 64, (j + 1) % 64
    top = (1 - u) * table[j0, i0] + u * table[j0, i1]
    bottom = (1 - u) * table[j1, i0] + u * table[j1, i1]
    return np.asarray((1 - v) * top + v * bottom)


def draw_scene(rig: TurntableRig, placement: str, seed: int) -> Scene:
    """Plates, stand, walls, floor and clutter for one placement of the board; nothing stands in anybody's way.

    The room is the same for all placements of a seed.
    """
    rng = np.random.default_rng([seed, 2])
    plates = tuple(_plate(rig, placement, k) for k in range(len(rig.panels)))
    middle = np.mean([p.T_camera_surface.translation for p in plates], axis=0)
    things = [[piece] for piece in [*_room(rng, middle), *_stand(rng, plates, middle)]]
    things += [_box(rng, middle) for _ in range(int(rng.integers(5, 10)))]
    guard = _SightLines(rig, plates)
    # A box goes as a whole: a face of it that is seen edge-on could slip between the lines of sight that are tried.
    free = [thing for thing in things if not any(guard.blocked_by(piece) for piece in thing)]
    return Scene((*plates, *(piece for thing in free for piece in thing)))


def _plate(rig: TurntableRig, placement: str, index: int) -> Surface:
    plate, T_camera_panel = rig.plates[index], rig.T_camera_panel[placement][index]
    centre = np.array([0.5 * (plate.x_min + plate.x_max), 0.5 * (plate.y_min + plate.y_max), 0.0])
    T_panel_surface = Pose(np.eye(3), centre)
    return Surface(
        f"panel {index}",
        T_camera_panel @ T_panel_surface,
        0.5 * (plate.x_max - plate.x_min),
        0.5 * (plate.y_max - plate.y_min),
        ALBEDO_WHITE,
        panel=rig.panels[index],
        panel_index=index,
        T_panel_surface=T_panel_surface,
    )


def _facing(normal: FloatArray, x_near: FloatArray) -> FloatArray:
    """A rotation whose z is `normal` and whose x is as near to `x_near` as can be."""
    z = unit(normal)
    x = unit(x_near - (x_near @ z) * z)
    return np.column_stack([x, np.cross(z, x), z])


def _room(rng: np.random.Generator, middle: FloatArray) -> list[Surface]:
    """A wall behind the board, a floor, and a wall on one side; beyond them nothing comes back."""
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    towards = exp_so3([rng.uniform(-0.1, 0.1), rng.uniform(-0.4, 0.4), 0.0]) @ np.array([0.0, 0.0, -1.0])
    behind = middle - rng.uniform(0.6, 1.8) * towards
    lean = exp_so3([rng.uniform(-0.06, 0.06), 0.0, rng.uniform(-0.06, 0.06)])
    below = middle + rng.uniform(0.45, 0.9) * down
    side = float(rng.choice([-1.0, 1.0]))
    beside = middle + side * rng.uniform(1.2, 2.2) * right
    return [
        _painted(rng, "wall", Pose(_facing(towards, right), behind), 2.5, 2.0),
        _painted(rng, "floor", Pose(_facing(lean @ -down, right), below), 3.0, 3.0, tiles=True),
        _painted(rng, "side wall", Pose(_facing(lean @ (-side * right), np.array([0.0, 0.0, 1.0])), beside), 2.0, 2.0),
    ]


def _painted(
    rng: np.random.Generator, name: str, T: Pose, half_width: float, half_height: float, *, tiles: bool = False
) -> Surface:
    return Surface(
        name,
        T,
        half_width,
        half_height,
        float(rng.uniform(0.1, 0.7)),
        contrast=float(rng.uniform(0.05, 0.35)),
        grain_m=float(rng.uniform(0.02, 0.15)),
        stripes_m=float(rng.uniform(0.05, 0.3)) if tiles or rng.random() < 0.3 else 0.0,
        texture_seed=int(rng.integers(1 << 30)),
        glass=bool(rng.random() < 0.08),
    )


def _stand(rng: np.random.Generator, plates: tuple[Surface, ...], middle: FloatArray) -> list[Surface]:
    """A post behind the fold, clamps at the plates' edges, and at times a table under the board."""
    right, down = np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0])
    back = np.array([0.0, 0.0, -1.0])
    post = middle + np.array([rng.uniform(-0.05, 0.05), 0.6, rng.uniform(0.16, 0.3)])
    pieces = [_painted(rng, "post", Pose(_facing(back, right), post), float(rng.uniform(0.02, 0.05)), 0.7)]
    lowest = max(float(p.outline()[:, 1].max()) for p in plates)
    if rng.random() < 0.6:
        lean = exp_so3([rng.uniform(-0.03, 0.03), 0.0, rng.uniform(-0.03, 0.03)])
        top = np.array([middle[0], lowest + rng.uniform(0.004, 0.06), middle[2] + 0.05])
        table = Pose(_facing(lean @ -down, right), top)
        pieces.append(_painted(rng, "table", table, float(rng.uniform(0.3, 0.6)), float(rng.uniform(0.2, 0.35))))
    for plate in plates:
        pieces += [_clamp(rng, plate) for _ in range(int(rng.integers(1, 4)))]
    return pieces


def _clamp(rng: np.random.Generator, plate: Surface) -> Surface:
    """A small bright or dark piece that sticks out beyond one of a plate's edges, a little behind its face."""
    half = rng.uniform(0.01, 0.03, 2)
    along, sign = rng.uniform(-0.8, 0.8), rng.choice([-1.0, 1.0])
    if rng.random() < 0.5:
        place = np.array([along * plate.half_width, sign * (plate.half_height + half[1] + 0.001), 0.0])
    else:
        place = np.array([sign * (plate.half_width + half[0] + 0.001), along * plate.half_height, 0.0])
    tilt = exp_so3(rng.uniform(-0.3, 0.3, 3))
    depth = np.array([0.0, 0.0, rng.uniform(0.002, 0.02)])
    return _painted(rng, "clamp", plate.T_camera_surface @ Pose(tilt, place + depth), float(half[0]), float(half[1]))


def _box(rng: np.random.Generator, middle: FloatArray) -> list[Surface]:
    """A box somewhere around the board: its six faces."""
    size = rng.uniform(0.04, 0.3, 3)
    place = middle + rng.uniform([-1.0, -0.7, -0.5], [1.0, 0.7, 1.0])
    T = Pose(exp_so3(rng.uniform(-1.0, 1.0, 3)), place)
    faces = []
    for axis in range(3):
        for sign in (-1.0, 1.0):
            normal = sign * np.eye(3)[axis]
            rotation = _facing(normal, np.eye(3)[(axis + 1) % 3])
            width, height = np.abs(rotation[:, :2].T @ size)
            T_box_face = Pose(rotation, normal * size[axis] / 2)
            faces.append(_painted(rng, "box", T @ T_box_face, float(width / 2), float(height / 2)))
    return faces


class _SightLines:
    """The straight ways from camera and LiDAR to the plates that must stay free."""

    def __init__(self, rig: TurntableRig, plates: tuple[Surface, ...]) -> None:
        grid = np.linspace(-0.999, 0.999, 40)
        x, y = (g.ravel() for g in np.meshgrid(grid, grid))
        flat = [np.column_stack([p.half_width * x, p.half_height * y, 0 * x]) for p in plates]
        self._targets = np.concatenate([p.T_camera_surface @ f for p, f in zip(plates, flat, strict=True)])
        centres = [rig.T_camera_lidar(k).translation for k in (0, len(rig) // 2, len(rig) - 1)]
        self._origins = [np.zeros(3), *centres]

    def blocked_by(self, piece: Surface) -> bool:
        near = self._too_near(piece)
        return near or any(self._shades(piece, origin) for origin in self._origins)

    def _shades(self, piece: Surface, origin: FloatArray) -> bool:
        s, _, _ = piece.meet(origin, self._targets - origin)
        blocked: BoolArray = s < 1.0 - 1e-6
        return bool(blocked.any())

    def _too_near(self, piece: Surface) -> bool:
        """Nothing stands right before camera or LiDAR either."""
        for origin in self._origins:
            x, y, z = piece.T_camera_surface.inverse() @ origin
            off = np.maximum(np.abs([x, y]) - [piece.half_width, piece.half_height], 0.0)
            if np.hypot(np.hypot(*off), z) < 0.2:
                return True
        return False


def without_room(scene: Scene) -> Scene:
    """The plates alone, before nothing: for studies of one effect at a time."""
    return replace(scene, surfaces=tuple(s for s in scene.surfaces if s.panel is not None))
