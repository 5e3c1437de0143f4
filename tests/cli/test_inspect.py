"""`inspect` before a calibration: what is there, and what will be weak."""

import json
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.model.recording import SweepRecording
from lidarpose.storage.recording import write_recording
from tests_support.sessions import PLACES, blank_images, copy_session


def test_a_good_session_is_described_with_what_it_will_determine(
    simulated_session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["inspect", str(simulated_session), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["determined"] is True
    assert document["places"] == document["places_used"] == document["places_with_stripes"] == PLACES
    assert document["readings_deg"]["arc"] == pytest.approx(21.5)
    sigma = [row["centre_mm"] for row in document["expected_sigma"]]
    assert 0.02 < sigma[1] < 1.0
    assert sigma[-1] > sigma[1], "half a turn away must be known less well than the arc"
    assert document["weak"][0]["remedy"]


def test_a_recording_is_told_where_to_go(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    recording = SweepRecording("r", np.arange(4.0), np.arange(5.0), np.ones((4, 5)))
    write_recording(tmp_path / "r", recording)
    assert run(["inspect", str(tmp_path / "r")]) == 2
    assert "is a sweep recording" in capsys.readouterr().err


def test_options_of_turntables_are_refused_for_corners(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "session.toml").write_text('format = "lidarpose/corner-session@1"\n')
    for option in (["--any-order"], ["--beams-turn", "clockwise-from-above"]):
        assert run(["inspect", str(tmp_path), *option]) == 2
        assert f"{option[0]}: is for turntable sessions" in capsys.readouterr().err


def test_a_session_without_stripes_is_described_and_refused(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    session = copy_session(simulated_session, tmp_path / "session")
    blank_images(sorted((session / "stripes").glob("*.png")))
    assert run(["inspect", str(session), "--quiet"]) == 1
    captured = capsys.readouterr()
    assert "0 places usable" in captured.out
    assert "Make the laser's stripe visible" in captured.err


def test_people_get_lines_of_text(simulated_session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["inspect", str(simulated_session), "--quiet"]) == 0
    text = capsys.readouterr().out
    assert "camera: 1624 x 1234" in text
    assert "weak: " in text


def test_the_geometry_tells_beforehand_what_the_calibration_will_know(
    simulated_session: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["inspect", str(simulated_session), "--json"]) == 0
    before = json.loads(capsys.readouterr().out)
    assert run(["calibrate", str(simulated_session), "-o", str(tmp_path), "--json", "--no-report"]) == 0
    after = json.loads(capsys.readouterr().out)
    for expected, found in zip(before["expected_sigma"], after["sigma"], strict=True):
        assert expected["angle_deg"] == pytest.approx(found["angle_deg"])
        assert 0.5 < expected["centre_mm"] / found["centre_mm"] < 1.5
        assert 0.5 < expected["rotation_deg"] / found["rotation_deg"] < 1.5
    assert all({"what", "mm", "deg", "angle_deg", "remedy"} <= set(weak) for weak in before["weak"])


def test_further_recordings_are_weighed(simulated_session: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["inspect", str(simulated_session), "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    now = document["expected_sigma"][1]["centre_mm"]
    found = {r["what"].split(" (")[0]: r["inside"]["centre_mm"] for r in document["remedies"]}
    # Four times the measurements halve what the noise of stripes and ranges does; the board's corners are the same.
    assert 0.45 * now < found["four times the places over the same arc"] < 0.9 * now
    assert found["a second placement of the board"] < now
    # What is recorded stays: more is never worse, also where the scan then misses the board.
    assert found["as many places again over twice the arc"] < 1.001 * now


def test_a_contradiction_to_the_rig_is_a_problem_before_calibrating(
    simulated_session: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["inspect", str(simulated_session), "--json"]) == 0
    beams = json.loads(capsys.readouterr().out)["sense"].split("--beams-turn ")[1].split()[0]
    turn, _, view = beams.partition("-from-")
    wrong = f"{'clockwise' if turn == 'anticlockwise' else 'anticlockwise'}-from-{view}"
    assert run(["inspect", str(simulated_session), "--json", "--beams-turn", wrong]) == 0
    problems = json.loads(capsys.readouterr().out)["problems"]
    assert any("written in reverse" in problem for problem in problems)
