"""Disks: the diameter against the truth, for all that an instrument may do at an edge."""

from dataclasses import replace

import numpy as np
import pytest

from lidarpose.geometry.planes import Plane
from lidarpose.measure.beams import Beams, beams_of, fit_plane_to_ranges, range_noise
from lidarpose.measure.disk import RoundMeasurement, circle_on_plane, measure_round, with_calibration
from lidarpose.simulate.disk_scene import DiskScene, disk_pose, rig_motion, simulate_disk
from lidarpose.simulate.sweep_scene import BeamModel
from lidarpose.workflows.measuring import measure_disk, view_of_recording
from tests_support.moved_calibrations import drawn, full_calibration, moved, stated

MOTION = rig_motion()
SCENE = DiskScene(tilt_deg=20.0, tilt_direction_deg=40.0, field_deg=(8.0, 9.0), beam=BeamModel(spot_m=0.003, rays=61))


def measure(scene: DiskScene, seed: int) -> RoundMeasurement:
    recording = simulate_disk(scene, MOTION, seed=seed)
    beams = beams_of(recording, MOTION)
    return measure_round(beams, range_noise(beams.range_m), "disk")[0]


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
    disk = measure(change, seed=3)
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
    """Of all its parameters: the cloud is put together anew by each calibration, and the edge's beams are the same."""
    calibration = full_calibration(MOTION)
    scene = replace(SCENE, sweep_step_deg=0.1, beam_step_deg=0.125)
    recording = stated(simulate_disk(scene, MOTION, seed=5), calibration)
    view = view_of_recording(recording, calibration)
    disk = measure_disk(view)[0]
    support, radii = disk.support, []
    for off in drawn(calibration, 40, seed=0):
        beams = view_of_recording(recording, off).beams
        plane = fit_plane_to_ranges(support.plane, beams.at(support.plane_index), np.inf)[0]
        radii.append(circle_on_plane(beams.at(support.edge_index), plane, support))
    share = disk.calibration_sigma_m
    assert share == pytest.approx(2.0 * np.std(radii, ddof=1), rel=0.03)
    assert view.moved is not None
    assert view.covariance is not None
    of_motion = np.zeros((14, 14))
    of_motion[:10, :10] = view.covariance[:10, :10]
    without = with_calibration(disk, view.moved, of_motion).calibration_sigma_m
    assert share is not None
    assert without is not None
    assert 0.0 < without < 0.5 * share


@pytest.mark.parametrize("per_beam", [False, True])
def test_chosen_beams_are_the_grids_of_a_moved_calibration(per_beam: bool) -> None:
    recording = simulate_disk(replace(SCENE, field_deg=(1.0, 1.0)), MOTION, seed=1)
    if per_beam:
        readings = recording.turntable_angle_deg[:, None] + np.linspace(0.0, 0.1, recording.beams)
        recording = replace(recording, turntable_angle_deg=readings)
    calibration = full_calibration(MOTION)
    change = 1e-3 * np.random.default_rng(2).normal(size=14)
    expected = view_of_recording(recording, moved(calibration, change)).beams
    view = view_of_recording(recording, calibration)
    index = np.array([3, 17, 101])
    assert view.moved is not None
    assert view.shifts is not None
    some = view.moved(change, index)
    np.testing.assert_allclose(some.points, expected.at(index).points, atol=3e-7)
    np.testing.assert_allclose(some.origin, expected.at(index).origin, atol=1e-12)
    np.testing.assert_allclose(some.direction, expected.at(index).direction, atol=1e-12)
    for k, by in enumerate(np.moveaxis(view.shifts(index), 2, 0)):
        step = 1e-5 * np.eye(14)[k]
        # Derivatives of points take one reading a sweep where there is one a beam.
        numeric = (view.moved(step, index).points - view.moved(-step, index).points) / 2e-5
        np.testing.assert_allclose(by, numeric, atol=1e-3 if per_beam else 1e-7)


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
