"""Recordings of a disk in a room, as in the turntable paper's section 3.2: a fan of beams turned about an axis."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.surfaces import Box, Disk, Sheet, Surface
from lidarpose.simulate.sweep_scene import BeamModel, SweepPlan, simulate_sweeps

Background = Literal["wall", "near", "none"]


@dataclass(frozen=True)
class DiskScene:
    """A disk before a background.

    Attributes
    ----------
    distance_m
        From the LiDAR to the disk's centre.
    tilt_deg
        Angle between the disk's normal and the direction to the LiDAR.
    tilt_direction_deg
        About which direction across the line of sight it is tilted.
    aside_m
        Where the centre is off the middle of the field, right and down.
    background
        A wall 0.6 m behind; a wall 60 mm behind; or nothing.
    stand
        A post below the disk, 30 mm wide, its front flush with the disk.
    cover
        A post before the disk, 20 mm wide.
    """

    diameter_m: float = 0.140
    distance_m: float = 1.5
    tilt_deg: float = 0.0
    tilt_direction_deg: float = 0.0
    aside_m: tuple[float, float] = (0.0, 0.0)
    background: Background = "wall"
    stand: bool = False
    cover: bool = False
    beam: BeamModel = field(default_factory=BeamModel)
    beam_step_deg: float = 1.0 / 12.0
    sweep_step_deg: float = 0.05
    field_deg: tuple[float, float] = (30.0, 40.0)


def rig_motion(radius_m: float = 0.05) -> TurntableMotion:
    """A turntable with an upright axis below the camera; the LiDAR's scan plane is upright, its beams look forward.

    Nothing in it is parallel to an axis of another frame.
    """
    # z of the turntable is up (camera -y); its x looks forward (camera z).
    upright = np.column_stack([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    T_camera_turntable = Pose(exp_so3([0.01, 0.02, -0.015]) @ upright, np.array([0.12, 0.08, -0.05]))
    # x of the LiDAR forward, y up, so z to the right.
    fan = np.column_stack([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return TurntableMotion(T_camera_turntable, Pose(exp_so3([0.01, -0.02, 0.03]) @ fan, np.array([radius_m, 0.0, 0.0])))


def disk_pose(scene: DiskScene, motion: TurntableMotion) -> Pose:
    """T_camera_disk; z points away from the LiDAR."""
    T = motion.pose(0.0)
    forward, up = T.rotation[:, 0], T.rotation[:, 1]
    right = np.cross(forward, up)
    centre = T.translation + scene.distance_m * forward + scene.aside_m[0] * right - scene.aside_m[1] * up
    sight = (centre - T.translation) / np.linalg.norm(centre - T.translation)
    across = right - (right @ sight) * sight
    facing = nearest_rotation(np.column_stack([across, np.cross(sight, across), sight]))
    about = np.deg2rad(scene.tilt_direction_deg)
    tilt = exp_so3(np.deg2rad(scene.tilt_deg) * np.array([np.cos(about), np.sin(about), 0.0]))
    return Pose(facing @ tilt, centre)


def disk_surfaces(scene: DiskScene, motion: TurntableMotion) -> list[Surface]:
    """The disk and what stands around it, in the camera frame."""
    T_camera_disk = disk_pose(scene, motion)
    T = motion.pose(0.0)
    # Frame of the room at the disk: x right, y down, z away from the LiDAR.
    forward, down = T.rotation[:, 0], -T.rotation[:, 1]
    room = Pose(nearest_rotation(np.column_stack([np.cross(down, forward), down, forward])), T_camera_disk.translation)
    surfaces: list[Surface] = [Disk(T_camera_disk, 0.5 * scene.diameter_m, 0.9)]
    if scene.background != "none":
        behind = (
            0.6 if scene.background == "wall" else 0.06 + 0.5 * scene.diameter_m * np.sin(np.deg2rad(scene.tilt_deg))
        )
        turned = exp_so3([0.0, np.deg2rad(8.0), 0.0]) if scene.background == "wall" else np.eye(3)
        surfaces.append(Sheet(room @ Pose(turned, np.array([0.0, 0.0, behind])), reflectivity=0.9))
    if scene.stand:
        height = 0.6
        post = np.array([0.0, 0.5 * height + 0.42 * scene.diameter_m, 0.5 * 0.03 + 0.001])
        surfaces.append(Box(T_camera_disk @ Pose(np.eye(3), post), (0.03, height, 0.03), 0.6))
    if scene.cover:
        post = np.array([0.25 * scene.diameter_m, 0.0, -0.15])
        surfaces.append(Box(room @ Pose(np.eye(3), post), (0.02, 2.0, 0.02), 0.6))
    return surfaces


def simulate_disk(scene: DiskScene, motion: TurntableMotion, *, seed: int) -> SweepRecording:
    """A recording of the scene whose grid of beams lies anyhow to the disk."""
    rng = np.random.default_rng(seed)
    half_turn, half_fan = 0.5 * scene.field_deg[0], 0.5 * scene.field_deg[1]
    readings = _steps(half_turn, scene.sweep_step_deg, rng)
    beams = _steps(half_fan, scene.beam_step_deg, rng)
    plan = SweepPlan(motion, readings, beams, scene.beam)
    return simulate_sweeps(plan, disk_surfaces(scene, motion), seed=seed + 1)


def _steps(half: float, step: float, rng: np.random.Generator) -> FloatArray:
    return np.asarray(np.arange(-half, half, step) + rng.uniform(0.0, step))
