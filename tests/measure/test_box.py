"""A carton's edges and planes against the truth."""

import json
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation
from lidarpose.measure.beams import Beams, beams_of, chosen_beams
from lidarpose.measure.box import BoxMeasurement, edge_lengths, measure_box, with_calibration
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.simulate.disk_scene import rig_motion
from lidarpose.simulate.surfaces import Box, Sheet, Surface
from lidarpose.simulate.sweep_scene import BeamModel, SweepPlan, simulate_sweeps
from lidarpose.storage.calibration import write_calibration
from lidarpose.storage.recording import write_recording
from lidarpose.workflows.measuring import view_of_recording
from tests_support.moved_calibrations import drawn, full_calibration, stated

MOTION = rig_motion()
CALIBRATION = TurntableCalibration(MOTION)
SIZE = (0.3, 0.15, 0.2)
"""Width, height and depth of the carton."""


def carton(*, floor: bool, seed: int = 0) -> SweepRecording:
    """A carton 1.6 m away, seen from above at a corner, before a wall and perhaps on a floor."""
    rng = np.random.default_rng(seed)
    T = MOTION.pose(0.0)
    forward, down = T.rotation[:, 0], -T.rotation[:, 1]
    room = Pose(
        nearest_rotation(np.column_stack([np.cross(down, forward), down, forward])), T.translation + 1.6 * forward
    )
    box = room @ Pose(exp_so3([np.deg2rad(30.0), 0.0, 0.0]) @ exp_so3([0.0, np.deg2rad(40.0), 0.0]), np.zeros(3))
    surfaces: list[Surface] = [Box(box, SIZE, 0.8), Sheet(room @ Pose(np.eye(3), np.array([0.0, 0.0, 1.0])))]
    if floor:
        below = Pose(exp_so3([np.pi / 2.0, 0.0, 0.0]), np.array([0.0, 0.5 * SIZE[1], 0.0]))
        surfaces.append(Sheet(box @ below, (2.0, 2.0), reflectivity=0.6))
    readings = np.arange(-10.0, 10.0, 0.07) + rng.uniform(0.0, 0.07)
    beams = np.arange(-9.0, 9.0, 1.0 / 12.0) + rng.uniform(0.0, 0.08)
    plan = SweepPlan(MOTION, readings, beams, BeamModel(spot_m=0.002, rays=37))
    return simulate_sweeps(plan, surfaces, seed=seed)


@pytest.mark.parametrize("floor", [False, True])
def test_edges_of_a_carton(floor: bool) -> None:
    box = measure_box(beams_of(carton(floor=floor), MOTION), 0.001)
    lengths_mm = 1e3 * np.array([e.length_m for e in box.edges])
    error = lengths_mm - 1e3 * np.sort(SIZE)[::-1]
    assert np.abs(error).max() < 0.5
    assert np.abs(error / [1e3 * e.sigma_m for e in box.edges]).max() < 5.0
    assert len(box.face_points) == 3
    np.testing.assert_allclose(box.angles_deg, 90.0, atol=0.1)
    assert ("face", "support") in [e.by for e in box.edges] or not floor


@cache
def carton_and_box() -> tuple[SweepRecording, BoxMeasurement]:
    recording = carton(floor=True)
    return recording, measure_box(beams_of(recording, MOTION), 0.001)


def test_the_calibrations_share_is_that_of_sampled_calibrations() -> None:
    """Of all its parameters: the cloud is put together anew by each calibration, and the faces' beams are the same."""
    calibration = full_calibration(MOTION)
    true, measured = carton_and_box()
    recording = stated(true, calibration)
    view = view_of_recording(recording, calibration)
    assert view.moved is not None
    assert view.covariance is not None
    box = with_calibration(measured, view.moved, view.covariance)
    lengths = []
    for off in drawn(calibration, 40, seed=0):
        beams = view_of_recording(recording, off).beams

        def again(_: np.ndarray, index: np.ndarray, beams: Beams = beams) -> Beams:
            return beams.at(index)

        lengths.append(edge_lengths(box, again, np.zeros(14)))
    shares = [e.calibration_sigma_m or 0.0 for e in box.edges]
    np.testing.assert_allclose(shares, np.std(lengths, axis=0, ddof=1), rtol=0.05)
    assert all(e.sigma_m > e.beams_sigma_m for e in box.edges)


def test_the_calibrations_share_against_measuring_anew() -> None:
    """The whole measurement again with a calibration that is a little off."""
    recording, box = carton_and_box()
    change = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 4e-3, 0.01, -0.008, 0.01])
    index = np.arange(recording.range_m.size)
    grid = chosen_beams(recording, CALIBRATION, index, change)
    shape = recording.range_m.shape
    off = Beams(grid.origin.reshape(*shape, 3), grid.direction.reshape(*shape, 3), grid.range_m.reshape(shape))
    anew = [e.length_m for e in measure_box(off, 0.001).edges]

    def moved(change: np.ndarray, index: np.ndarray) -> Beams:
        return chosen_beams(recording, CALIBRATION, index, change)

    expected = edge_lengths(box, moved, change) - edge_lengths(box, moved, np.zeros(10))
    found = np.array(anew) - [e.length_m for e in box.edges]
    assert np.abs(expected).max() > 2e-4
    np.testing.assert_allclose(found, expected, atol=1.5e-4)


def test_a_room_corner_is_no_box() -> None:
    """Three faces at right angles that point inward."""
    T = MOTION.pose(0.0)
    forward, down = T.rotation[:, 0], -T.rotation[:, 1]
    frame = nearest_rotation(np.column_stack([np.cross(down, forward), down, forward]))
    room = Pose(frame @ exp_so3([0.5, 0.0, 0.0]) @ exp_so3([0.0, 0.7, 0.0]), T.translation + 0.5 * forward)
    inside = Box(room, (1.5, 1.5, 1.5))

    class Inside:
        reflectivity = 1.0

        def ranges(self, origins: np.ndarray, directions: np.ndarray) -> np.ndarray:
            far = 10.0
            return far - inside.ranges(origins + far * directions, -directions)

    plan = SweepPlan(MOTION, np.arange(-15.0, 15.0, 0.2), np.arange(-15.0, 15.0, 0.2), BeamModel(rays=9))
    recording = simulate_sweeps(plan, [Inside()], seed=0)
    with pytest.raises(UndeterminedError):
        measure_box(beams_of(recording, MOTION), 0.001)


def test_box_and_planes_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    calibration = full_calibration(MOTION)
    write_recording(tmp_path / "rec", stated(carton(floor=True), calibration))
    write_calibration(tmp_path / "cal.json", calibration)
    arguments = [str(tmp_path / "rec"), str(tmp_path / "cal.json"), "--json"]
    assert run(["measure", "box", *arguments]) == 0
    box = json.loads(capsys.readouterr().out)
    np.testing.assert_allclose(box["edges_mm"], [300.0, 200.0, 150.0], atol=0.5)
    assert min(np.array(box["sigma_mm"]) - box["calibration_sigma_mm"]) > 0.0
    # A factor on ranges alone is known to 0.05 %, turntable and beam angles to 0.2 %.
    assert 0.1 < max(box["calibration_sigma_mm"]) < 2.0
    assert run(["measure", "planes", *arguments]) == 0
    found = json.loads(capsys.readouterr().out)
    # Three faces and the floor; the wall is hidden by it.
    assert len(found["planes"]) == 4
    angles = np.array(found["angles_deg"])
    normals = np.array([p["normal"] for p in found["planes"]])
    faces = [int(np.argmax(normals @ n)) for n in np.array(box["face_normals"])]
    for k, i in enumerate(faces):
        for j in faces[k + 1 :]:
            assert angles[i, j] == pytest.approx(90.0, abs=0.2)
    for p in found["planes"]:
        assert 0.2 < p["rms_mm"] < 1.3
        assert abs(np.linalg.norm(p["normal"]) - 1.0) < 1e-9
