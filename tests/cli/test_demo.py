"""The demonstration from end to end."""

from pathlib import Path

import pytest

from lidarpose.cli.main import run


@pytest.mark.slow
def test_the_demonstration_ends_well(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", str(tmp_path / "out"), "--places", "6"]) == 0
    text = capsys.readouterr().out
    assert text.count("verdict: good") == 2
    for name in ("turntable-result/report.html", "disk.ply", "rig.urdf", "world-result/calibration.json"):
        assert (tmp_path / "out" / name).stat().st_size > 1000


def test_the_status_is_that_of_the_step_that_failed(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", str(tmp_path / "out"), "--places", "0"]) == 2
    assert capsys.readouterr().err.count("lidarpose: ") == 1


def test_a_folder_with_something_else_in_it_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "thesis.txt").write_text("precious")
    assert run(["demo", str(tmp_path)]) == 2
    assert "holds something else" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.txt"]
