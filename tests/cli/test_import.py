"""The command `import`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.storage.recording import read_recording
from tests_support import bags


def simple_bag(folder: Path) -> Path:
    make = bags.messages("mcap")
    entries = [("/angle", 100.0 + 0.1 * k, make.number("Float64", 3.0 * k)) for k in range(20)]
    entries += [("/scan", 100.5 + 0.1 * k, make.scan(100.5 + 0.1 * k, np.full(10, 2.0))) for k in range(5)]
    return bags.write_bag(folder, "mcap", entries)


def test_a_bag_becomes_a_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ["import", str(simple_bag(tmp_path)), str(tmp_path / "out")]
    more = ["--angle-unit", "deg", "--lidar-model", 'a "LiDAR"', "--range-sigma-m", "1e-3"]
    assert run([*arguments, *more]) == 0
    captured = capsys.readouterr()
    assert "5 sweeps of 10 beams" in captured.out
    assert "no stamps" in captured.err
    lidar = read_recording(tmp_path / "out").lidar
    assert (lidar.model, lidar.range_sigma_m) == ('a "LiDAR"', 1e-3)


@pytest.mark.parametrize(
    ("more", "named"),
    [
        ([], "--angle-unit"),
        (["--as", "turntable"], "--panel"),
        (["--as", "corner"], "clouds"),
        (["--as", "turntable", "--panel", "20x14", "--panel", "a"], "--panel"),
        (["--as", "movie"], "as"),
        (["--dwell-s", "nan"], "dwell"),
        (["--world-m", "1", "2", "nan"], "world"),
    ],
)
def test_wrong_usage_makes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], more: list[str], named: str
) -> None:
    assert run(["import", str(simple_bag(tmp_path)), str(tmp_path / "out"), *more]) == 2
    error = capsys.readouterr().err
    assert error.startswith("lidarpose: ")
    assert named in error
    assert not (tmp_path / "out").exists()
