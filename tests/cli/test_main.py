"""The command line's frame: help, usage errors, exit statuses, `pose`."""

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

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
    [
        ["simulate", "turntable", "out", "--seed", "1.5"],
        ["nonsense"],
        ["pose"],
        ["pose", "missing.json", "--angle-deg", "1"],
        ["pose", "x.json", "--angle-deg", "nan"],
    ],
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


def whole_command(*arguments: str | Path, **options: Any) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "lidarpose", *map(str, arguments)]
    return subprocess.run(command, stderr=subprocess.PIPE, text=True, check=False, **options)


@pytest.mark.parametrize("encoding", ["ascii", "cp1252"])
def test_an_encoding_that_lacks_a_sign_is_no_error(calibration_file: Path, encoding: str) -> None:
    named = calibration_file.rename(calibration_file.with_name("\u5b57 \u00b1.json"))
    environment = {**os.environ, "PYTHONIOENCODING": encoding}
    done = whole_command("export", named, "--to", "csv", "-o", named.with_suffix(".csv"), env=environment)
    assert (done.returncode, done.stderr) == (0, "")
    done = whole_command("pose", named, "--angle-deg", "1", env=environment, stdout=subprocess.DEVNULL)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full here")
def test_a_full_disk_under_standard_output_is_one_message(calibration_file: Path) -> None:
    for arguments in (["pose", calibration_file, "--angle-deg", "1"], ["--help"]):
        with Path("/dev/full").open("w") as full:
            done = whole_command(*arguments, stdout=full)
        assert (done.returncode, done.stderr) == (2, "lidarpose: standard output: No space left on device\n")


def test_the_status_is_that_of_the_command_where_nobody_reads(calibration_file: Path) -> None:
    """`lidarpose ... | head` is no failure, least of all status 1, which says that data determine nothing."""
    for arguments in (["pose", calibration_file, "--angle-deg", "1"], ["--help"]):
        reader, writer = os.pipe()
        os.close(reader)
        done = whole_command(*arguments, stdout=writer)
        os.close(writer)
        assert (done.returncode, done.stderr) == (0, "")


def test_no_number_is_cut_short_on_a_narrow_terminal(
    calibration_file: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    assert run(["pose", str(calibration_file), "--angle-deg", "0"]) == 0
    assert "\u2026" not in capsys.readouterr().out


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
