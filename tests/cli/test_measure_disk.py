"""`lidarpose simulate disk` and `lidarpose measure disk`, end to end."""

import json
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.storage.calibration import read_turntable_calibration, write_calibration


def test_measures_what_was_simulated(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "rec"
    assert run(["simulate", "disk", str(folder), "--seed", "4", "--stand"]) == 0
    truth = json.loads((tmp_path / "rec.truth.json").read_text())
    capsys.readouterr()
    assert run(["measure", "disk", str(folder), str(tmp_path / "rec.calibration.json"), "--json"]) == 0
    disk = json.loads(capsys.readouterr().out)
    assert disk["diameter_mm"] == pytest.approx(truth["diameter_mm"], abs=0.15)
    assert 0.0 < disk["sigma_mm"] < 0.1
    assert disk["sigma_parts_mm"]["calibration"] == 0.0
    assert not any("covariance" in remark for remark in disk["remarks"])
    bare = tmp_path / "bare.json"
    write_calibration(bare, TurntableCalibration(read_turntable_calibration(tmp_path / "rec.calibration.json").motion))
    assert run(["measure", "disk", str(folder), str(bare), "--json"]) == 0
    disk = json.loads(capsys.readouterr().out)
    assert disk["sigma_parts_mm"]["calibration"] is None
    assert any("covariance" in remark for remark in disk["remarks"])
    np.testing.assert_allclose(disk["centre_m"], truth["centre_m"], atol=3e-4)
    assert np.dot(disk["normal"], truth["normal"]) > 0.99999


def test_refuses_a_recording_without_calibration(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "rec"
    assert run(["simulate", "disk", str(folder), "--beam-step-deg", "1", "--sweep-step-deg", "1"]) == 0
    assert run(["measure", "disk", str(folder)]) == 2
    assert "calibration" in capsys.readouterr().err


def test_says_so_where_nothing_round_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "rec"
    assert run(["simulate", "disk", str(folder), "--beam-step-deg", "1", "--sweep-step-deg", "1"]) == 0
    assert run(["measure", "disk", str(folder), str(tmp_path / "rec.calibration.json")]) == 1
    assert "round" in capsys.readouterr().err
