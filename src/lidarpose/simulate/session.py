"""Simulated turntable sessions: images and scans that are made when they are asked for, and the truth about them."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np

from lidarpose.geometry.se3 import Pose
from lidarpose.model.image import GrayImage
from lidarpose.model.scan import Scan
from lidarpose.model.session import TurntablePlace, TurntableSession
from lidarpose.simulate.camera_render import Float32Image, Photography, Sensor, View, draw_lamp, glare
from lidarpose.simulate.lidar import LidarBehaviour, scan_scene
from lidarpose.simulate.rig import TurntableRig
from lidarpose.simulate.turntable_scene import Scene, draw_scene, without_room


@dataclass(frozen=True)
class SimulationOptions:
    """How a rig is recorded.

    Attributes
    ----------
    photography
        Drawn from the seed unless given.
    lidar
        What the LiDAR does beyond measuring a distance.
    board_shots
        Images of the board in bright light, of each placement.
    with_stripe
        False for a laser that no camera sees.
    lit_stripes
        The stripe images are taken in bright light, so that they show the board too.
    room
        False for plates before nothing.
    noise_free
        No noise of any kind: exact scans; images with the rounding to whole levels alone.
    """

    photography: Photography | None = None
    lidar: LidarBehaviour = field(default_factory=LidarBehaviour)
    board_shots: int = 3
    with_stripe: bool = True
    lit_stripes: bool = False
    room: bool = True
    noise_free: bool = False


@dataclass(frozen=True, eq=False)
class SimulatedSession:
    """A session like a recorded one, and everything that a recorded one does not tell."""

    session: TurntableSession
    rig: TurntableRig
    truth: dict[str, Any]
    photography: Photography
    options: SimulationOptions


def simulate_session(
    rig: TurntableRig, seed: int | None = None, options: SimulationOptions | None = None
) -> SimulatedSession:
    """A session of a rig. Nothing is rendered yet: images and scans are made at each `load`, always the same.

    Parameters
    ----------
    seed
        Decides room, light and noise; the rig's own seed unless given.
    """
    how = options or SimulationOptions()
    the_seed = rig.seed if seed is None else seed
    photography = how.photography or draw_photography(the_seed)
    if how.noise_free:
        photography = replace(photography, noise=False, speckle=0.0, veil=0.0, glare_share=0.0)
        rig = replace(rig, range_sigma_m=0.0)
        how = replace(how, lidar=LidarBehaviour.ideal(how.lidar.sweeps))
    studios = {name: _Studio(rig, name, the_seed, photography, how) for name in rig.T_camera_panel}
    board_images = {
        name: tuple(
            SimulatedImage(f"board/{name}/{k:02d}.png" if name else f"board/{k:02d}.png", studio, k, is_board=True)
            for k in range(how.board_shots)
        )
        for name, studio in studios.items()
    }
    places = []
    for k in range(len(rig)):
        studio = studios[rig.placement[k]]
        stripe = SimulatedImage(f"stripes/{k:03d}.png", studio, k) if how.with_stripe else None
        scan = SimulatedScan(f"scans/{k:03d}.csv", studio, k)
        places.append(TurntablePlace(f"{k:03d}", float(rig.turntable_angle_rad[k]), stripe, scan, rig.placement[k]))
    name = f"simulated {rig.family} {the_seed}"
    session = TurntableSession(name, rig.camera, rig.panels, board_images, tuple(places), rig.lidar)
    truth = describe_truth(rig, the_seed, photography, how)
    return SimulatedSession(session, rig, truth, photography, how)


def draw_photography(seed: int) -> Photography:
    """Lens, sensor and light as a careful person might have set them."""
    rng = np.random.default_rng([seed, 3])
    return Photography(
        blur_px=float(rng.uniform(0.6, 1.1)),
        vignetting=float(rng.uniform(0.1, 0.35)),
        electrons_per_level=float(rng.uniform(25.0, 60.0)),
        read_noise_levels=float(rng.uniform(0.5, 1.5)),
        black_level=float(rng.uniform(0.5, 5.0)),
        board_level=float(rng.uniform(150.0, 215.0)),
        ambient_level=float(rng.uniform(2.0, 12.0)),
        stripe_level=float(rng.uniform(110.0, 190.0)),
        sheet_sigma_m=float(rng.uniform(0.0006, 0.0011)),
        speckle=float(rng.uniform(0.25, 0.55)),
        lamps=int(rng.integers(0, 5)),
    )


class _Studio:
    """One placement of the board, seen by the camera: what all its images share, made once."""

    def __init__(
        self, rig: TurntableRig, placement: str, seed: int, photography: Photography, how: SimulationOptions
    ) -> None:
        self.rig, self.placement, self.seed = rig, placement, seed
        self.photography, self.how = photography, how

    @cached_property
    def scene(self) -> Scene:
        scene = draw_scene(self.rig, self.placement, self.seed)
        return scene if self.how.room else without_room(scene)

    @cached_property
    def view(self) -> View:
        return View.of(self.rig.camera, self.scene)

    @cached_property
    def sensor(self) -> Sensor:
        return Sensor(self.rig.camera, self.photography, self.seed)

    @cached_property
    def bright(self) -> Float32Image:
        """The board images before noise."""
        return self._lit(self.photography.board_level, light=1)

    @cached_property
    def dim(self) -> Float32Image:
        """The stripe images before laser and noise: another, weaker light from elsewhere, or the same bright one."""
        if self.how.lit_stripes:
            return np.asarray(np.float32(0.5) * self.bright)
        rng = np.random.default_rng([self.seed, 6])
        spots = self.view.lamps(rng, self.photography.lamps)
        return self._lit(self.photography.ambient_level, light=2) + self.sensor.optical(spots)

    @cached_property
    def stripe_scale(self) -> float:
        """What turns the laser's light into levels, so that the stripe shows `stripe_level` on white on average.

        From the geometry in the middle of the session: cosine of incidence over distance at both plates' middles, and
        how much lens and pixels widen the stripe there.
        """
        centre = self.rig.T_camera_lidar(len(self.rig) // 2).translation
        light = []
        for surface in self.scene.surfaces[: len(self.rig.panels)]:
            towards = centre - surface.T_camera_surface.translation
            distance = float(np.linalg.norm(towards))
            sheet = self.photography.sheet_sigma_m
            thinned = sheet / (sheet + self.photography.sheet_divergence_rad * distance)
            width_px = self.rig.camera.fx * sheet / float(surface.T_camera_surface.translation[2])
            widened = width_px / np.sqrt(width_px**2 + self.photography.blur_px**2 + 1.0 / 12.0)
            light.append(surface.albedo * abs(towards @ surface.normal) / distance**2 * thinned * widened)
        return self.photography.stripe_level / float(np.mean(light))

    def board_image(self, shot: int) -> GrayImage:
        which = list(self.rig.T_camera_panel).index(self.placement)
        rng = np.random.default_rng([self.seed, 10, which, shot])
        return self.sensor.expose(self.bright, rng)

    def stripe_image(self, place: int) -> GrayImage:
        rng = np.random.default_rng([self.seed, 11, place])
        fan = float(self.rig.beam_angle_rad[0]), float(self.rig.beam_angle_rad[-1])
        laser = self.view.laser_light(self.rig.T_camera_lidar(place), fan, self.photography, rng)
        laser *= np.float32(self.stripe_scale)
        if rng.random() < self.photography.glare_share:
            laser += np.float32(rng.uniform(100.0, 600.0)) * glare(self.rig.camera, rng)
        return self.sensor.expose(self.sensor.optical(laser) + self.dim, rng, long=True)

    def scan(self, place: int) -> Scan:
        rng = np.random.default_rng([self.seed, 12, place])
        rig = self.rig
        return scan_scene(
            self.scene, rig.T_camera_lidar(place), rig.beam_angle_rad, rig.range_sigma_m, self.how.lidar, rng
        )

    def _lit(self, level: float, light: int) -> Float32Image:
        rng = np.random.default_rng([self.seed, 4, light])
        lamp, gradient = draw_lamp(rng)
        radiance = self.view.radiance(lamp, gradient)
        plates = self.view.layers[: len(self.rig.panels)]
        white = np.concatenate([radiance.ravel()[p.pixel[p.albedo > 0.8]] for p in plates])
        return self.sensor.optical(radiance * np.float32(level / float(np.percentile(white, 90))))


@dataclass(frozen=True, eq=False)
class SimulatedImage:
    """An image that is rendered whenever it is loaded."""

    name: str
    studio: _Studio
    index: int
    is_board: bool = False

    def load(self) -> GrayImage:
        return self.studio.board_image(self.index) if self.is_board else self.studio.stripe_image(self.index)


@dataclass(frozen=True, eq=False)
class SimulatedScan:
    """A scan that is made whenever it is loaded."""

    name: str
    studio: _Studio
    index: int

    def load(self) -> Scan:
        return self.studio.scan(self.index)


def describe_truth(rig: TurntableRig, seed: int, photography: Photography, how: SimulationOptions) -> dict[str, Any]:
    """The truth about a session, as JSON holds it: transforms laid out as in a calibration file, and what else was."""
    from dataclasses import asdict

    motion = rig.motion
    return {
        "format": "lidarpose/turntable-truth@1",
        "kind": "turntable",
        "transforms": [
            _transform("camera", "turntable", motion.T_camera_turntable),
            _transform("turntable", "lidar", motion.T_turntable_lidar),
        ],
        "panels": [
            {"placement": name, "panel": k, **_transform("camera", f"panel {k}", T)}
            for name, poses in rig.T_camera_panel.items()
            for k, T in enumerate(poses)
        ],
        "places": [
            {
                "position": f"{k:03d}",
                "turntable_angle_deg": float(np.rad2deg(rig.turntable_angle_rad[k])),
                "placement": rig.placement[k],
                "T_camera_lidar": rig.T_camera_lidar(k).matrix.tolist(),
            }
            for k in range(len(rig))
        ],
        "seed": seed,
        "rig_seed": rig.seed,
        "family": rig.family,
        "margin_m": rig.margin_m,
        "range_sigma_m": rig.range_sigma_m,
        "photography": asdict(photography),
        "lidar": {k: (v if np.isfinite(v) else None) for k, v in asdict(how.lidar).items()},
        "options": {
            "board_shots": how.board_shots,
            "with_stripe": how.with_stripe,
            "lit_stripes": how.lit_stripes,
            "room": how.room,
            "noise_free": how.noise_free,
        },
    }


def _transform(parent: str, child: str, T: Pose) -> dict[str, Any]:
    return {
        "parent": parent,
        "child": child,
        "translation_m": T.translation.tolist(),
        "quaternion_xyzw": T.quaternion_xyzw.tolist(),
        "matrix": T.matrix.tolist(),
    }
