"""`lidarpose scan` on small recordings, end to end."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import write_calibration
from lidarpose.storage.clouds import read_cloud
from lidarpose.storage.recording import write_recording

MOTION = TurntableMotion(
    Pose.exp([0.1, -0.2, 0.3, 0.4, 0.5, -0.6]),
    Pose(Pose.exp([0, 0, 0, 0.3, 0.2, 0.1]).rotation, np.array([0.05, 0, 0])),
)
WORLD = WorldCalibration(Pose.exp([1.0, 2.0, 3.0, 0.1, -0.4, 0.2]), "camera", 1.001, np.eye(6) * 1e-8)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    rng = np.random.default_rng(0)
    ranges = rng.uniform(1.0, 3.0, (6, 9)).astype(np.float32)
    ranges[1, 2] = np.nan
    recording = SweepRecording(
        "rec",
        np.arange(6) * 0.25,
        np.linspace(-20, 20, 9),
        ranges,
        intensity=rng.uniform(0, 1, (6, 9)).astype(np.float32),
        time_s=np.arange(6) * 0.1,
        lidar=LidarSpec(None, 0.001),
    )
    write_recording(tmp_path / "rec", recording)
    write_calibration(tmp_path / "cal.json", TurntableCalibration(MOTION, np.eye(10) * 1e-8))
    write_calibration(tmp_path / "world.json", WORLD)
    return tmp_path


def expected_points(folder: Path) -> np.ndarray:
    ranges = np.load(folder / "rec/range_m.npy").astype(float)
    theta = np.deg2rad(np.load(folder / "rec/beam_angle_deg.npy"))
    readings = np.deg2rad(np.load(folder / "rec/turntable_angle_deg.npy"))
    flat = np.stack([ranges * np.cos(theta), ranges * np.sin(theta), 0 * ranges], -1)
    return np.stack([MOTION.pose(a) @ p for a, p in zip(readings, flat, strict=True)]).reshape(-1, 3)


@pytest.mark.parametrize("suffix", [".ply", ".pcd", ".las", ".laz", ".e57", ".npy"])
def test_writes_every_format(folder: Path, suffix: str, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / f"cloud{suffix}"
    assert run(["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(out), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["points"] == 53
    points = expected_points(folder)
    cloud = read_cloud(out)
    np.testing.assert_allclose(cloud.points, points[np.isfinite(points[:, 0])], atol=2e-4 if "la" in suffix else 2e-6)
    if suffix != ".npy":
        assert "intensity" in cloud.fields


def test_world_sigma_indices_and_order(folder: Path) -> None:
    out = folder / "cloud.ply"
    command = ["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(out)]
    assert run([*command, "--world", str(folder / "world.json"), "--sigma", "--indices", "--keep-order"]) == 0
    cloud = read_cloud(out)
    points = (
        WORLD.scale * (expected_points(folder) @ WORLD.T_world_source.rotation.T) + WORLD.T_world_source.translation
    )
    np.testing.assert_allclose(cloud.points, points, atol=2e-6)
    assert cloud.fields["sweep"][10] == 1
    assert cloud.fields["beam"][10] == 1
    sigma = cloud.fields["sigma_m"]
    assert np.isnan(sigma[11])
    assert 0.001 < np.nanmin(sigma) < np.nanmax(sigma) < 0.0015


def test_never_stopping_by_times_equals_a_reading_a_beam(folder: Path) -> None:
    beams = np.load(folder / "rec/beam_angle_deg.npy")
    per_beam = np.arange(6)[:, None] * 0.25 + 0.25 * (beams - beams[0]) / 360.0
    recording = SweepRecording("rec2", per_beam, beams, np.load(folder / "rec/range_m.npy"))
    write_recording(folder / "rec2", recording)
    assert run(["scan", str(folder / "rec2"), str(folder / "cal.json"), "-o", str(folder / "b.ply")]) == 0
    assert (
        run(["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(folder / "a.ply"), "--never-stops"]) == 0
    )
    a, b = read_cloud(folder / "a.ply").points, read_cloud(folder / "b.ply").points
    np.testing.assert_allclose(a, b, atol=1e-6)


def test_gates_ranges_and_refuses_nonsense(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = folder / "cloud.ply"
    command = ["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(out)]
    assert run([*command, "--nearest-m", "1.5", "--farthest-m", "2.5"]) == 0
    ranges = np.load(folder / "rec/range_m.npy")
    assert len(read_cloud(out)) == np.count_nonzero((ranges >= 1.5) & (ranges <= 2.5))
    for bad in (["--nearest-m", "nan"], ["--farthest-m", "0"], ["--world", str(folder / "cal.json")]):
        assert run([*command, *bad]) == 2
        assert "Traceback" not in capsys.readouterr().err


def test_a_gate_in_millimetres_writes_no_empty_cloud(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    command = ["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(folder / "cloud.ply")]
    assert run([*command, "--nearest-m", "1500"]) == 2
    assert "between 1500 and inf m" in capsys.readouterr().err
    np.save(folder / "rec" / "range_m.npy", np.full((6, 9), np.nan, dtype=np.float32))
    assert run(command) == 1
    assert not (folder / "cloud.ply").exists()


@pytest.mark.parametrize("name", ["rec/range_m.npy", "rec/../rec/time_s.npy"])
def test_no_file_that_is_read_is_replaced(folder: Path, name: str, capsys: pytest.CaptureFixture[str]) -> None:
    before = (folder / name).read_bytes()
    assert run(["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(folder / name)]) == 2
    assert "is read by this command" in capsys.readouterr().err
    assert (folder / name).read_bytes() == before


@pytest.mark.parametrize("suffix", [".ply", ".las", ".laz", ".e57"])
def test_a_full_disk_is_one_message_and_leaves_nothing(folder: Path, suffix: str) -> None:
    limited = (
        "import resource, sys; from lidarpose.cli.main import run; "
        "resource.setrlimit(resource.RLIMIT_FSIZE, (500, 500)); sys.exit(run(sys.argv[1:]))"
    )
    command = ["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(folder / f"cloud{suffix}")]
    done = subprocess.run([sys.executable, "-c", limited, *command], capture_output=True, text=True, check=False)
    assert done.returncode == 2, done.stderr
    assert "Traceback" not in done.stderr
    assert f"cloud{suffix}: cannot be written: " in done.stderr
    assert not [*folder.glob("cloud*")]


def test_a_session_is_no_recording(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (folder / "session.toml").write_text("")
    assert run(["scan", str(folder), str(folder / "cal.json"), "-o", str(folder / "cloud.ply")]) == 2
    assert "is a session; expected the folder of a sweep recording" in capsys.readouterr().err


def test_an_unwritable_or_unknown_output_leaves_nothing(folder: Path) -> None:
    before = sorted(folder.iterdir())
    assert run(["scan", str(folder / "rec"), str(folder / "cal.json"), "-o", str(folder / "cloud.stl")]) == 2
    assert sorted(folder.iterdir()) == before


def test_npy_is_a_plain_array_unless_more_is_asked_for(tmp_path: Path) -> None:
    assert run(["simulate", "disk", str(tmp_path / "disk"), "--sweep-step-deg", "1"]) == 0
    recording, calibration = str(tmp_path / "disk"), str(tmp_path / "disk.calibration.json")
    ranges = np.load(tmp_path / "disk" / "range_m.npy")
    np.save(tmp_path / "disk" / "intensity.npy", np.ones(ranges.shape, np.float32))
    assert run(["scan", recording, calibration, "-o", str(tmp_path / "a.npy")]) == 0
    assert np.load(tmp_path / "a.npy").shape == (np.isfinite(ranges).sum(), 3)
    assert run(["scan", recording, calibration, "-o", str(tmp_path / "b.npy"), "--indices"]) == 0
    assert set(np.load(tmp_path / "b.npy").dtype.names) == {"x", "y", "z", "intensity", "sweep", "beam"}
