"""Disks: the diameter against the truth, for all that an instrument may do at an edge."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import Beams, beams_of, chosen_beams, fit_plane_to_ranges, range_noise
from lidarpose.measure.disk import RoundMeasurement, circle_on_plane, measure_round, with_calibration
from lidarpose.model.recording import SweepRecording
from lidarpose.simulate.disk_scene import DiskScene, disk_pose, rig_motion, simulate_disk
from lidarpose.simulate.sweep_scene import BeamModel

MOTION = rig_motion()
SCENE = DiskScene(tilt_deg=20.0, tilt_direction_deg=40.0, field_deg=(8.0, 9.0), beam=BeamModel(spot_m=0.003, rays=61))


def measure(scene: DiskScene, seed: int) -> tuple[RoundMeasurement, SweepRecording]:
    recording = simulate_disk(scene, MOTION, seed=seed)
    beams = beams_of(recording, MOTION)
    return measure_round(beams, range_noise(beams.range_m), "disk")[0], recording


@pytest.mark.parametrize(
    ("change", "limit_mm"),
    [
        (SCENE, 0.08),
        (replace(SCENE, beam=BeamModel(spot_m=0.0002, rays=61)), 0.15),
        (replace(SCENE, beam=BeamModel(spot_m=0.003, mixing="dropped", rays=61, dropout=0.02)), 0.2),
        (replace(SCENE, beam=BeamModel(spot_m=0.002, mixing="strongest", rays=61)), 0.2),
        (replace(SCENE, stand=True, background="near"), 0.1),
        (replace(SCENE, cover=True, beam=BeamModel(spot_m=0.002, shape="gaussian", rays=61)), 0.15),
    ],
    ids=["mean", "thin", "dropped", "strongest", "stand", "cover"],
)
def test_the_diameter_has_no_bias(change: DiskScene, limit_mm: float) -> None:
    disk, _ = measure(change, seed=3)
    error_mm = 1e3 * (disk.diameter_m - change.diameter_m)
    assert abs(error_mm) < limit_mm
    assert abs(error_mm) < 4e3 * disk.sigma_m
    truth = disk_pose(change, MOTION)
    assert np.linalg.norm(disk.centre - truth.translation) < 0.0005
    assert disk.normal @ -truth.rotation[:, 2] > np.cos(np.deg2rad(0.15))
    # The outermost points are what the paper measures; they fall short by more than a beam's step.
    if change.beam.mixing != "strongest":
        assert disk.outermost_diameter_m - change.diameter_m < -0.001


def test_the_calibrations_share_is_that_of_sampled_calibrations() -> None:
    disk, recording = measure(SCENE, seed=5)
    rng = np.random.default_rng(0)
    # The radius and the mounting, badly known: what distorts sizes.
    root = np.diag([1e-3] * 3 + [1e-3] * 3 + [2e-3] + [4e-3] * 3)
    stated = with_calibration(
        disk, lambda change, index: chosen_beams(recording, MOTION, index, change), root @ root.T
    ).calibration_sigma_m
    radii = []
    for _ in range(200):
        change = root @ rng.normal(size=10)
        support = disk.support
        plane = fit_plane_to_ranges(
            support.plane, chosen_beams(recording, MOTION, support.plane_index, change), np.inf
        )[0]
        radii.append(circle_on_plane(chosen_beams(recording, MOTION, support.edge_index, change), plane, support))
    assert stated == pytest.approx(2.0 * np.std(radii), rel=0.15)
    assert stated is not None
    assert 1e-5 < stated < 2e-3


def test_chosen_beams_are_the_grids() -> None:
    recording = simulate_disk(replace(SCENE, field_deg=(1.0, 1.0)), MOTION, seed=1)
    grid = beams_of(recording, MOTION)
    index = np.array([3, 17, 101])
    some = chosen_beams(recording, MOTION, index)
    np.testing.assert_allclose(some.points, grid.at(index).points, atol=1e-12)
    np.testing.assert_allclose(some.origin, grid.at(index).origin, atol=1e-12)


def test_the_plane_of_ranges_is_unbiased_under_noise_along_the_beam() -> None:
    rng = np.random.default_rng(2)
    plane = Plane(np.array([0.5, 0.1, 1.0]), 2.0)
    direction = rng.normal(size=(4000, 3)) * 0.02 + [0.0, 0.0, 1.0]
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    origin = np.zeros_like(direction)
    r = plane.offset / (direction @ plane.normal)
    fits = []
    for _ in range(20):
        beams = Beams(origin, direction, r + rng.normal(0.0, 0.01, r.shape))
        fits.append(fit_plane_to_ranges(plane, beams, 0.01))
    normals = np.array([f[0].normal for f in fits])
    scatter = normals.std(axis=0).max()
    assert np.abs(normals.mean(axis=0) - plane.normal).max() < 4.0 * scatter / np.sqrt(20)
    stated = np.sqrt(fits[0][1][0, 0])
    assert 0.5 * stated < scatter < 2.0 * stated


def test_the_noise_is_measured_in_the_recording() -> None:
    recording = simulate_disk(SCENE, MOTION, seed=1)
    # A tenth of so small a field is edge, which widens the median a little.
    assert range_noise(np.asarray(recording.range_m, dtype=float)) == pytest.approx(0.001, rel=0.1)
