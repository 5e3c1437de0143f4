"""Images of a scene: albedo times light, the lens's blur and vignetting, photon and read noise, eight bits.

Each pixel is the mean over its area. Where a print's edge crosses a pixel, 89 rays through it are averaged: they give
the mean albedo, and the mean of the points weighted with it, so that light which changes across the pixel (the laser's
sheet) is weighted rightly too. The stripe is drawn from each point's distance to the sheet, nothing else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from lidarpose.geometry.arrays import FloatArray, IntArray, unit
from lidarpose.geometry.se3 import Pose
from lidarpose.model.camera import Camera
from lidarpose.simulate.lidar import lit_range
from lidarpose.simulate.turntable_scene import Scene, Surface

Float32Image = NDArray[np.float32]

# The Fibonacci lattice of 89 points in the unit square: even in all directions, 89 different places along either axis.
_LATTICE = (np.column_stack([np.arange(89), (np.arange(89) * 55) % 89]) + 0.5) / 89.0 - 0.5


@dataclass(frozen=True)
class Photography:
    """Lens, sensor and light. Levels are those of the eight-bit image.

    Attributes
    ----------
    blur_px
        Sigma of the lens's blur.
    vignetting
        Share of light lost in the corners.
    electrons_per_level, read_noise_levels, black_level
        The sensor. With `noise` False neither photon nor read noise is added (levels are still whole numbers).
    board_level, ambient_level
        What a white panel shows in the board images, and in the stripe images where the laser does not shine.
    stripe_level
        What the stripe's middle shows on white, on average; above 255 it saturates.
    sheet_sigma_m, sheet_divergence_rad
        Half-thickness (sigma) of the light sheet where it leaves, and how fast it grows.
    speckle
        Contrast of the laser's speckle in a pixel, before the lens's blur.
    veil
        Share of light that the lens spreads over its surroundings.
    glare_share
        Share of stripe images with a bright reflection in them.
    hot_pixels
        Pixels that shine by themselves in the long exposure of a stripe image.
    lamps
        Small lamps and lit slits around the board, in all stripe images.
    """

    blur_px: float = 0.8
    vignetting: float = 0.25
    electrons_per_level: float = 40.0
    read_noise_levels: float = 0.7
    black_level: float = 3.0
    noise: bool = True
    board_level: float = 190.0
    ambient_level: float = 7.0
    stripe_level: float = 160.0
    sheet_sigma_m: float = 0.0009
    sheet_divergence_rad: float = 0.0002
    speckle: float = 0.3
    veil: float = 0.01
    glare_share: float = 0.05
    hot_pixels: int = 20
    lamps: int = 0


@dataclass(frozen=True, eq=False)
class Layer:
    """Pixels in which light from one kind of surface arrives: the parts of a pixel that others cover are left out.

    Attributes
    ----------
    pixel : (N,)
        Flat indices.
    point : (N, 3)
        Where, in the camera's frame: the mean over the pixel's part, weighted with the albedo.
    albedo : (N,)
        Mean albedo times the part's share of the pixel.
    normal : (N, 3) or (3,)
        Of the surface.
    """

    pixel: IntArray
    point: FloatArray
    albedo: NDArray[np.float32]
    normal: FloatArray


@dataclass(frozen=True, eq=False)
class View:
    """A scene as the camera sees it, before any light: a layer for each plate and one for all behind."""

    camera: Camera
    scene: Scene
    layers: tuple[Layer, ...]

    @staticmethod
    def of(camera: Camera, scene: Scene) -> View:
        rays = np.reshape(pixel_rays(camera), (-1, 3))
        plates = [s for s in scene.surfaces if s.panel is not None]
        uncovered = np.ones(len(rays), dtype=np.float32)
        layers = []
        for plate in plates:
            layer, covered = _plate_layer(camera, rays, plate)
            uncovered[layer.pixel] -= covered
            layers.append(layer)
        layers.append(_background_layer(camera, rays, scene, np.clip(uncovered, 0.0, 1.0)))
        return View(camera, scene, tuple(layers))

    def radiance(self, lamp_direction: FloatArray, gradient: FloatArray) -> Float32Image:
        """The scene (H, W) under a far lamp: albedo times the cosine towards it, some light from everywhere,
        and a gradient (3,) by place, relative a metre."""
        image = np.zeros(self.camera.width * self.camera.height, dtype=np.float32)
        for layer in self.layers:
            cosine = np.abs(layer.normal @ lamp_direction)
            shading = (0.35 + 0.65 * cosine) * np.maximum(1.0 + layer.point @ gradient, 0.2)
            image[layer.pixel] += layer.albedo * shading
        return image.reshape(self.camera.height, self.camera.width)

    def laser_light(
        self, T_camera_lidar: Pose, fan_rad: tuple[float, float], photography: Photography, rng: np.random.Generator
    ) -> Float32Image:
        """The light (H, W) of the LiDAR's sheet: on white, straight under it and a metre away, 1 in the middle."""
        image = np.zeros(self.camera.width * self.camera.height, dtype=np.float32)
        angles = np.linspace(fan_rad[0], fan_rad[1], 8000)
        reach = lit_range(self.scene, T_camera_lidar, angles)
        for layer in self.layers:
            _add_sheet(image, layer, T_camera_lidar, angles, reach, photography, rng)
        return image.reshape(self.camera.height, self.camera.width)

    def lamps(self, rng: np.random.Generator, count: int) -> Float32Image:
        """Things (H, W) that shine by themselves in the dark, in levels: little round lamps and lit slits, beside the
        board."""
        height, width = self.camera.height, self.camera.width
        image = np.zeros((height, width), dtype=np.float32)
        for _ in range(count):
            u, v = (int(x) for x in rng.uniform([0, 0], [width, height]))
            level, size = float(rng.uniform(40.0, 400.0)), float(rng.uniform(1.0, 6.0))
            if rng.random() < 0.5:
                cv2.circle(image, (u, v), max(1, round(size)), level, -1, cv2.LINE_AA)
            else:
                du, dv = (int(x) for x in rng.uniform(-0.3, 0.3, 2) * width)
                cv2.line(image, (u, v), (u + du, v + dv), 0.4 * level, max(1, round(size)), cv2.LINE_AA)
        for layer in self.layers[:-1]:
            image.ravel()[layer.pixel] = 0.0
        return image


def pixel_rays(camera: Camera) -> FloatArray:
    """Directions (H, W, 3), z = 1, through all pixels' centres: undistorted on a grid of 8, cubic between."""
    from scipy.interpolate import RectBivariateSpline

    u, v = np.arange(-8.0, camera.width + 16.0, 8.0), np.arange(-8.0, camera.height + 16.0, 8.0)
    coarse = camera.undistort(np.stack(np.meshgrid(u, v), axis=-1))
    columns, rows = np.arange(camera.width), np.arange(camera.height)
    rays = np.ones((camera.height, camera.width, 3))
    for k in (0, 1):
        if np.all(np.isfinite(coarse[..., k])):
            rays[..., k] = RectBivariateSpline(v, u, coarse[..., k])(rows, columns)
        else:
            # A lens with a border beyond which it shows nothing: exactly, pixel by pixel.
            rays[..., k] = camera.undistort(np.stack(np.meshgrid(columns, rows), axis=-1))[..., k]
    return rays


def _bounding_box(camera: Camera, surface: Surface) -> tuple[slice, slice] | None:
    """Rows and columns that a surface can cover; all of them if it reaches behind the camera; None if none."""
    outline = surface.outline()
    if np.any(outline[:, 2] < 0.05):
        return slice(0, camera.height), slice(0, camera.width)
    # Straight edges bend under distortion: points along them, and a few pixels to spare.
    share = np.linspace(0.0, 1.0, 33)[:, None]
    edges = np.concatenate([(1 - share) * outline[k] + share * outline[(k + 1) % 4] for k in range(4)])
    ideal = edges[:, :2] / edges[:, 2:]
    # Far outside the picture a distortion polynomial means nothing: hold points within reach of it.
    ideal = ideal / np.maximum(1.0, np.abs(ideal).max(axis=1, keepdims=True) / _view_reach(camera))
    pixels = camera.project(np.column_stack([ideal, np.ones(len(ideal))]))
    low = np.floor(pixels.min(axis=0)).astype(int) - 3
    high = np.ceil(pixels.max(axis=0)).astype(int) + 4
    rows = slice(max(0, low[1]), min(camera.height, high[1]))
    columns = slice(max(0, low[0]), min(camera.width, high[0]))
    return (rows, columns) if rows.start < rows.stop and columns.start < columns.stop else None


@lru_cache(maxsize=8)
def _view_reach(camera: Camera) -> float:
    """The largest |x/z| or |y/z| that a pixel shows, and a fifth more."""
    u, v = np.linspace(0.0, camera.width - 1.0, 33), np.linspace(0.0, camera.height - 1.0, 33)
    return 1.2 * float(np.nanmax(np.abs(camera.undistort(np.stack(np.meshgrid(u, v), axis=-1)))))


def _flat_box(camera: Camera, box: tuple[slice, slice]) -> IntArray:
    rows, columns = np.arange(box[0].start, box[0].stop), np.arange(box[1].start, box[1].stop)
    return (rows[:, None] * camera.width + columns).ravel()


def _plate_layer(camera: Camera, rays: FloatArray, plate: Surface) -> tuple[Layer, NDArray[np.float32]]:
    """The pixels that a plate covers, wholly or in part, and each one's covered share."""
    box = _bounding_box(camera, plate) or (slice(0, 0), slice(0, 0))
    pixel = _flat_box(camera, box)
    shape = (box[0].stop - box[0].start, box[1].stop - box[1].start)
    if min(shape) < 2:
        nothing = np.zeros(0, dtype=np.int64)
        return Layer(nothing, np.zeros((0, 3)), np.zeros(0, np.float32), plate.normal), np.zeros(0, np.float32)
    xy = _unbounded(plate, rays[pixel])
    grid = xy.reshape(*shape, 2)
    by_row, by_column = (np.reshape(np.gradient(grid, axis=k), (-1, 2)) for k in (0, 1))
    # Half the extent of each pixel on the plate, along x and y.
    extent = 0.55 * (np.abs(by_row) + np.abs(by_column))
    off = np.abs(xy) - [plate.half_width, plate.half_height]
    touched = np.all(off < extent, axis=1)
    pixel, xy, by_row, by_column = pixel[touched], xy[touched], by_row[touched], by_column[touched]
    extent, off = extent[touched], off[touched]
    albedo = plate.albedo_at(xy[:, 0], xy[:, 1])
    covered, centroid = np.ones(len(pixel)), xy.copy()
    mixed = np.flatnonzero(np.any(off > -extent, axis=1) | _on_an_edge(plate, xy, extent))
    if len(mixed):
        averages = _average(plate, xy[mixed], by_row[mixed], by_column[mixed])
        albedo[mixed], covered[mixed], centroid[mixed] = averages
    seen = covered > 0.0
    surface_points = np.column_stack([centroid, np.zeros(len(centroid))])[seen]
    points = plate.T_camera_surface @ surface_points
    layer = Layer(pixel[seen], points, albedo[seen].astype(np.float32), plate.normal)
    return layer, covered[seen].astype(np.float32)


def _unbounded(plate: Surface, rays: FloatArray) -> FloatArray:
    """Where rays (N, 3) from the camera meet the plate's plane: x, y (N, 2) on it, also beyond its edges."""
    R, c = plate.T_camera_surface.rotation, plate.T_camera_surface.translation
    # p = s ray = c + x R_x + y R_y: three planes, one of them the plate's own, give x and y without s.
    with np.errstate(divide="ignore", invalid="ignore"):
        s = (c @ R[:, 2]) / (rays @ R[:, 2])
    x, y = s * (rays @ R[:, 0]) - c @ R[:, 0], s * (rays @ R[:, 1]) - c @ R[:, 1]
    return np.where((s > 0.0)[:, None], np.column_stack([x, y]), 1e6)


def _on_an_edge(plate: Surface, xy: FloatArray, extent: FloatArray) -> NDArray[np.bool_]:
    """Pixels (N,) that a line between squares may cross."""
    assert plate.panel is not None
    assert plate.T_panel_surface is not None
    in_squares = (xy + plate.T_panel_surface.translation[:2]) / plate.panel.square_m
    to_line = np.abs(in_squares - np.round(in_squares)) * plate.panel.square_m
    return np.asarray(np.any(to_line < extent, axis=1))


def _average(
    plate: Surface, xy: FloatArray, by_row: FloatArray, by_column: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Over each pixel's area: albedo times coverage (N,), coverage (N,), and the albedo's centroid (N, 2)."""
    albedo, covered, moment = np.zeros(len(xy)), np.zeros(len(xy)), np.zeros((len(xy), 2))
    for right, down in _LATTICE:
        p = xy + right * by_column + down * by_row
        on = np.all(np.abs(p) <= [plate.half_width, plate.half_height], axis=1)
        value = np.where(on, plate.albedo_at(p[:, 0], p[:, 1]), 0.0)
        albedo, covered, moment = albedo + value, covered + on, moment + value[:, None] * p
    centroid = np.where(albedo[:, None] > 0.0, moment / np.maximum(albedo, 1e-12)[:, None], xy)
    return albedo / len(_LATTICE), covered / len(_LATTICE), centroid


def _background_layer(camera: Camera, rays: FloatArray, scene: Scene, share: NDArray[np.float32]) -> Layer:
    """What is seen beside and behind the plates; blur is its only smoothing."""
    depth = np.full(len(rays), np.inf)
    albedo = np.zeros(len(rays))
    owner = np.full(len(rays), -1, dtype=np.int64)
    for k, surface in enumerate(scene.surfaces):
        box = None if surface.panel is not None else _bounding_box(camera, surface)
        if box is None:
            continue
        pixel = _flat_box(camera, box)
        pixel = pixel[share[pixel] > 0.0]
        s, x, y = surface.meet(np.zeros(3), rays[pixel])
        nearer = np.flatnonzero(s < depth[pixel])
        at = pixel[nearer]
        depth[at], owner[at] = s[nearer], k
        albedo[at] = surface.albedo_at(x[nearer], y[nearer])
    seen = np.flatnonzero(owner >= 0)
    normals = np.array([s.normal for s in scene.surfaces])[owner[seen]]
    points = depth[seen, None] * rays[seen]
    return Layer(seen, points, (albedo[seen] * share[seen]).astype(np.float32), normals)


def _add_sheet(
    image: NDArray[np.float32],
    layer: Layer,
    T_camera_lidar: Pose,
    angles: FloatArray,
    reach: FloatArray,
    photography: Photography,
    rng: np.random.Generator,
) -> None:
    """Add a layer's share of the sheet's light. Irradiance: Gaussian across the sheet, times the cosine of incidence,
    over distance (a fan) and over the sheet's thickness; zero in shadow and outside the fan."""
    normal = T_camera_lidar.rotation[:, 2]
    across = layer.point @ normal - T_camera_lidar.translation @ normal
    widest = photography.sheet_sigma_m + 8.0 * photography.sheet_divergence_rad
    near = np.flatnonzero(np.abs(across) < 5.0 * widest)
    if not len(near):
        return
    p, d = layer.point[near] - T_camera_lidar.translation, across[near]
    forward, sideways = p @ T_camera_lidar.rotation[:, 0], p @ T_camera_lidar.rotation[:, 1]
    distance, angle = np.hypot(forward, sideways), np.arctan2(sideways, forward)
    middle = 0.5 * (angles[0] + angles[-1])
    angle = middle + (angle - middle + np.pi) % (2.0 * np.pi) - np.pi
    nearest = np.clip(np.round((angle - angles[0]) / (angles[1] - angles[0])), 0, len(angles) - 1).astype(np.int64)
    lit = (angle >= angles[0]) & (angle <= angles[-1]) & (distance < 1.003 * reach[nearest] + 0.003)
    sigma = photography.sheet_sigma_m + photography.sheet_divergence_rad * distance
    normals = layer.normal if layer.normal.ndim == 1 else layer.normal[near]
    cosine = np.abs((p * normals).sum(axis=1)) / np.maximum(distance, 1e-6)
    light = np.exp(-0.5 * (d / sigma) ** 2) * cosine / distance * (photography.sheet_sigma_m / sigma) * lit
    if photography.speckle > 0.0 and photography.noise:
        # Speckle summed over M grains is gamma-distributed with contrast 1/sqrt(M) (Goodman).
        shape = 1.0 / photography.speckle**2
        light = light * (rng.standard_gamma(shape, len(light)) / shape)
    image[layer.pixel[near]] += (layer.albedo[near] * light).astype(np.float32)


@dataclass(frozen=True, eq=False)
class Sensor:
    """Lens and sensor of one camera: light (H, W) in, grey levels out."""

    camera: Camera
    photography: Photography
    seed: int
    _falloff: Float32Image = field(init=False, repr=False)

    def __post_init__(self) -> None:
        u = (np.arange(self.camera.width) - self.camera.cx) ** 2
        v = (np.arange(self.camera.height) - self.camera.cy) ** 2
        corner = max(u[0], u[-1]) + max(v[0], v[-1])
        falloff = 1.0 - self.photography.vignetting * (v[:, None] + u) / corner
        object.__setattr__(self, "_falloff", falloff.astype(np.float32))

    def optical(self, light: Float32Image) -> Float32Image:
        """Blur, veil and vignetting."""
        blur = self.photography.blur_px
        out = cv2.GaussianBlur(light, (0, 0), blur) if blur > 0.0 else light.copy()
        if self.photography.veil > 0.0:
            size = (max(1, light.shape[1] // 16), max(1, light.shape[0] // 16))
            small = cv2.GaussianBlur(cv2.resize(out, size, interpolation=cv2.INTER_AREA), (0, 0), 3.0)
            wide = cv2.resize(small, (light.shape[1], light.shape[0]), interpolation=cv2.INTER_LINEAR)
            out = cv2.addWeighted(out, 1.0 - self.photography.veil, wide, self.photography.veil, 0.0)
        return np.asarray(out * self._falloff)

    def expose(self, levels: Float32Image, rng: np.random.Generator, *, long: bool = False) -> NDArray[np.uint8]:
        """Photon noise (variance proportional to light), read noise, hot pixels in long exposures, eight bits."""
        how = self.photography
        out = levels + np.float32(how.black_level)
        if how.noise:
            variance = np.maximum(levels, 0.0) / np.float32(how.electrons_per_level) + np.float32(
                how.read_noise_levels**2
            )
            np.sqrt(variance, out=variance)
            variance *= rng.standard_normal(levels.shape, dtype=np.float32)
            out += variance
            if long:
                fixed = np.random.default_rng([self.seed, 5])
                hot = fixed.integers(0, out.size, how.hot_pixels)
                out.ravel()[hot] += fixed.uniform(20.0, 255.0, how.hot_pixels).astype(np.float32)
        np.rint(out, out=out)
        return np.clip(out, 0.0, 255.0, out=out).astype(np.uint8)


def glare(camera: Camera, rng: np.random.Generator) -> Float32Image:
    """A bright reflection (H, W): an elongated spot with a soft halo, 1 in its middle."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float32), np.arange(camera.height, dtype=np.float32))
    centre = rng.uniform([0.1 * camera.width, 0.1 * camera.height], [0.9 * camera.width, 0.9 * camera.height])
    angle = rng.uniform(0.0, np.pi)
    along = (u - centre[0]) * np.float32(np.cos(angle)) + (v - centre[1]) * np.float32(np.sin(angle))
    aside = (v - centre[1]) * np.float32(np.cos(angle)) - (u - centre[0]) * np.float32(np.sin(angle))
    size = rng.uniform([8.0, 3.0], [60.0, 12.0]) * camera.width / 1624.0
    core = np.exp(-0.5 * ((along / np.float32(size[0])) ** 2 + (aside / np.float32(size[1])) ** 2))
    halo = np.exp(-0.5 * (along**2 + aside**2) / np.float32((3.0 * size[0]) ** 2))
    return np.asarray(core + np.float32(0.06) * halo, dtype=np.float32)


def draw_lamp(rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
    """A lamp's direction (3,) from the scene, and the light's gradient (3,) a metre."""
    direction = unit(np.array([rng.uniform(-0.7, 0.7), rng.uniform(-0.9, 0.3), -1.0]))
    return direction, np.asarray(rng.uniform(-0.35, 0.35, 3) * [1.0, 1.0, 0.2])
