"""Sweeps of a turned 2D LiDAR as frames of a corner session: recordings, scanned into clouds, give world <- camera."""

import json
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from lidarpose.cli.main import run
from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CloudSource, is_recording
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.calibration import read_turntable_calibration, read_world_calibration, write_calibration
from lidarpose.storage.corner_session import read_corner_session
from lidarpose.workflows.recorded_corners import ScannedCloud, with_scans
from lidarpose.workflows.world import world_run

# The carton stands on its tip, towards the camera; it is moved, never turned.
SIZE_M = 0.4
TIP = np.degrees(np.arccos(1.0 / np.sqrt(3.0))) * np.array([1.0, -1.0, 0.0]) / np.sqrt(2.0)
CORNERS = np.array([[-0.45, -0.2, 1.6], [0.4, -0.15, 1.8], [0.1, 0.25, 1.5], [-0.15, 0.1, 2.1]])
T_WORLD_CAMERA = Pose.exp(np.array([1.0, -0.5, 1.4, -1.9, 0.3, 0.2]))


def scene(corner: FloatArray) -> str:
    centre = corner + exp_so3(np.radians(TIP)) @ np.full(3, SIZE_M / 2.0)
    return f"""\
format = "lidarpose/scene@1"
[[boxes]]
centre_m = {centre.tolist()}
rotation_vector_deg = {TIP.tolist()}
size_m = [{SIZE_M}, {SIZE_M}, {SIZE_M}]
[[planes]]
centre_m = [0.0, 0.0, 3.5]
"""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A session whose clouds are recordings, with the turntable's calibration beside it as turntable.json."""
    base = tmp_path_factory.mktemp("recorded")
    rows = ["position,world_x_m,world_y_m,world_z_m,clouds"]
    for k, (corner, world) in enumerate(zip(CORNERS, T_WORLD_CAMERA @ CORNERS, strict=True)):
        (base / "scene.toml").write_text(scene(corner))
        recording = base / f"session/recordings/p{k}"
        recording.parent.mkdir(parents=True, exist_ok=True)
        steps = ["--turntable-deg", "-22", "22", "--sweep-step-deg", "0.4", "--beam-step-deg", "0.3", "--seed", str(k)]
        steps += ["--range-sigma-m", "0.003"]
        assert run(["simulate", "scene", str(base / "scene.toml"), str(recording), *steps]) == 0
        (base / f"session/recordings/p{k}.calibration.json").replace(base / "turntable.json")
        rows.append(f"p{k}," + ",".join(f"{x:.6f}" for x in world) + f",recordings/p{k}")
    (base / "session/positions.csv").write_text("\n".join(rows) + "\n")
    header = ['format = "lidarpose/corner-session@1"', 'positions = "positions.csv"']
    (base / "session/session.toml").write_text("\n".join(header) + "\n")
    return base


def check(result: Path) -> None:
    found = read_world_calibration(result / "calibration.json")
    metres, radians = found.T_world_source.distance(T_WORLD_CAMERA)
    assert metres < 0.002
    assert np.degrees(radians) < 0.06
    document = json.loads((result / "calibration.json").read_text())
    assert [(t["parent"], t["child"]) for t in document["transforms"]] == [("world", "camera")]
    assert document["quality"]["verdict"] == "good"


def test_recordings_are_clouds_by_their_turntables_calibration(recorded: Path, tmp_path: Path) -> None:
    session = recorded / "session"
    turntable = ["--turntable", str(recorded / "turntable.json")]
    assert run(["calibrate", str(session), "-o", str(tmp_path / "option"), *turntable]) == 0
    check(tmp_path / "option")
    # The same as from clouds that were scanned first.
    clouds = tmp_path / "scanned"
    clouds.mkdir()
    table = (session / "positions.csv").read_text()
    for k in range(len(CORNERS)):
        cloud = clouds / f"p{k}.ply"
        assert run(["scan", str(session / f"recordings/p{k}"), str(recorded / "turntable.json"), "-o", str(cloud)]) == 0
        table = table.replace(f"recordings/p{k}", f"p{k}.ply")
    (clouds / "positions.csv").write_text(table)
    (clouds / "session.toml").write_text((session / "session.toml").read_text() + 'cloud_frame = "camera"\n')
    assert run(["calibrate", str(clouds), "-o", str(tmp_path / "out")]) == 0
    check(tmp_path / "out")
    a, b = (read_world_calibration(tmp_path / name / "calibration.json") for name in ("option", "out"))
    np.testing.assert_allclose(a.T_world_source.matrix, b.T_world_source.matrix, atol=1e-6)


def test_a_session_names_the_calibration_of_its_turntable(recorded: Path) -> None:
    session = read_corner_session(recorded / "session")
    assert session.has_recordings
    assert session.cloud_frame == "camera"
    assert session.turntable is None
    with pytest.raises(InputError, match="turntable_calibration"):
        world_run(session)
    file = recorded / "session/session.toml"
    plain = file.read_text()
    (recorded / "session/turntable.json").write_bytes((recorded / "turntable.json").read_bytes())
    try:
        file.write_text(plain + 'turntable_calibration = "turntable.json"\n')
        named = with_scans(read_corner_session(recorded / "session"))
        assert not named.has_recordings
        points = named.places[0].clouds[0].load().points
        assert np.linalg.norm(points - CORNERS[0], axis=1).min() < 0.03
        file.write_text(plain + 'cloud_frame = "lidar"\n')
        with pytest.raises(InputError, match="cloud_frame"):
            read_corner_session(recorded / "session")
    finally:
        file.write_text(plain)


def test_recordings_without_a_calibration_are_named(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["calibrate", str(recorded / "session"), "-o", str(tmp_path / "out")]) == 2
    assert "--turntable" in capsys.readouterr().err
    assert run(["inspect", str(recorded / "session")]) == 0
    assert "turntable_calibration" in capsys.readouterr().out


@pytest.mark.parametrize(
    "pattern", ["recordings/p1", "recordings/p1/", "recordings/p1/*", "recordings/p1/recording.toml"]
)
def test_a_recording_is_found_by_its_folder_or_its_files(recorded: Path, pattern: str) -> None:
    table = recorded / "session/positions.csv"
    plain = table.read_text()
    try:
        table.write_text(plain.replace("recordings/p1\n", pattern + "\n"))
        (source,) = read_corner_session(recorded / "session").places[1].clouds
        assert source.name == "recordings/p1"
    finally:
        table.write_text(plain)


def test_clouds_beside_recordings_at_one_place_are_refused(recorded: Path) -> None:
    table = recorded / "session/positions.csv"
    plain = table.read_text()
    stray = recorded / "session/recordings/stray.npy"
    try:
        np.save(stray, np.zeros((10, 3)))
        table.write_text(plain.replace("recordings/p1\n", "recordings/*\n"))
        with pytest.raises(InputError, match="beside sweep recordings"):
            read_corner_session(recorded / "session")
    finally:
        stray.unlink()
        table.write_text(plain)


def bent(motion: TurntableMotion, change: FloatArray) -> TurntableMotion:
    """The motion with its ten parameters changed (10,)."""
    mounting = exp_so3(change[7:]) @ motion.T_turntable_lidar.rotation
    return TurntableMotion(
        Pose.exp(change[:6]) @ motion.T_camera_turntable,
        Pose(mounting, np.array([motion.radius_m + change[6], 0.0, 0.0])),
    )


def test_the_turntables_own_covariance_reaches_the_world(recorded: Path) -> None:
    """Against estimates from clouds that each parameter of the turntable's calibration has bent."""
    session = read_corner_session(recorded / "session")
    motion = read_turntable_calibration(recorded / "turntable.json").motion
    sigma = np.array([1e-3] * 3 + [1e-3] * 3 + [5e-4] + [1e-3] * 3)
    mixing = np.random.default_rng(3).normal(0.0, 0.3, (10, 10)) + np.eye(10)
    factor = sigma[:, None] * mixing

    def found(calibration: TurntableCalibration) -> WorldCalibration:
        return world_run(replace(session, turntable=calibration)).calibration

    plain = found(TurntableCalibration(motion))
    known = found(TurntableCalibration(motion, factor @ factor.T))
    assert plain.covariance is not None
    assert known.covariance is not None
    # A process that has earned its kernels meanwhile adds in another order.
    np.testing.assert_allclose(known.T_world_source.matrix, plain.T_world_source.matrix, atol=1e-12)
    added = known.covariance - plain.covariance
    moves = np.column_stack(
        [
            found(TurntableCalibration(bent(motion, change))).T_world_source.minus(plain.T_world_source)
            for change in factor.T
        ]
    )
    expected = moves @ moves.T
    scale = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(added / np.outer(scale, scale), expected / np.outer(scale, scale), atol=0.08)
    assert known.quality is not None
    assert plain.quality is not None
    assert known.quality.figures["sigma_position_mm"] > 1.5 * plain.quality.figures["sigma_position_mm"]


def test_a_turntable_of_unknown_uncertainty_is_named(
    recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    known = read_turntable_calibration(recorded / "turntable.json")
    write_calibration(tmp_path / "bare.json", TurntableCalibration(known.motion))
    out = ["-o", str(tmp_path / "out"), "--turntable", str(tmp_path / "bare.json")]
    assert run(["calibrate", str(recorded / "session"), *out]) == 0
    assert "states no covariance" in " ".join(capsys.readouterr().out.split())
    document = json.loads((tmp_path / "out/calibration.json").read_text())
    assert document["quality"]["verdict"] == "doubtful"


def test_shifts_of_a_turntable_that_never_stops() -> None:
    """Against clouds that each parameter has bent, readings being interpolated within the sweeps."""
    sweeps, beams = 25, 61
    rng = np.random.default_rng(5)
    recording = SweepRecording(
        "turning",
        np.linspace(-15.0, 15.0, sweeps),
        np.linspace(-40.0, 40.0, beams),
        rng.uniform(1.0, 3.0, (sweeps, beams)),
        time_s=0.1 * np.arange(sweeps),
    )
    mounting = Pose(exp_so3(np.array([0.3, -0.2, 1.4])), np.array([0.08, 0.0, 0.0]))
    motion = TurntableMotion(Pose.exp(np.array([0.1, -0.2, 0.05, -1.2, 0.4, 0.3])), mounting)

    class Source:
        name = "turning"

        def recording(self) -> SweepRecording:
            return recording

    def points(motion: TurntableMotion, *, never_stops: bool = True) -> FloatArray:
        cloud = ScannedCloud(Source(), TurntableCalibration(motion), never_stops).load().points
        return np.asarray(cloud, dtype=np.float64)

    still = points(motion, never_stops=False)
    turning = points(motion)
    assert still.shape == turning.shape
    # 1.25 degrees a sweep.
    assert np.linalg.norm(turning - still, axis=1).max() > 0.005
    shifts = ScannedCloud(Source(), TurntableCalibration(motion), never_stops=True).shifts()(turning)
    step = 1e-3
    for k, change in enumerate(step * np.eye(10)):
        moved = (points(bent(motion, change)) - points(bent(motion, -change))) / (2.0 * step)
        np.testing.assert_allclose(shifts[:, :, k], moved, atol=2e-3)


@dataclass(frozen=True)
class Timed:
    """A recording with a time for each sweep."""

    source: CloudSource

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> Cloud:
        return self.source.load()

    def recording(self) -> SweepRecording:
        assert is_recording(self.source)
        recording = self.source.recording()
        return replace(recording, time_s=0.1 * np.arange(recording.sweeps))


def test_a_turntable_that_never_stops_reaches_the_world(recorded: Path) -> None:
    """What its covariance adds is nearly the same where readings are interpolated within the sweeps."""
    session = read_corner_session(recorded / "session")
    motion = read_turntable_calibration(recorded / "turntable.json").motion
    known = TurntableCalibration(motion, np.diag(np.array([1e-3] * 6 + [5e-4] + [1e-3] * 3) ** 2))
    places = [replace(p, clouds=tuple(map(Timed, p.clouds))) for p in session.places]
    timed = replace(session, turntable=known, places=tuple(places))
    stopped, turning = (world_run(with_scans(timed, never_stops=turns)).calibration for turns in (False, True))
    assert stopped.covariance is not None
    assert turning.covariance is not None
    assert np.degrees(turning.T_world_source.distance(stopped.T_world_source)[1]) > 0.02
    scale = np.sqrt(np.diag(stopped.covariance))
    np.testing.assert_allclose((turning.covariance - stopped.covariance) / np.outer(scale, scale), 0.0, atol=0.15)
