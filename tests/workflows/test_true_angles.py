"""Readings that are off by a factor: clouds, beams and files take them as the calibration says."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import read_turntable_calibration, write_calibration
from lidarpose.workflows.measuring import view_of_recording
from lidarpose.workflows.scanning import assemble_scan

PLAIN = TurntableMotion(
    Pose.exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]), Pose(exp_so3([0.3, 0.2, 0.1]), np.array([0.05, 0.0, 0.0]))
)
SCALED = replace(PLAIN, reading_scale=1.02, reading_origin_rad=0.7)
RANGES = np.random.default_rng(3).uniform(1.0, 3.0, (40, 30)).astype(np.float32)


@pytest.mark.parametrize("per_beam", [False, True])
def test_clouds_and_beams_are_those_of_the_true_angles(per_beam: bool) -> None:
    readings = np.linspace(20.0, 60.0, 40)
    if per_beam:
        readings = readings[:, None] + np.linspace(0.0, 0.5, 30)
    recording = SweepRecording("r", readings, np.linspace(-45.0, 225.0, 30), RANGES)
    calibration = TurntableCalibration(SCALED)
    (cloud,) = assemble_scan(recording, calibration, points_per_part=10**9)
    beams = view_of_recording(recording, calibration).beams
    expected = []
    for i in range(40):
        for j in range(30):
            reading = np.deg2rad(readings[i, j] if per_beam else readings[i])
            theta = np.deg2rad(recording.beam_angle_deg[j])
            point = RANGES[i, j] * np.array([np.cos(theta), np.sin(theta), 0.0])
            expected.append(SCALED.pose(float(reading)) @ point)
    np.testing.assert_allclose(cloud.points, expected, atol=2e-6)
    met = (beams.origin + beams.direction * beams.range_m[..., None]).reshape(-1, 3)
    np.testing.assert_allclose(met, expected, atol=1e-6)


def test_the_factor_survives_the_file_and_other_readers_are_right_amid_the_arc(tmp_path: Path) -> None:
    write_calibration(tmp_path / "c.json", TurntableCalibration(SCALED))
    again = read_turntable_calibration(tmp_path / "c.json")
    for reading in (-1.0, 0.7, 2.0):
        assert max(again.pose(reading).distance(SCALED.pose(reading))) < 1e-12
    assert max(PLAIN.pose(0.7).distance(again.pose(0.7))) < 1e-12
    assert again.pose(2.0).distance(PLAIN.pose(2.0))[1] == pytest.approx(0.02 * 1.3)


def test_the_derivatives_are_those_of_the_scaled_motion() -> None:
    h = 1e-6
    more, less = (replace(SCALED, reading_scale=SCALED.reading_scale + s * h) for s in (1.0, -1.0))
    numeric = (more.pose(2.0).minus(SCALED.pose(2.0)) - less.pose(2.0).minus(SCALED.pose(2.0))) / (2.0 * h)
    np.testing.assert_allclose(SCALED.pose_by_scale(2.0), numeric, atol=1e-8)
    np.testing.assert_allclose(SCALED.pose_jacobian(2.0), PLAIN.pose_jacobian(SCALED.true_angle(2.0)))


@pytest.mark.parametrize(
    "readings", ['{"scale": 0, "origin_rad": 0}', '{"scale": 1.01}', '{"scale": 1, "origin_rad": 1e99}']
)
def test_a_factor_that_cannot_be_is_refused(tmp_path: Path, readings: str) -> None:
    write_calibration(tmp_path / "c.json", TurntableCalibration(SCALED))
    document = json.loads((tmp_path / "c.json").read_text())
    document["readings"] = json.loads(readings)
    (tmp_path / "c.json").write_text(json.dumps(document))
    with pytest.raises(InputError, match="readings"):
        read_turntable_calibration(tmp_path / "c.json")
