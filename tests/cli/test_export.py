"""The command `export`, against `pose` of the same calibration."""

from __future__ import annotations

import json
from pathlib import Path

import kinpy
import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Quality, TurntableCalibration
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import write_calibration


@pytest.fixture
def calibration(tmp_path: Path) -> Path:
    motion = TurntableMotion.from_any_frame(Pose.exp([0.1, -0.2, 0.3, 1.0, 2.0, 0.5]), Pose.exp([0.05, 0, 0, 1, 0, 1]))
    write_calibration(tmp_path / "calibration.json", TurntableCalibration(motion))
    return tmp_path / "calibration.json"


def test_the_urdf_agrees_with_pose(calibration: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    urdf = tmp_path / "robot.urdf"
    assert run(["export", str(calibration), "--to", "urdf", "-o", str(urdf)]) == 0
    chain = kinpy.build_chain_from_urdf(urdf.read_bytes())
    for angle_deg in (-100.0, 0.5, 190.0):
        capsys.readouterr()
        assert run(["pose", str(calibration), "--angle-deg", str(angle_deg), "--json"]) == 0
        wanted = np.array(json.loads(capsys.readouterr().out)["matrix"])
        found = chain.forward_kinematics({"turntable_joint": np.deg2rad(angle_deg)})["lidar"].matrix()
        np.testing.assert_allclose(found, wanted, rtol=0.0, atol=1e-9)


def test_a_doubtful_calibration_is_exported_with_a_remark(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion = TurntableMotion.from_any_frame(Pose.identity(), Pose.exp([0.05, 0, 0, 1, 0, 1]))
    quality = Quality("doubtful", ("the arc is short",))
    write_calibration(tmp_path / "c.json", TurntableCalibration(motion, quality=quality))
    assert run(["export", str(tmp_path / "c.json"), "--to", "csv", "-o", str(tmp_path / "c.csv")]) == 0
    assert "doubtful: the arc is short" in capsys.readouterr().err


@pytest.mark.parametrize(
    "arguments",
    [
        ["--to", "matlab"],
        ["--to", "urdf", "--angle-deg", "nan"],
        ["--to", "urdf", "--camera", "camera.yaml"],
        ["--to", "kalibr", "--camera", "missing.yaml"],
        ["--to", "urdf", "--lidar-frame", "world"],
    ],
)
def test_wrong_usage_writes_nothing(
    calibration: Path, tmp_path: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["export", str(calibration), *arguments, "-o", str(tmp_path / "out")]) == 2
    assert capsys.readouterr().err.startswith("lidarpose: ")
    assert not (tmp_path / "out").exists()


def test_the_calibration_itself_is_never_replaced(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = calibration.read_bytes()
    same = calibration.parent / "." / calibration.name
    assert run(["export", str(calibration), "--to", "urdf", "-o", str(same)]) == 2
    assert "is read by this command" in capsys.readouterr().err
    assert calibration.read_bytes() == before


def test_an_angle_without_effect_is_said(calibration: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = calibration.with_name("robot.urdf")
    assert run(["export", str(calibration), "--to", "urdf", "-o", str(out), "--angle-deg", "10"]) == 0
    told = capsys.readouterr()
    assert told.out == f"written: {out}\n"
    assert "--angle-deg changes nothing" in told.err
