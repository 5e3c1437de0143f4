"""A small turntable rig with exact observations, made without the package's simulator or estimators."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.camera import Camera
from lidarpose.model.observation import (
    PanelCorners,
    PlaceObservation,
    ScanLine,
    StripePoints,
    TurntableObservations,
)
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion

CAMERA = Camera(
    1624,
    1234,
    np.array([[2757.4, 0, 831.6], [0, 2758.6, 638.9], [0, 0, 1]]),
    "plumb_bob",
    np.array([-0.076, 0.371, 0.0, 0.0]),
)
PANEL = Panel(20, 14, 0.02)


@dataclass(frozen=True)
class Rig:
    """A V board, a LiDAR on a turntable, the readings; everything known."""

    motion: TurntableMotion
    panels_camera: tuple[Pose, Pose]
    readings_rad: FloatArray
    beams_rad: FloatArray

    def observe(
        self, seed: int = 0, corner_px: float = 0.0, stripe_px: float = 0.0, range_m: float = 0.0
    ) -> TurntableObservations:
        rng = np.random.default_rng(seed)
        corners = []
        for pose in self.panels_camera:
            pixels = CAMERA.project(pose @ PANEL.corners_panel())
            noisy = pixels + rng.normal(size=pixels.shape) * corner_px
            corners.append(PanelCorners(PANEL.corners_panel(), noisy, np.full(len(pixels), corner_px or 0.05)))
        places = []
        for k, reading in enumerate(self.readings_rad):
            T = self.motion.pose(float(reading))
            stripes, lines = {}, {}
            for key, panel in enumerate(self.panels_camera):
                hits = on_panel(T, panel, self.beams_rad)
                inside = np.isfinite(hits)
                line = ScanLine(self.beams_rad[inside], hits[inside], np.full(inside.sum(), range_m or 1e-3))
                points = T @ np.column_stack([line.points_lidar(), np.zeros(len(line))])
                pixels = CAMERA.project(points)
                along = np.gradient(pixels, axis=0)
                normals = np.column_stack([-along[:, 1], along[:, 0]]) / np.linalg.norm(along, axis=1)[:, None]
                noise = rng.normal(size=len(pixels)) * stripe_px
                stripes[key] = StripePoints(
                    pixels + noise[:, None] * normals, normals, np.full(len(pixels), stripe_px or 0.1)
                )
                lines[key] = ScanLine(line.angle_rad, line.range_m + rng.normal(size=len(line)) * range_m, line.sigma_m)
            places.append(PlaceObservation(f"{k:03d}", float(reading), stripes, lines))
        return TurntableObservations(CAMERA, (PANEL, PANEL), {"": tuple(corners)}, tuple(places))


def on_panel(T_camera_lidar: Pose, T_camera_panel: Pose, beams_rad: FloatArray) -> FloatArray:
    """Ranges (N,) at which beams hit a panel (the grid and one square around it), NaN elsewhere."""
    T = T_camera_panel.inverse() @ T_camera_lidar
    directions = T.rotate(np.column_stack([np.cos(beams_rad), np.sin(beams_rad), np.zeros_like(beams_rad)]))
    with np.errstate(divide="ignore"):
        ranges = -T.translation[2] / directions[:, 2]
    with np.errstate(invalid="ignore"):
        x, y, _ = (T.translation + ranges[:, None] * directions).T
        inside = (x > -0.02) & (x < 0.40) & (y > -0.02) & (y < 0.28) & (ranges > 0)
    return np.where(inside, ranges, np.nan)


def make_rig(
    seed: int = 0,
    *,
    places: int = 12,
    arc_deg: float = 21.5,
    first_deg: float = 0.0,
    step_order: int = 1,
    radius_m: float = 0.05,
    roll_deg: float = 0.0,
    upside_down: bool = False,
    axis_flipped: bool = False,
    tilt_deg: float = 3.0,
    dihedral_deg: float = 120.0,
    across: bool = False,
    symmetric: bool = False,
) -> Rig:
    """A rig about as in the paper; `across` has the scan plane perpendicular to the axis, fold and axis parallel.

    The board's fold is the camera's x axis (or y, if `across`) 1.5 m away; panels rise from it towards the camera.
    With `symmetric` the board is its own mirror image in a plane across the axis, as the scan plane is.
    """
    rng = np.random.default_rng(seed)
    wobble = Pose.exp(rng.normal(size=6) * [0.02, 0.02, 0.05, 0.03, 0.03, 0.03] * (not symmetric))
    tilt_deg = 0.0 if symmetric else tilt_deg
    half = np.deg2rad(dihedral_deg) / 2
    sides = []
    for sign in (1.0, -1.0):
        # Panel x along the fold, y away from it; the panel's normal away from the camera.
        y_axis = np.array([0.0, sign * np.sin(half), -np.cos(half)])
        x_axis = np.array([sign, 0.0, 0.0])
        rotation = np.column_stack([x_axis, y_axis, np.cross(x_axis, y_axis)])
        origin = np.array([-0.19 * sign, 0.0, 1.5]) + 0.03 * y_axis
        sides.append(Pose(rotation, origin))
    roll = Pose(exp_so3([0, 0, np.pi / 2 * across + np.deg2rad(roll_deg)]), np.zeros(3))
    panels = tuple(wobble @ roll @ side for side in sides)
    # The axis stands upright beside the camera; the LiDAR looks at the board's middle at mid-arc.
    axis = exp_so3(np.deg2rad(tilt_deg) * rng.normal(size=3)) @ np.array([0.0, -1.0 if not axis_flipped else 1.0, 0.0])
    target = (panels[0].translation + panels[1].translation) / 2
    base = np.array([0.15, 0.05, 0.62])
    towards = (target - base) / np.linalg.norm(target - base)
    z = np.cross(axis, towards) if not across else axis
    z = z / np.linalg.norm(z)
    if upside_down:
        z = -z
    x = np.cross(np.cross(z, towards), z)
    x = x / np.linalg.norm(x)
    R_middle = exp_so3(0.02 * rng.normal(size=3) * (not symmetric)) @ np.column_stack([x, np.cross(z, x), z])
    middle = np.deg2rad(first_deg + arc_deg / 2)
    u = np.cross(axis, rng.normal(size=3))
    T_camera_table = Pose(_about(axis), base - radius_m * u / np.linalg.norm(u))
    T_table_lidar = Pose.rot_z(-middle) @ T_camera_table.inverse() @ Pose(R_middle, base)
    motion = TurntableMotion.from_any_frame(T_camera_table, T_table_lidar)
    readings = np.deg2rad(first_deg + np.linspace(0.0, arc_deg, places))[::step_order]
    return Rig(motion, (panels[0], panels[1]), readings, np.deg2rad(np.arange(-90.0, 90.0, 0.0833)))


def _about(axis: FloatArray) -> FloatArray:
    u = np.cross(axis, [0.3, 0.1, 0.9])
    u = u / np.linalg.norm(u)
    return np.column_stack([u, np.cross(axis, u), axis])


@pytest.fixture(scope="session")
def rig_maker() -> Callable[..., Rig]:
    """The function `make_rig`."""
    return make_rig
