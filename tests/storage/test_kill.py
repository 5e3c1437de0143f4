"""Outputs are whole or absent when the process is killed at any moment, and what it left is cleaned by the next one.

`KINDS` has every output of the package with the functions that write it; a test reads the package's source and fails
when a function that writes is not there.
"""

from __future__ import annotations

import ast
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import lidarpose
from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.camera import Camera
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CornerPlace, CornerSession
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec, Scan
from lidarpose.model.session import TurntablePlace, TurntableSession
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.atomic import replacing, write_text
from lidarpose.storage.calibration import read_calibration, read_turntable_calibration, write_calibration
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.camera_info import write_camera_info
from lidarpose.storage.cloud_import import PlaceOptions, add_place
from lidarpose.storage.clouds import read_cloud, write_cloud
from lidarpose.storage.clouds.pcd import write_encoded
from lidarpose.storage.corner_session import read_corner_session, write_corner_session
from lidarpose.storage.exports import ExportOptions, write_export
from lidarpose.storage.recording import read_recording, write_simulated_recording
from lidarpose.storage.session import read_turntable_session
from lidarpose.storage.session_writer import write_turntable_session
from lidarpose.storage.truth import truth_path

RUNS = 40
POINTS = 60_000
LAST = 99_999
PART = ".lidarpose-part-"
CAMERA = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]))


@dataclass(frozen=True)
class Kind:
    """An output: its name, a write of one version after the other, and a check that all of it is of one version.

    `writers` are the functions of the package through which it is written. `begun` tells whether there is something
    to check yet.
    """

    out: str
    write: Callable[[Path, int], None]
    check: Callable[[Path], None]
    writers: tuple[str, ...]
    begun: Callable[[Path], bool] = Path.exists


def mark(version: int) -> int:
    return version % 100 + 1


def cloud(version: int) -> Cloud:
    points = np.full((POINTS, 3), float(mark(version)), dtype=np.float32)
    return Cloud(points, {"ring": np.full(POINTS, mark(version), dtype=np.uint16)})


def check_cloud(out: Path) -> None:
    found = read_cloud(out)
    assert len(found) == POINTS
    assert np.unique(found.points.round(3)).tolist() == np.unique(found.fields["ring"]).tolist()


def motion(version: int) -> TurntableMotion:
    return TurntableMotion.from_any_frame(Pose.exp([version, 0, 0, 0, 0, 0]), Pose.identity())


def calibration(version: int) -> TurntableCalibration:
    return TurntableCalibration(motion(version), np.eye(10) * 1e-8)


def export(to: str) -> Callable[[Path, int], None]:
    options = ExportOptions(angles_rad=(0.1, 0.2, 0.3) if to == "csv" else (), camera=CAMERA)
    return lambda out, version: write_export(out, calibration(version), to, options)


def ends_with(end: str) -> Callable[[Path], None]:
    def check(out: Path) -> None:
        assert out.read_text().endswith(end)

    return check


def check_lines(out: Path) -> None:
    assert len(out.read_text().splitlines()) == 6


def check_calibration(out: Path) -> None:
    assert isinstance(read_calibration(out), TurntableCalibration)


def check_camera(out: Path) -> None:
    assert read_camera(out).width == CAMERA.width


def check_launch_file(out: Path) -> None:
    tree = ast.parse(out.read_text())
    assert any(isinstance(node, ast.FunctionDef) and node.name == "generate_launch_description" for node in tree.body)


def write_recording_of(out: Path, version: int) -> None:
    ranges = np.full((200, 300), mark(version), dtype=np.float32)
    recording = SweepRecording("r", np.full(200, float(mark(version))), np.arange(300.0), ranges)
    write_simulated_recording(out, recording, motion(mark(version)), {"version": version}, force=True)


def check_recording(out: Path) -> None:
    read = read_recording(out)
    assert np.unique(read.range_m).tolist() == np.unique(read.turntable_angle_deg).tolist()
    version = float(read.range_m[0, 0])
    # What lies beside it belongs to it, or is not there yet.
    beside = Path(f"{out}.calibration.json")
    if beside.exists():
        assert read_turntable_calibration(beside).motion.T_camera_turntable.translation[0] == pytest.approx(version)
    if truth_path(out).exists():
        assert mark(json.loads(truth_path(out).read_text())["version"]) == version


@dataclass(frozen=True)
class Made:
    """An image, scan or cloud in memory."""

    content: Any
    name: str = "made"

    def load(self) -> Any:
        return self.content


def write_turntable(out: Path, version: int) -> None:
    image = Made(np.full((CAMERA.height, CAMERA.width), mark(version), np.uint8))
    angle = np.deg2rad(np.arange(300.0) / 3.0)
    scan = Made(Scan(angle, np.full(300, float(mark(version)))))
    places = tuple(TurntablePlace(str(k), 0.1 * k, image, scan) for k in range(4))
    panels = (Panel(5, 4, 0.02), Panel(5, 4, 0.02))
    session = TurntableSession("s", CAMERA, panels, {"": (image,)}, places, LidarSpec(str(mark(version))))
    write_turntable_session(out, session, truth={"version": version}, force=True)


def check_turntable(out: Path) -> None:
    session = read_turntable_session(out)
    version = int(session.lidar.model or 0)
    images = [session.board_images[""][0], *(place.stripe_image for place in session.places)]
    assert all(np.unique(image.load()).tolist() == [version] for image in images if image is not None)
    assert all(np.unique(place.scan.load().range_m).tolist() == [version] for place in session.places)
    assert len(images) == 5
    if truth_path(out).exists():
        assert mark(json.loads(truth_path(out).read_text())["version"]) == version


def write_corners(out: Path, version: int) -> None:
    places = tuple(CornerPlace(str(k), np.full(3, float(mark(version))), (Made(cloud(version)),)) for k in range(3))
    write_corner_session(out, CornerSession("s", places), force=True)


def check_corners(out: Path) -> None:
    for place in read_corner_session(out).places:
        points = place.clouds[0].load().points
        assert np.unique(points).tolist() == np.unique(place.corner_world).tolist()
        assert len(points) == POINTS


def write_place(out: Path, version: int) -> None:
    add_place(out, [cloud(version)] * 3, PlaceOptions(f"p{version:05d}", (1.0, 2.0, float(version))), out)


def check_places(out: Path) -> None:
    lines = (out / "positions.csv").read_text().splitlines()[1:]
    places = [line.split(",")[0] for line in lines]
    for place in places[-2:]:
        assert all(len(read_cloud(out / f"clouds/{place}/{k:03d}.pcd")) == POINTS for k in range(3))


def write_viewer(out: Path, version: int) -> None:
    """As `lidarpose view -o`, whose library is an extra: what it writes to the temporary name takes its time."""
    with replacing(out) as temporary, temporary.open("wb") as file:
        for _ in range(20):
            file.write(bytes([mark(version)]) * 40_000)
            file.flush()


def check_viewer(out: Path) -> None:
    data = out.read_bytes()
    assert len(data) == 800_000
    assert len(set(data)) == 1


def write_report(out: Path, version: int) -> None:
    write_text(out, f"<html>{mark(version) % 10}" + f"{mark(version) % 10}" * 600_000 + "</html>\n")


_CLOUD = ("storage.clouds:_open",)
_EXPORT = ("storage.exports:write_export",)
_TEXT = ("storage.atomic:write_text",)
_REPORTS = (
    "cli.calibrate:_write_report",
    "cli.calibrate_recording:calibrate_recording",
    "cli.calibrate_world:calibrate_world_session",
    "cli.measure_disk:measure_disk",
)
KINDS = {
    **{f"cloud {s}": Kind(f"a{s}", lambda out, v: write_cloud(out, cloud(v)), check_cloud, _CLOUD)
       for s in (".ply", ".pcd", ".las", ".laz", ".e57", ".npy", ".xyz", ".txt", ".csv")},
    "cloud compressed": Kind("a.pcd", lambda out, v: write_encoded(out, cloud(v), "binary_compressed"), check_cloud,
                             ("storage.clouds.pcd:write_encoded",)),
    "calibration": Kind("c.json", lambda out, v: write_calibration(out, calibration(v)), check_calibration,
                        ("storage.calibration:write_calibration",)),
    "camera": Kind("c.yaml", lambda out, _: write_camera_info(out, CAMERA), check_camera,
                   ("storage.camera_info:write_camera_info",)),
    "export urdf": Kind("c.urdf", export("urdf"), ends_with("</robot>\n"), _EXPORT),
    "export csv": Kind("c.csv", export("csv"), check_lines, _EXPORT),
    "export ros2": Kind("c.launch.py", export("ros2"), check_launch_file, _EXPORT),
    "export kalibr": Kind("c.yaml", export("kalibr"), check_camera, _EXPORT),
    "export opencv yaml": Kind("c.yml", export("opencv"), check_camera, _EXPORT),
    "export opencv xml": Kind("c.xml", export("opencv"), ends_with("</opencv_storage>\n"), _EXPORT),
    "recording": Kind("r", write_recording_of, check_recording,
                      ("storage.recording:write_recording", "storage.recording:write_simulated_recording")),
    "turntable session": Kind("s", write_turntable, check_turntable,
                              ("storage.session_writer:write_turntable_session",)),
    "corner session": Kind("s", write_corners, check_corners, (
        "storage.corner_session:write_corner_session", "storage.corner_session:_write_files",
        "cli.simulate_corners:simulate_corners")),
    "place of a corner session": Kind("s", write_place, check_places, ("storage.cloud_import:add_place",),
                                      lambda out: (out / "positions.csv").exists()),
    "report": Kind("report.html", write_report, ends_with("</html>\n"), (*_TEXT, *_REPORTS)),
    "viewer's recording": Kind("a.rrd", write_viewer, check_viewer, ("cli.view:view",)),
}  # fmt: skip


@cache
def functions_that_write() -> frozenset[str]:
    """Functions of the package that call one of the three that make an output whole or absent."""
    found = set()
    root = Path(lidarpose.__file__).parent
    for path in root.rglob("*.py"):
        parts = path.relative_to(root).with_suffix("").parts
        module = ".".join(parts[:-1] if parts[-1] == "__init__" else parts)
        for function in (n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.FunctionDef)):
            calls = {n.func.id for n in ast.walk(function) if isinstance(n, ast.Call) and isinstance(n.func, ast.Name)}
            if calls & {"replacing", "replacing_folder", "write_text"}:
                found.add(f"{module}:{function.name}")
    return frozenset(found)


def test_every_function_that_writes_is_killed() -> None:
    assert {writer for kind in KINDS.values() for writer in kind.writers} == functions_that_write()


def test_nothing_is_written_past_them() -> None:
    """Elsewhere files are opened for writing only under the temporary names that those functions give."""
    under_temporary_names = {
        "storage/atomic.py", "storage/recording.py", "storage/session_writer.py",
        *(f"storage/clouds/{name}.py" for name in ("npy", "pcd", "ply", "xyz")),
    }  # fmt: skip
    found = set()
    root = Path(lidarpose.__file__).parent
    for path in root.rglob("*.py"):
        for call in (n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)):
            name = call.func.attr if isinstance(call.func, ast.Attribute) else getattr(call.func, "id", "")
            modes = [a.value for a in [*call.args, *(k.value for k in call.keywords)] if isinstance(a, ast.Constant)]
            opens = name == "open" and any(isinstance(m, str) and m[:1] in ("w", "a", "x") for m in modes)
            writes = isinstance(call.func, ast.Attribute) and name in ("write_text", "write_bytes", "imwrite", "tofile")
            # laspy's and rosbags' own: `laspy.open(self._path, mode="w")` writes to the name that `writer` was given.
            if (opens and "laspy" not in ast.unparse(call.func)) or writes:
                found.add(path.relative_to(root).as_posix())
    assert found == under_temporary_names


@pytest.mark.slow
@pytest.mark.parametrize("name", KINDS)
def test_killed_at_any_moment(name: str, tmp_path: Path) -> None:
    kind = KINDS[name]
    rng = random.Random(name)
    out = tmp_path / kind.out
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, name, os.fspath(out)]
    checked = 0
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdin is not None
        assert parent.stdout is not None
        longest = max(0.08, 2.5 * float(parent.stdout.readline()))
        for run in range(RUNS):
            print(run * 1000, file=parent.stdin, flush=True)
            process = int(parent.stdout.readline())  # a child that writes and writes
            time.sleep(rng.uniform(0.0, longest))
            os.kill(process, signal.SIGKILL)
            assert parent.stdout.readline() == "gone\n"
            if kind.begun(out):
                kind.check(out)
                checked += 1
        parent.stdin.close()
    assert checked > RUNS // 4
    # The next run that ends well leaves nothing of the killed ones.
    kind.write(out, LAST)
    kind.check(out)
    if out.is_dir():
        assert not [path for path in out.rglob("*") if PART in path.name]
    beside = {out, truth_path(out), Path(f"{out}.calibration.json")}
    assert [path.name for path in tmp_path.iterdir() if path not in beside] == []


_PLACE_KILLED = """
import os, signal, sys
from pathlib import Path
import numpy as np
from lidarpose.model.cloud import Cloud
from lidarpose.storage import cloud_import
def killed(path, text):
    if path.name == sys.argv[2]:
        os.kill(os.getpid(), signal.SIGKILL)
    write(path, text)
write, cloud_import.write_text = cloud_import.write_text, killed
cloud = Cloud(np.ones((3, 3), dtype=np.float32))
cloud_import.add_place(Path(sys.argv[1]), [cloud], cloud_import.PlaceOptions(sys.argv[3] or None), Path("bag"))
"""


@pytest.mark.parametrize("before", ["session.toml", "positions.csv"])
def test_a_place_killed_before_it_is_named_is_cleaned_by_the_next(tmp_path: Path, before: str) -> None:
    """Between the clouds in their folder and the table that names them."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-c", _PLACE_KILLED, os.fspath(tmp_path), before, ""]
    assert subprocess.run(command, env=environment).returncode == -signal.SIGKILL
    assert [path.name for path in (tmp_path / "clouds").iterdir()] == ["p00"]
    own = tmp_path / "clouds/mine"
    own.mkdir()
    said, _ = add_place(tmp_path, [cloud(1)], PlaceOptions(None, (1.0, 2.0, 3.0)), tmp_path)
    assert said.startswith("place p00: 1 clouds")
    (place,) = read_corner_session(tmp_path).places
    assert len(place.clouds[0].load()) == POINTS
    # What a user put there stays.
    assert own.exists()
    assert not [path for path in tmp_path.rglob("*") if PART in path.name]


def test_a_place_that_cannot_be_named_is_not_left_behind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(path: Path, _: str) -> None:
        raise InputError(path, "cannot be written: No space left on device")

    monkeypatch.setattr("lidarpose.storage.cloud_import.write_text", full)
    with pytest.raises(InputError, match="No space left"):
        add_place(tmp_path, [cloud(1)], PlaceOptions("p00"), tmp_path)
    assert not (tmp_path / "clouds/p00").exists()


def main(kind: Kind, out: Path) -> None:
    """For each version on standard input a child that writes from that version on until it is killed."""
    cv2.setNumThreads(1)
    warm = out.with_name("warm-" + out.name)
    kind.write(warm, 1)  # libraries are loaded before the first child begins
    start = time.perf_counter()
    kind.write(warm, 2)
    print(time.perf_counter() - start, flush=True)
    for path in out.parent.glob("warm-*"):
        shutil.rmtree(path) if path.is_dir() else path.unlink()
    for line in sys.stdin:
        version = int(line)
        process = os.fork()
        if process == 0:
            while True:
                version += 1
                kind.write(out, version)
        print(process, flush=True)
        os.waitpid(process, 0)
        print("gone", flush=True)


if __name__ == "__main__":
    main(KINDS[sys.argv[1]], Path(sys.argv[2]))
