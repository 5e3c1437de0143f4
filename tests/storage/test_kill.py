"""Outputs are whole or absent when the process is killed at any moment, and what it left is cleaned by the next one."""

from __future__ import annotations

import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.atomic import replacing_folder
from lidarpose.storage.calibration import read_calibration, write_calibration
from lidarpose.storage.cloud_import import PlaceOptions, add_place
from lidarpose.storage.clouds import read_cloud, write_cloud
from lidarpose.storage.exports import ExportOptions, write_export
from lidarpose.storage.recording import read_recording, write_recording

RUNS = 40
POINTS = 60_000


def cloud(version: int) -> Cloud:
    mark = version % 100 + 1
    points = np.full((POINTS, 3), float(mark), dtype=np.float32)
    return Cloud(points, {"ring": np.full(POINTS, mark, dtype=np.uint16)})


def calibration(version: int) -> TurntableCalibration:
    motion = TurntableMotion.from_any_frame(Pose.exp([version, 0, 0, 0, 0, 0]), Pose.identity())
    return TurntableCalibration(motion, np.eye(10) * 1e-8)


def write(kind: str, out: Path, version: int) -> None:
    """Write version after version of an output, as a user does who starts the program again and again."""
    if kind.startswith("cloud"):
        write_cloud(out, cloud(version))
    elif kind == "calibration":
        write_calibration(out, calibration(version))
    elif kind.startswith("export"):
        write_export(out, calibration(version), kind.split()[1], ExportOptions(angles_rad=(0.1, 0.2, 0.3)))
    elif kind == "recording":
        mark = float(version % 100 + 1)
        ranges, angles = np.full((200, 300), mark, dtype=np.float32), np.full(200, mark)
        with replacing_folder(out) as folder:
            write_recording(folder, SweepRecording("r", angles, np.arange(300.0), ranges))
    else:
        add_place(out, [cloud(version)] * 3, PlaceOptions(f"p{version:05d}", (1.0, 2.0, float(version))), out)


def check(kind: str, out: Path) -> None:
    """Whole: all of one version."""
    if kind.startswith("cloud"):
        found = read_cloud(out)
        assert len(found) == POINTS
        assert np.unique(found.points.round(3)).tolist() == np.unique(found.fields["ring"]).tolist()
    elif kind == "calibration":
        read_calibration(out)
    elif kind.startswith("export"):
        text = out.read_text()
        assert len(text.splitlines()) == 6 if kind == "export csv" else text.endswith("</robot>\n")
    elif kind == "recording":
        read = read_recording(out)
        assert np.unique(read.range_m).tolist() == np.unique(read.turntable_angle_deg).tolist()
    else:
        lines = (out / "positions.csv").read_text().splitlines()[1:]
        places = [line.split(",")[0] for line in lines]
        for place in places[-2:]:
            assert all(len(read_cloud(out / f"clouds/{place}/{k:03d}.pcd")) == POINTS for k in range(3))


KINDS = {
    "cloud .ply": "a.ply", "cloud .pcd": "a.pcd", "cloud .las": "a.las", "cloud .laz": "a.laz", "cloud .e57": "a.e57",
    "cloud .npy": "a.npy", "calibration": "c.json", "export urdf": "c.urdf", "export csv": "c.csv",
    "recording": "r", "corner session": "s",
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_killed_at_any_moment(kind: str, tmp_path: Path) -> None:
    rng = random.Random(kind)
    out = tmp_path / KINDS[kind]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "OMP_NUM_THREADS": "1"}
    command = [sys.executable, __file__, kind, os.fspath(out)]
    with subprocess.Popen(command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as parent:
        assert parent.stdin is not None
        assert parent.stdout is not None
        for run in range(RUNS):
            print(run * 1000, file=parent.stdin, flush=True)
            process = int(parent.stdout.readline())  # a child that writes and writes
            time.sleep(rng.uniform(0.0, 0.08))
            os.kill(process, signal.SIGKILL)
            assert parent.stdout.readline() == "gone\n"
            if out.exists() and (kind != "corner session" or (out / "positions.csv").exists()):
                check(kind, out)
        parent.stdin.close()
    assert out.exists()
    # The next run that ends well leaves nothing of the killed ones.
    write(kind, out, 999_999 if kind != "corner session" else 99_999)
    check(kind, out)
    left = [path.name for path in tmp_path.iterdir() if path != out]
    assert left == []


def main(kind: str, out: Path) -> None:
    """For each version on standard input a child that writes from that version on until it is killed."""
    warm = out.with_name("warm-" + out.name)
    write(kind, warm, 1)  # libraries are loaded before the first child begins
    shutil.rmtree(warm) if warm.is_dir() else warm.unlink()
    for line in sys.stdin:
        version = int(line)
        process = os.fork()
        if process == 0:
            while True:
                version += 1
                write(kind, out, version)
        print(process, flush=True)
        os.waitpid(process, 0)
        print("gone", flush=True)


if __name__ == "__main__":
    main(sys.argv[1], Path(sys.argv[2]))
