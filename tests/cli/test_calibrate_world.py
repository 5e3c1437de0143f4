"""The world branch of calibrate, from folder to calibration file."""

import json
from pathlib import Path

import pytest

from lidarpose.cli.calibrate_world import calibrate_world_session, inspect_world_session
from lidarpose.cli.main import run
from lidarpose.errors import InputError, UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.storage.calibration import read_world_calibration


def test_simulate_then_calibrate(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "session"
    assert run(["simulate", "corners", str(session), "--frames", "3", "--places", "4", "--clutter", "4"]) == 0
    capsys.readouterr()
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out"), "--json"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["kind"] == "world"
    assert printed["verdict"] == "good"
    assert printed["error_against_truth"]["position_mm"] < 3.0
    truth = json.loads(Path(f"{session}.truth.json").read_text())
    metres, radians = read_world_calibration(tmp_path / "out" / "calibration.json").T_world_source.distance(
        Pose.from_matrix(truth["transforms"][0]["matrix"])
    )
    assert metres < 0.003
    assert radians < 0.001
    with pytest.raises(InputError, match="--method"):
        calibrate_world_session(session, tmp_path / "out", method="guess")
    told = inspect_world_session(session)
    assert [p["frames"] for p in told["places"]] == [3, 3, 3, 3]
    assert any("world_sigma_m" in w for w in told["warnings"])


def test_places_on_one_line_are_refused(tmp_path: Path) -> None:
    session = tmp_path / "session"
    assert run(["simulate", "corners", str(session), "--frames", "1", "--places", "3", "--suffix", ".npy"]) == 0
    table = session / "positions.csv"
    lines = table.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for k, row in enumerate(rows):
        row[1:4] = [str(1.0 + k), "0.5", "0.2"]
    table.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    with pytest.raises(UndeterminedError, match="on one line"):
        calibrate_world_session(session, tmp_path / "out")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 1
    assert not (tmp_path / "out" / "calibration.json").exists()


def test_millimetres_are_named_and_end_in_status_1(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "session"
    assert run(["simulate", "corners", str(session), "--frames", "1", "--places", "4", "--suffix", ".npy"]) == 0
    table = session / "positions.csv"
    lines = table.read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    for row in rows:
        row[1:4] = [str(1000.0 * float(x)) for x in row[1:4]]
    table.write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    assert run(["calibrate", str(session), "-o", str(tmp_path / "out")]) == 1
    assert "millimetres" in capsys.readouterr().err
    quality = read_world_calibration(tmp_path / "out" / "calibration.json").quality
    assert quality is not None
    assert quality.verdict == "rejected"
