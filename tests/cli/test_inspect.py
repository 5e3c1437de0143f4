"""`inspect` before a calibration: what is there, and what will be weak."""

import json
from pathlib import Path

import pytest

from lidarpose.cli.main import run
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
