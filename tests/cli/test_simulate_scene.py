"""A scene of the user's own becomes a recording in which it is measured again."""

import json
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run

SCENE = """\
format = "lidarpose/scene@1"
[[disks]]
centre_m = [0.1, 0.05, 1.5]
rotation_vector_deg = [5, 20, 0]
diameter_m = 0.14
[[planes]]
centre_m = [0.0, 0.0, 2.2]
"""


def test_a_disk_of_the_scene_is_measured_in_its_recording(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "scene.toml").write_text(SCENE)
    out = str(tmp_path / "recording")
    assert run(["simulate", "scene", str(tmp_path / "scene.toml"), out, "--seed", "2"]) == 0
    capsys.readouterr()
    assert run(["measure", "disk", out, out + ".calibration.json", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["diameter_mm"] == pytest.approx(140.0, abs=0.3)
    np.testing.assert_allclose(document["centre_m"], [0.1, 0.05, 1.5], atol=5e-4)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("diameter_m = 0.14", "diameter_m = -1", "disks.0.diameter_m"),
        ("centre_m = [0.1, 0.05, 1.5]", "centre_m = [0.1, nan, 1.5]", "disks.0.centre_m"),
        ("diameter_m", "diameter_mm", "disks.0"),
        ("scene@1", "scene@2", "version 1 only"),
        (SCENE[SCENE.index("[[disks]]") :], "", "holds nothing"),
    ],
)
def test_flaws_of_a_scene_are_named(
    tmp_path: Path, old: str, new: str, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "scene.toml").write_text(SCENE.replace(old, new))
    assert run(["simulate", "scene", str(tmp_path / "scene.toml"), str(tmp_path / "out")]) == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
