"""A room of five unequal walls, a sloping ceiling and clutter: nothing in it is square, so that no right angle helps.

Rays are cast one by one by `lidarpose.simulate`; nothing here knows how the mounting is estimated.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.surfaces import Box, Sheet, Surface
from lidarpose.simulate.sweep_scene import BeamModel, SweepPlan, simulate_sweeps


def wall(azimuth_deg: float, away_m: float, lean_deg: float = 0.0) -> Sheet:
    """An unbounded wall whose normal points at this azimuth, its foot `away_m` off, leaning outwards."""
    turn = exp_so3([0.0, 0.0, np.radians(azimuth_deg)]) @ exp_so3([0.0, np.radians(90.0 - lean_deg), 0.0])
    return Sheet(Pose(turn, turn @ np.array([0.0, 0.0, away_m])))


def flat(height_m: float, slope_deg: tuple[float, float]) -> Sheet:
    """A floor or ceiling."""
    return Sheet(Pose(exp_so3(np.radians([slope_deg[0], slope_deg[1], 0.0])), np.array([0.0, 0.0, height_m])))


ROOM: tuple[Surface, ...] = (
    flat(-1.1, (0.0, 0.0)),
    flat(1.6, (3.0, -2.0)),
    wall(4.0, 3.1),
    wall(83.0, 2.2, 2.0),
    wall(178.0, 2.7),
    wall(231.0, 3.4, -1.5),
    wall(279.0, 1.9),
    Box(Pose(exp_so3([0.0, 0.0, 0.4]), np.array([1.8, -0.9, -0.7])), (0.5, 0.7, 0.8)),
    Box(Pose(exp_so3([0.0, 0.0, 1.1]), np.array([-1.6, 1.0, -0.85])), (0.6, 0.4, 0.5)),
)


def mounting(tilt_deg: tuple[float, float], shift_m: tuple[float, float], start: Pose) -> Pose:
    """T_table_lidar that is off a start by tilts about the table's x and y, and by shifts along them."""
    rotation = exp_so3(np.radians([tilt_deg[0], tilt_deg[1], 0.0])) @ start.rotation
    return Pose(rotation, start.translation + [*shift_m, 0.0])


def sweep_room(
    T_table_lidar: Pose,
    readings_deg: FloatArray,
    beams_deg: FloatArray,
    *,
    noise_m: float = 0.005,
    seed: int = 0,
    surfaces: tuple[Surface, ...] = ROOM,
    angle_factor: float = 1.0,
) -> SweepRecording:
    """A recording of the room; `angle_factor` is what true beam angles are of the ones that the recording states."""
    # Moved along and turned about the axis the table's frame becomes the fixed one; rooms are where they were.
    motion = TurntableMotion.from_any_frame(Pose.identity(), T_table_lidar)
    beam = BeamModel(spot_m=0.0, range_sigma_m=noise_m, rays=1)
    plan = SweepPlan(motion, readings_deg, beams_deg * angle_factor, beam)
    recording = simulate_sweeps(plan, surfaces, seed=seed, with_intensity=False)
    return replace(recording, beam_angle_deg=beams_deg)
