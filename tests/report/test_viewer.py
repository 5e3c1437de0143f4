"""`lidarpose view`: what is drawn, the message without the viewer, and a recording with it."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.turntable import TurntableMotion
from lidarpose.report.viewer import layers, looks_along_camera, ramp
from lidarpose.storage.calibration import write_calibration
from lidarpose.storage.clouds import write_cloud


@pytest.fixture
def rig() -> TurntableCalibration:
    rng = np.random.default_rng(2)
    motion = TurntableMotion.from_any_frame(Pose.exp(rng.normal(size=6)), Pose.exp(0.3 * rng.normal(size=6)))
    return TurntableCalibration(motion)


@pytest.fixture
def cloud() -> Cloud:
    points = np.random.default_rng(3).normal(size=(500, 3)).astype(np.float32)
    points[7] = np.nan
    return Cloud(points, {"intensity": np.arange(500, dtype=np.float32)})


def test_layers_of_a_rig_are_where_the_calibration_says(rig: TurntableCalibration, cloud: Cloud) -> None:
    drawn = {layer.name: layer for layer in layers([("a", cloud)], [("b", rig)])}
    assert len(drawn["clouds/a"].points) == 499
    circle = drawn["rigs/b/turntable/circle of the LiDAR"].points[0]
    for degrees in (0, 90, 212):
        at = rig.pose(float(np.deg2rad(degrees))).translation
        assert np.linalg.norm(circle - at, axis=1).min() < 1e-9
    x_axis = drawn["rigs/b/lidar at 0/x"].points[0]
    lidar = rig.pose(0.0)
    np.testing.assert_allclose(x_axis[0], lidar.translation)
    np.testing.assert_allclose(np.cross(x_axis[1] - x_axis[0], lidar.rotation[:, 0]), 0.0, atol=1e-12)


def test_world_calibration_of_the_camera_carries_the_rig(rig: TurntableCalibration) -> None:
    pose = Pose.exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    calibrations: list[tuple[str, TurntableCalibration | WorldCalibration]] = [
        ("w", WorldCalibration(pose, "camera")),
        ("b", rig),
    ]
    drawn = {layer.name: layer for layer in layers([], calibrations)}
    assert not looks_along_camera(calibrations)
    np.testing.assert_allclose(drawn["rigs/b/camera/x"].points[0, 0], pose.translation)
    expected = (pose @ rig.pose(0.0)).translation
    np.testing.assert_allclose(drawn["rigs/b/lidar at 0/y"].points[0, 0], expected)


def test_ramp_rises_in_lightness() -> None:
    colours = ramp(np.linspace(0.0, 1.0, 50)).astype(float)
    lightness = colours @ [0.2126, 0.7152, 0.0722]
    assert np.all(np.diff(lightness) >= -1.0)
    assert lightness[-1] - lightness[0] > 100.0
    assert ramp([np.nan, 1.0]).shape == (2, 3)


def test_view_without_the_extra_names_it(
    tmp_path: Path, cloud: Cloud, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    write_cloud(tmp_path / "cloud.ply", cloud)
    assert run(["view", str(tmp_path / "cloud.ply"), "-o", str(tmp_path / "out.rrd")]) == 2
    message = capsys.readouterr().err
    assert "pip install 'lidarpose[viewer]'" in message
    assert "Traceback" not in message
    assert sorted(p.name for p in tmp_path.iterdir()) == ["cloud.ply"]


@pytest.mark.parametrize("arguments", [[], ["missing.ply"], ["missing.json"], ["a.ply", "-o", "b.html"]])
def test_view_refuses_what_it_cannot_show(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["view", *arguments]) == 2
    assert "Traceback" not in capsys.readouterr().err


@pytest.mark.skipif(importlib.util.find_spec("rerun") is None, reason="rerun-sdk (the extra viewer) is not installed")
def test_view_writes_a_recording(tmp_path: Path, cloud: Cloud, rig: TurntableCalibration) -> None:
    write_cloud(tmp_path / "cloud.ply", cloud)
    write_calibration(tmp_path / "rig.json", rig)
    out = tmp_path / "out.rrd"
    assert run(["view", str(tmp_path / "cloud.ply"), str(tmp_path / "rig.json"), "-o", str(out)]) == 0
    assert out.read_bytes()[:3] == b"RRF"
    assert out.stat().st_size > 6000
