"""`lidarpose measure planes` as a person reads it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import Quality, TurntableCalibration
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import write_calibration
from lidarpose.storage.recording import write_recording
from lidarpose.workflows.self_calibration import axis_in_fan
from tests_support.rooms import sweep_room


def test_angles_stand_with_their_standard_deviations_and_doubts_are_passed_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lidar = axis_in_fan(np.pi / 2.0)
    write_recording(tmp_path / "room", sweep_room(lidar, np.arange(0.0, 360.0, 5.0), np.arange(-90.0, 90.0, 2.0)))
    calibration = TurntableCalibration(
        TurntableMotion(Pose.identity(), lidar), quality=Quality("doubtful", ("the table slipped", "and more"))
    )
    write_calibration(tmp_path / "c.json", calibration)
    assert run(["measure", "planes", str(tmp_path / "room"), str(tmp_path / "c.json")]) == 0
    text = capsys.readouterr().out
    assert text.count(" ± ") >= 6
    assert "verdict is doubtful: the table slipped" in text
    assert "no covariance" in text
    assert run(["scan", str(tmp_path / "room"), str(tmp_path / "c.json"), "-o", str(tmp_path / "room.ply")]) == 0
    assert "verdict is doubtful: the table slipped" in capsys.readouterr().out


def test_a_recording_wants_its_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lidar = axis_in_fan(np.pi / 2.0)
    write_recording(tmp_path / "room", sweep_room(lidar, np.arange(0.0, 90.0, 10.0), np.arange(-90.0, 90.0, 5.0)))
    assert run(["measure", "planes", str(tmp_path / "room")]) == 2
    assert "CALIBRATION" in capsys.readouterr().err
