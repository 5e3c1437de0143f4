"""Damaged files for every reader: seeds, ways to damage them, and a job that tries many.

The job of bounded time, from the folder ``tests``::

    python -m tests_support.bad_bytes --runs 2000 --seed 0

It forks a child for each reader, with 512 MB beyond what the libraries need, and reports what was neither data nor one
InputError, took longer than 2 s, or killed the child.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import sys
import tempfile
import time
import traceback
from collections.abc import Callable
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import dataclass
from io import StringIO
from pathlib import Path

import cv2
import numpy as np

from lidarpose.cli.main import run
from lidarpose.errors import InputError, UndeterminedError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.camera import Camera
from lidarpose.model.cloud import Cloud
from lidarpose.model.recording import SweepRecording
from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.bag_import import ImportOptions, import_bag
from lidarpose.storage.calibration import read_calibration, write_calibration
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.camera_info import write_camera_info
from lidarpose.storage.clouds import pcd, read_cloud, write_cloud
from lidarpose.storage.exports import ExportOptions, write_export
from lidarpose.storage.images import FileImage
from lidarpose.storage.packets import read_packets
from lidarpose.storage.recording import read_recording, write_recording
from lidarpose.storage.scene import read_scene
from lidarpose.storage.session import read_scan
from tests_support import bags
from tests_support.session_folders import SCENE, load_corners, load_turntable, make_corners, make_turntable
from tests_support.velodyne import write_pcap

SECONDS = 2.0
MEGABYTES = 512

_EXTREMES = [b"\0", b"\xff", b"\x7f", b"\x80"]
_WORDS = [b"1e999", b"-1", b"0", b"99999999999999999999", b"nan", b"inf", b"4294967295", b"x", b"", b"1e-3", b"[", b"{"]


@dataclass(frozen=True)
class Reader:
    """A reader with a seed: `make` writes whole files into a folder and names the one to damage and what to read.

    `mend` puts checksums right, so that the damage reaches what lies behind them.
    """

    name: str
    make: Callable[[Path], tuple[Path, Path]]
    read: Callable[[Path], object]
    mend: Callable[[bytes], bytes] = bytes


def _cloud() -> Cloud:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(40, 3)).astype(np.float32)
    return Cloud(points, {"intensity": rng.random(40).astype(np.float32), "ring": np.arange(40, dtype=np.uint16)})


def _clouds(suffix: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        path = folder / f"a{suffix}"
        write_cloud(path, _cloud())
        return path, path

    return make


def _pcd(encoding: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        path = folder / "a.pcd"
        pcd.write_encoded(path, _cloud(), encoding)  # type: ignore[arg-type]
        return path, path

    return make


def _ascii_ply(folder: Path) -> tuple[Path, Path]:
    path = folder / "a.ply"
    head = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    path.write_text(head + "1 2 3\n4 5 6\n7 8 9\n")
    return path, path


def _bag(kind: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        message = bags.messages(kind)
        entries = [("/j", 10.0 + 0.1 * k, message.joint(10.0 + 0.1 * k, 0.1 * k)) for k in range(10)]
        entries += [("/scan", 10.2 + 0.1 * k, message.scan(10.2 + 0.1 * k, np.ones(20))) for k in range(4)]
        bag = bags.write_bag(folder, kind, entries)
        if bag.is_file():
            return bag, bag
        return next(f for f in bag.iterdir() if f.suffix in (".db3", ".mcap", ".zstd")), bag

    return make


def _cloud_bag(folder: Path) -> tuple[Path, Path]:
    rows = np.zeros(20, dtype=[("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("ring", "<u2")])
    bag = bags.write_bag(folder, "mcap", [("/p", 10.0, bags.messages("mcap").cloud(10.0, rows))])
    return next(bag.glob("*.mcap")), bag


def _import(path: Path) -> object:
    with tempfile.TemporaryDirectory() as out:
        return import_bag(path, Path(out) / "out", ImportOptions())


CAMERA = Camera(64, 48, np.array([[50.0, 0, 32], [0, 50, 24], [0, 0, 1]]), "plumb_bob", np.array([0.1, 0, 0, 0, 0]))


def _calibration() -> TurntableCalibration:
    motion = TurntableMotion.from_any_frame(Pose.exp([0.1, 0.2, 0.3, 1, 0, 0]), Pose.exp([0.1, 0, 0, 0, 1, 0]))
    return TurntableCalibration(motion, np.eye(10) * 1e-8)


def _camera_yaml(folder: Path) -> tuple[Path, Path]:
    write_camera_info(folder / "c.yaml", CAMERA)
    return folder / "c.yaml", folder / "c.yaml"


def _exported_camera(to: str, name: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        write_export(folder / name, _calibration(), to, ExportOptions(camera=CAMERA))
        return folder / name, folder / name

    return make


def _calibration_json(folder: Path) -> tuple[Path, Path]:
    write_calibration(folder / "c.json", _calibration())
    return folder / "c.json", folder / "c.json"


def _scan_csv(folder: Path) -> tuple[Path, Path]:
    (folder / "s.csv").write_text("angle_deg,range_m,intensity,sweep\n0,1,2,0\n1,,2,0\n0,1.5,,1\n1,1e0,3,1\n")
    return folder / "s.csv", folder / "s.csv"


def _recording(damaged: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        ranges = np.ones((4, 5), dtype=np.float32)
        write_recording(
            folder / "r", SweepRecording("r", np.arange(4.0), np.arange(5.0), ranges, ranges, np.arange(4.0))
        )
        return folder / "r" / damaged, folder / "r"

    return make


def _png(folder: Path) -> tuple[Path, Path]:
    rng = np.random.default_rng(0)
    cv2.imwrite(str(folder / "i.png"), rng.integers(0, 255, (48, 64)).astype(np.uint8))
    return folder / "i.png", folder / "i.png"


def _pcap(folder: Path) -> tuple[Path, Path]:
    write_pcap(folder / "v.pcap", turns=2)
    return folder / "v.pcap", folder / "v.pcap"


def _turntable(damaged: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        session = make_turntable(folder)
        return session / damaged, session

    return make


def _corners(damaged: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        session = make_corners(folder)
        return session / damaged, session

    return make


def _command(*words: str) -> Callable[[Path], object]:
    """A whole command in this process, with `@` for the damaged folder: it ends with one of its own statuses."""

    def run_it(target: Path) -> object:
        with tempfile.TemporaryDirectory() as out, redirect_stdout(StringIO()), redirect_stderr(StringIO()):
            names = {"@": str(target), "OUT": f"{out}/out", "CLOUD": f"{out}/a.ply"}
            names["CALIBRATION"] = str(target.parent / "c.json")
            status = run([names.get(word, word) for word in words])
        assert status in (0, 1, 2)
        return status

    return run_it


def _recording_and_calibration(folder: Path) -> tuple[Path, Path]:
    write_calibration(folder / "c.json", _calibration())
    return _recording("range_m.npy")(folder)


def _scene(folder: Path) -> tuple[Path, Path]:
    (folder / "scene.toml").write_text(SCENE)
    return folder / "scene.toml", folder / "scene.toml"


def _metadata(kind: str) -> Callable[[Path], tuple[Path, Path]]:
    def make(folder: Path) -> tuple[Path, Path]:
        bag = _bag(kind)(folder)[1]
        return bag / "metadata.yaml", bag

    return make


def _transforms_json(folder: Path) -> tuple[Path, Path]:
    pose = {"translation_m": [0.1, 0, 1e-3], "quaternion_xyzw": [0, 0, 0, 1]}
    document = {"format": "lidarpose/calibration@1", "kind": "world", "scale": 1.0}
    document["transforms"] = [{"parent": "world", "child": "lidar", **pose}]
    (folder / "t.json").write_text(json.dumps(document))
    return folder / "t.json", folder / "t.json"


def _crc32c_table() -> list[int]:
    table = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ (0x82F63B78 if value & 1 else 0)
        table.append(value)
    return table


_CRC32C = _crc32c_table()


def mend_e57(data: bytes) -> bytes:
    """The right checksum for every page of 1024 bytes (ASTM E2807: CRC-32C of 1020 bytes, big-endian)."""
    pages = []
    for start in range(0, len(data) - 1023, 1024):
        page, crc = data[start : start + 1020], 0xFFFFFFFF
        for byte in page:
            crc = _CRC32C[(crc ^ byte) & 255] ^ (crc >> 8)
        pages.append(page + (crc ^ 0xFFFFFFFF).to_bytes(4, "big"))
    return b"".join(pages)


_TURNTABLE_FILES = (
    "session.toml",
    "positions.csv",
    "camera.yaml",
    "scans/0.csv",
    "stripes/0.png",
    "board/here/00.png",
)
_RECORDING_FILES = ("range_m.npy", "turntable_angle_deg.npy", "beam_angle_deg.npy", "time_s.npy", "recording.toml")

READERS = [
    *(Reader(f"cloud{s}", _clouds(s), read_cloud) for s in (".ply", ".pcd", ".las", ".laz", ".e57", ".npy", ".xyz")),
    *(Reader(f"pcd {e}", _pcd(e), read_cloud) for e in ("ascii", "binary_compressed")),
    Reader("e57 with checksums", _clouds(".e57"), read_cloud, mend_e57),
    Reader("ply ascii", _ascii_ply, read_cloud),
    *(Reader(f"bag {k}", _bag(k), _import) for k in bags.KINDS),
    *(Reader(f"metadata {k}", _metadata(k), _import) for k in ("sqlite3", "sqlite3-zstd-file", "mcap")),
    Reader("bag clouds", _cloud_bag, _import),
    Reader("camera_info", _camera_yaml, read_camera),
    Reader("opencv yaml", _exported_camera("opencv", "c.yml"), read_camera),
    Reader("opencv xml", _exported_camera("opencv", "c.xml"), read_camera),
    Reader("kalibr", _exported_camera("kalibr", "c.yaml"), read_camera),
    Reader("calibration", _calibration_json, read_calibration),
    Reader("transforms alone", _transforms_json, read_calibration),
    Reader("scan csv", _scan_csv, read_scan),
    Reader("scene", _scene, read_scene),
    *(Reader(f"session {n}", _turntable(n), load_turntable) for n in _TURNTABLE_FILES),
    Reader("session truth", _turntable("../session.truth.json"), load_turntable),
    *(Reader(f"corners {n}", _corners(n), load_corners) for n in ("session.toml", "positions.csv", "clouds/p0/0.pcd")),
    *(Reader(f"recording {n}", _recording(n), read_recording) for n in _RECORDING_FILES),
    Reader("inspect positions.csv", _turntable("positions.csv"), _command("inspect", "@", "--quiet")),
    Reader("calibrate scans/0.csv", _turntable("scans/0.csv"), _command("calibrate", "@", "-o", "OUT", "--quiet")),
    Reader("calibrate clouds", _corners("clouds/p0/0.pcd"), _command("calibrate", "@", "-o", "OUT", "--quiet")),
    Reader("scan", _recording_and_calibration, _command("scan", "@", "CALIBRATION", "-o", "CLOUD")),
    Reader("image", _png, lambda path: FileImage(path, "i.png", 64, 48).load()),
    Reader("packets", _pcap, lambda path: list(read_packets(path))),
]


def damage(data: bytes, rng: np.random.Generator) -> bytes:
    """One to four wounds: bytes changed, cut, doubled or removed, counts and numbers made extreme; or mere noise."""
    if rng.random() < 0.05:
        return rng.bytes(int(rng.integers(0, 300)))
    out = bytearray(data)
    for _ in range(int(rng.integers(1, 5))):
        at = int(rng.integers(0, len(out) + 1))
        if rng.random() < 0.4:  # headers stand at the front
            at = min(at, int(rng.integers(0, 400)))
        kind = rng.integers(0, 7)
        if kind == 0:
            out[at : at + 1] = rng.bytes(1)
        elif kind == 1:
            del out[at:]
        elif kind in (2, 3):
            width = int(rng.choice([1, 2, 4, 8]))
            out[at : at + width] = _EXTREMES[int(rng.integers(len(_EXTREMES)))] * width
        elif kind == 4:
            out[at:at] = out[at : at + int(rng.integers(1, 60))]
        elif kind == 5:
            del out[at : at + int(rng.integers(1, 60))]
        else:
            _replace_number(out, at, _WORDS[int(rng.integers(len(_WORDS)))])
    return bytes(out)


def _replace_number(out: bytearray, at: int, word: bytes) -> None:
    digits = b"0123456789.-e+"
    while at < len(out) and out[at] not in digits:
        at += 1
    end = at
    while end < len(out) and out[end] in digits:
        end += 1
    out[at:end] = word


def try_reading(reader: Reader, path: Path, target: Path, data: bytes) -> None:
    """Read damaged bytes: data or one InputError (UndeterminedError where a reader may say so), or this raises."""
    path.write_bytes(reader.mend(data))
    try:
        reader.read(target)
    except InputError as error:
        if not str(error) or "\n" in error.where:
            raise AssertionError("the message names no file") from error
    except UndeterminedError:
        pass


def _child(reader: Reader, runs: int, seed: int, report: Path) -> None:
    rng = np.random.default_rng(seed)
    counts = {"data": 0, "refused": 0, "bad": 0, "slowest_s": 0.0}
    problems: list[str] = []
    with tempfile.TemporaryDirectory() as folder:
        path, target = reader.make(Path(folder))
        whole = path.read_bytes()
        reader.read(target)  # libraries are loaded before memory is limited
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + (MEGABYTES << 20),) * 2)
        for run in range(runs):
            data = reader.mend(damage(whole, rng))
            (report.with_suffix(".last")).write_bytes(data)
            start = time.process_time()
            path.write_bytes(data)
            try:
                reader.read(target)
                counts["data"] += 1
            except InputError:
                counts["refused"] += 1
            except BaseException:
                counts["bad"] += 1
                problems.append(f"run {run}: {traceback.format_exc(limit=-4)}")
            took = time.process_time() - start
            counts["slowest_s"] = max(counts["slowest_s"], took)
            if took > SECONDS:
                counts["bad"] += 1
                problems.append(f"run {run}: {took:.1f} s")
                report.with_suffix(".slow").write_bytes(data)
    report.write_text(json.dumps({**counts, "problems": problems[:3]}))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", default="")
    parser.add_argument("--write", type=Path, help="put the figures into this page, between its marks")
    options = parser.parse_args()
    bad = 0
    total = 0
    table = []
    with tempfile.TemporaryDirectory() as folder:
        for index, reader in enumerate(reader for reader in READERS if options.only in reader.name):
            report = Path(folder) / f"{index}.json"
            process = os.fork()
            if process == 0:
                sys.stderr.flush()
                _child(reader, options.runs, options.seed + index, report)
                os._exit(0)
            _, status = os.waitpid(process, 0)
            if status or not report.exists():
                last = report.with_suffix(".last")
                kept = Path(tempfile.gettempdir()) / f"killed-{reader.name.replace(' ', '-')}"
                kept.write_bytes(last.read_bytes() if last.exists() else b"")
                print(f"{reader.name:24} KILLED by status {status}; the bytes are in {kept}")
                bad += 1
                continue
            found = json.loads(report.read_text())
            bad += found["bad"]
            total += options.runs
            line = f"{found['data']:6} data {found['refused']:6} refused {found['bad']:4} bad"
            table.append((reader.name, found["data"], found["refused"], found["bad"], found["slowest_s"]))
            print(f"{reader.name:24} {line}, slowest {found['slowest_s']:.2f} s", flush=True)
            for problem in found["problems"]:
                print("    " + problem.replace("\n", "\n    "))
            for slow in Path(folder).glob("*.slow"):
                slow.rename(Path(tempfile.gettempdir()) / f"slow-{reader.name.replace(' ', '-')}")
    print(f"{total} runs, {bad} bad")
    if options.write is not None:
        write_figures(options.write, "bad_bytes", _figures(table, total, bad))
    return bad > 0


def _figures(table: list[tuple[str, int, int, int, float]], total: int, bad: int) -> str:
    rows = [
        f"| {name} | {data} | {refused} | {wrong} | {slowest:.2f} |" for name, data, refused, wrong, slowest in table
    ]
    head = ["| reader | data | refused | anything else | slowest s |", "|---|---|---|---|---|"]
    summary = (
        f"{total} damaged files; {bad} times anything else than data or one `InputError`, or beyond 2 s or 512 MB."
    )
    return "\n".join([summary, "", *head, *rows])


def write_figures(page: Path, name: str, text: str) -> None:
    """Put a text between the marks `<!-- NAME -->` and `<!-- /NAME -->` of a page."""
    before, mark, rest = page.read_text(encoding="utf-8").partition(f"<!-- {name} -->\n")
    _, end, after = rest.partition(f"<!-- /{name} -->")
    if not (mark and end):
        raise SystemExit(f"{page} has no marks for {name}")
    page.write_text(f"{before}{mark}{text}\n{end}{after}", encoding="utf-8")


if __name__ == "__main__":
    sys.exit(main())
