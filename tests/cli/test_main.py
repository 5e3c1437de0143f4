"""The command line's frame: help, usage errors, exit statuses, `pose`."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import write_calibration


@pytest.fixture
def calibration_file(tmp_path: Path) -> Path:
    rng = np.random.default_rng(5)
    motion = TurntableMotion.from_any_frame(Pose.exp(rng.normal(size=6)), Pose.exp(rng.normal(size=6)))
    path = tmp_path / "calibration.json"
    write_calibration(path, TurntableCalibration(motion, np.diag(np.full(10, 1e-8))))
    return path


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from lidarpose.cli.main import run; run(['--help']); "
        "print(sorted({m.split('.')[0] for m in sys.modules} & {'numpy', 'scipy', 'cv2', 'pydantic', 'numba'}))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert "Usage: lidarpose COMMAND" in done.stdout
    assert done.stdout.strip().endswith("[]")


@pytest.mark.parametrize(
    "arguments",
    [["nonsense"], ["pose"], ["pose", "missing.json", "--angle-deg", "1"], ["pose", "x.json", "--angle-deg", "nan"]],
)
def test_wrong_usage_is_status_2_and_one_dry_message(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    assert run(arguments) == 2
    message = capsys.readouterr()
    assert message.out == ""
    assert message.err.startswith("lidarpose: ")
    assert "Traceback" not in message.err


def test_the_hint_is_for_the_command_that_was_given(capsys: pytest.CaptureFixture[str]) -> None:
    for arguments, hint in (
        (["pose"], "pose"),
        (["measure", "disk"], "measure disk"),
        (["measure", "ball"], "measure"),
    ):
        assert run(arguments) == 2
        assert capsys.readouterr().err.splitlines()[-1] == f"See: lidarpose {hint} --help"


def test_pose_prints_one_json_object(calibration_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["pose", str(calibration_file), "--angle-deg", "-12.5", "--json"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert set(document) == {"angle_deg", "matrix", "covariance", "sigma_translation_mm", "sigma_rotation_deg"}
    assert document["angle_deg"] == -12.5
    assert np.shape(document["covariance"]) == (6, 6)
    assert all(0.05 < sigma < 1.0 for sigma in document["sigma_translation_mm"])


def test_pose_prints_a_table_for_people(calibration_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["pose", str(calibration_file), "--angle-deg", "0"]) == 0
    assert "± mm" in capsys.readouterr().out
