"""Beams recovered from plain clouds, against the beams that made them."""

from dataclasses import replace

import numpy as np

from lidarpose.geometry.se3 import Pose
from lidarpose.measure.assemble import assemble
from lidarpose.measure.beams import Beams, range_noise
from lidarpose.measure.cloud_beams import beams_of_cells, beams_of_rings, recording_from_cloud
from lidarpose.measure.disk import measure_round
from lidarpose.model.recording import SweepRecording
from lidarpose.simulate.disk_scene import DiskScene, rig_motion, simulate_disk
from lidarpose.simulate.surfaces import Sheet

MOTION = rig_motion()


def cloud_of(recording: SweepRecording) -> np.ndarray:
    points = assemble(recording, MOTION).reshape(-1, 3)
    points = points[np.isfinite(points[:, 0])].astype(float)
    return np.random.default_rng(0).permutation(points)


def test_the_motion_gives_back_the_recording() -> None:
    scene = replace(DiskScene(), field_deg=(3.0, 4.0), beam=replace(DiskScene().beam, dropout=0.05))
    recording = simulate_disk(scene, MOTION, seed=1)
    again = recording_from_cloud(cloud_of(recording), MOTION)
    assert again is not None
    np.testing.assert_allclose(again.turntable_angle_deg, recording.turntable_angle_deg, atol=1e-4)
    np.testing.assert_allclose(again.beam_angle_deg, recording.beam_angle_deg, atol=1e-4)
    np.testing.assert_allclose(again.range_m, recording.range_m, atol=1e-6)


def test_another_motion_does_not_fit() -> None:
    recording = simulate_disk(replace(DiskScene(), field_deg=(3.0, 4.0)), MOTION, seed=1)
    moved = replace(MOTION, T_camera_turntable=Pose.exp([0, 0, 0, 0.1, 0, 0.1]) @ MOTION.T_camera_turntable)
    assert recording_from_cloud(cloud_of(recording), moved) is None


def ring_cloud(sheet: Sheet, wall: Sheet, sigma: float) -> tuple[np.ndarray, np.ndarray]:
    """A LiDAR with 64 rings and azimuths 0.2 degrees apart at the origin, its rings out of step."""
    rng = np.random.default_rng(0)
    elevation = np.deg2rad(np.linspace(-6.0, 6.0, 64))[:, None]
    azimuth = np.deg2rad(np.arange(-20.0, 20.0, 0.2) + rng.uniform(0.0, 0.2, (64, 1)))
    d = np.stack(
        [np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation) + 0 * azimuth], -1
    )
    flat = d.reshape(-1, 3)
    r = np.minimum(sheet.ranges(np.zeros_like(flat), flat), wall.ranges(np.zeros_like(flat), flat))
    r = r + rng.normal(0.0, sigma, r.shape)
    ring = np.repeat(np.arange(64)[::-1], azimuth.shape[1])
    keep = rng.permutation(len(flat))
    return (r[:, None] * flat)[keep], ring[keep]


def facing(x: float) -> Pose:
    return Pose(np.column_stack([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]), np.array([x, 0.0, 0.0]))


def test_round_holes_in_a_ring_cloud() -> None:
    holes = ((-0.3, 0.1, 0.12), (0.3, 0.1, 0.12))
    points, ring = ring_cloud(Sheet(facing(3.0), (0.6, 0.3), holes), Sheet(facing(5.0)), 0.003)
    for given in (ring, None):
        beams = beams_of_rings(points, given, None)
        assert beams is not None
        assert np.count_nonzero(np.isfinite(beams.range_m)) == len(points)
        found = measure_round(beams, range_noise(beams.range_m), "hole")
        assert len(found) == 2
        for hole in found:
            assert abs(hole.diameter_m - 0.24) < 4.0 * hole.sigma_m
            # Nothing tells how wide the spots are: at 3 m commonly 6 to 22 mm.
            assert 0.003 < hole.sigma_m < 0.012
        centres = sorted((m.centre for m in found), key=lambda c: c[1])
        np.testing.assert_allclose(centres, [[3.0, -0.3, 0.1], [3.0, 0.3, 0.1]], atol=0.003)


def test_a_cloud_without_beams_still_gives_a_size() -> None:
    scene = DiskScene(field_deg=(8.0, 9.0), tilt_deg=10.0)
    points = cloud_of(simulate_disk(scene, MOTION, seed=2))
    beams = beams_of_cells(points)
    assert beams is not None
    disk = measure_round(beams, range_noise(beams.range_m), "disk", sees_behind=False)[0]
    assert abs(disk.diameter_m - scene.diameter_m) < 0.003
    assert 0.002 < disk.sigma_m < 0.008


def test_a_random_cloud_has_no_rings() -> None:
    points = np.random.default_rng(0).normal(size=(5000, 3)) + [5.0, 0.0, 0.0]
    assert beams_of_rings(points, None, None) is None
    assert isinstance(beams_of_cells(points), Beams | None)
