"""Folders and files made to hurt: absurd sizes, loops, names that lead out. Each is read in a child with limits.

    python -m tests_support.hostile [NAME ...]

prints a line of JSON for each case: how it ended, the message, and seconds of the processor.
"""

from __future__ import annotations

import json
import os
import resource
import signal
import struct
import sys
import tempfile
import time
import traceback
import zlib
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from lidarpose.errors import LidarposeError
from lidarpose.storage.calibration import read_calibration
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.images import FileImage
from lidarpose.storage.recording import read_recording
from lidarpose.storage.scene import read_scene
from tests_support.session_folders import SCENE, load_corners, load_turntable, make_corners, make_turntable

SECONDS = 2
MEGABYTES = 512

Case = Callable[[Path], Callable[[], object]]
CASES: dict[str, Case] = {}


def _of(make: Callable[..., Callable[[], object]], *arguments: object) -> Case:
    """A case made by a function of the folder and these arguments."""
    return lambda folder: make(folder, *arguments)


def _of_text(name: str, text: Callable[[], str | bytes]) -> Case:
    """A turntable session with a file of its own, whose text is made when it is wanted."""
    return lambda folder: _turntable_with(folder, name, text())


def case(function: Case) -> Case:
    CASES[function.__name__] = function
    return function


def _turntable_with(folder: Path, name: str, text: str | bytes) -> Callable[[], object]:
    session = make_turntable(folder)
    (session / name).write_bytes(text if isinstance(text, bytes) else text.encode())
    return lambda: load_turntable(session)


def _edited(folder: Path, name: str, before: str, after: str) -> Callable[[], object]:
    session = make_turntable(folder)
    text = (session / name).read_text()
    assert before in text
    (session / name).write_text(text.replace(before, after))
    return lambda: load_turntable(session)


def _corners_edited(folder: Path, before: str, after: str) -> Callable[[], object]:
    session = make_corners(folder)
    text = (session / "positions.csv").read_text()
    assert before in text
    (session / "positions.csv").write_text(text.replace(before, after))
    return lambda: load_corners(session)


for _name, _text in {
    "scan_of_one_long_line": lambda: "angle_deg,range_m\n" + "1," * 15_000_000,
    "scan_of_one_long_number": lambda: "angle_deg,range_m\n0," + "1" * 30_000_000 + "\n",
    "scan_of_empty_lines": lambda: "angle_deg,range_m\n" + "\n" * 30_000_000,
    "scan_of_commas": lambda: "angle_deg,range_m\n" + "," * 30_000_000,
    "scan_with_a_long_header": lambda: "angle_deg,range_m," + "x" * 30_000_000,
    "scan_of_quotes": lambda: 'angle_deg,range_m\n0,"' + '""' * 5_000_000,
    "scan_of_huge_numbers": lambda: "angle_deg,range_m\n" + "1e400,1e400\n" * 400_000,
    "scan_with_one_bad_line_in_the_end": lambda: (
        "angle_deg,range_m\n" + "".join(f"{k * 1e-4:.4f},1.5\n" for k in range(400_000)) + "x,y\n"
    ),
}.items():
    CASES[_name] = _of_text("scans/0.csv", _text)

for _name, _text in {
    "positions_of_one_long_line": lambda: "position," * 400_000,
    "positions_of_a_million_rows": lambda: (
        "position,turntable_angle_deg,stripe_image,scan\n" + "".join(f"{k},{k},a,s\n" for k in range(150_000))
    ),
    "positions_of_quotes": lambda: 'position,"' + '""' * 5_000_000,
}.items():
    CASES[_name] = _of_text("positions.csv", _text)

for _name, _text in {
    "toml_of_brackets": lambda: "x = " + "[" * 60_000,
    "toml_of_tables": lambda: "x = " + "{a=" * 20_000,
    "toml_of_dots": lambda: "a" + ".a" * 30_000 + " = 1",
    "toml_of_many_keys": lambda: "".join(f"a{k} = 1\n" for k in range(5_000)),
    "toml_with_a_huge_integer": lambda: "square_m = " + "9" * 60_000,
    "toml_of_sixteen_megabytes": lambda: 'x = "' + "a" * (1 << 20) + '"',
    "toml_of_headers": lambda: "".join(f"[a{k}.b.c]\n" for k in range(4_000)),
}.items():
    CASES[_name] = _of_text("session.toml", _text)

for _name, _text in {
    "yaml_billion_laughs": lambda: (
        "a0: &a0 [x, x]\n" + "".join(f"a{k}: &a{k} [*a{k - 1}, *a{k - 1}, *a{k - 1}]\n" for k in range(1, 40))
    ),
    "yaml_laughs_in_the_camera": lambda: (
        "image_width: 64\nimage_height: 48\na0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
        + "".join(f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 9)}]\n" for k in range(1, 12))
        + "camera_matrix: {rows: 3, cols: 3, data: *a11}\ndistortion_model: plumb_bob\n"
    ),
    "yaml_of_brackets": lambda: "a: " + "[" * 60_000,
    "yaml_of_itself": lambda: "camera_matrix: &a\n  data: *a\nimage_width: 64\n",
    "yaml_with_a_huge_integer": lambda: "image_width: " + "9" * 60_000,
    "yaml_with_an_object": lambda: "image_width: !!python/object/apply:os.system ['true']\n",
    "yaml_of_merges": lambda: "a: &a {x: 1}\n" + "".join(f"b{k}:\n  <<: *a\n" for k in range(3_000)),
}.items():
    CASES[_name] = _of_text("camera.yaml", _text)


def _camera(folder: Path, name: str, text: str) -> Callable[[], object]:
    (folder / name).write_text(text)
    return lambda: read_camera(folder / name)


@case
def xml_billion_laughs(folder: Path) -> Callable[[], object]:
    entities = "".join(f'<!ENTITY a{k} "&a{k - 1};&a{k - 1};&a{k - 1};">' for k in range(1, 40))
    text = f'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a0 "x">{entities}]><opencv_storage>&a39;</opencv_storage>'
    return _camera(folder, "c.xml", text)


@case
def xml_of_elements(folder: Path) -> Callable[[], object]:
    return _camera(folder, "c.xml", "<opencv_storage>" + "<a>" * 80_000)


@case
def xml_of_numbers(folder: Path) -> Callable[[], object]:
    data = "1 " * 120_000
    matrix = f"<camera_matrix><data>{data}</data></camera_matrix>"
    return _camera(folder, "c.xml", f"<opencv_storage>{matrix}</opencv_storage>")


def _json(folder: Path, text: str) -> Callable[[], object]:
    (folder / "c.json").write_text(text)
    return lambda: read_calibration(folder / "c.json")


for _name, _text in {
    "json_of_brackets": lambda: "[" * 8_000_000,
    "json_of_lists": lambda: "[" + "[]," * 2_500_000 + "[]]",
    "json_of_objects": lambda: '{"a":[' + "{}," * 2_500_000 + "{}]}",
    "json_of_keys": lambda: "{" + ",".join(f'"{k:x}":0' for k in range(700_000)) + "}",
    "json_with_a_huge_integer": lambda: '{"scale": ' + "9" * 8_000_000 + "}",
    "json_with_nan": lambda: '{"scale": NaN}',
    "json_with_a_wide_covariance": lambda: (
        '{"format": "lidarpose/calibration@1", "kind": "world", "transforms": [{"parent": "world", "child": "lidar", '
        '"translation_m": [0, 0, 0], "quaternion_xyzw": [0, 0, 0, 1]}], "parameters": {"names": [], "covariance": ['
        + "[0],[]," * 900_000
        + "[]]}}"
    ),
    "json_with_a_matrix_of_1e308": lambda: (
        '{"format": "lidarpose/calibration@1", "kind": "world", "transforms": [{"parent": "world", "child": "lidar", '
        '"translation_m": [1e308, -1e308, 1e308], "quaternion_xyzw": [1e308, 1e308, 1e308, 1e308]}]}'
    ),
}.items():
    CASES[_name] = _of(lambda folder, text: _json(folder, text()), _text)


def _png_header(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    body = zlib.compress(b"\0" * 10_000_000, 9)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", body) + chunk(b"IEND", b"")


def _tiff_header(width: int, height: int) -> bytes:
    entries = [(256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8), (259, 3, 1, 1), (262, 3, 1, 1)]
    entries += [(273, 4, 1, 8), (277, 3, 1, 1), (278, 4, 1, height), (279, 4, 1, width * height & 0xFFFFFFFF)]
    directory = b"".join(struct.pack("<HHII", *entry) for entry in entries)
    return b"II*\0" + struct.pack("<IH", 8, len(entries)) + directory + bytes(4) + bytes(1000)


def _bmp_header(width: int, height: int) -> bytes:
    numbers = (1078, 0, 0, 54, 40, width, height, 1, 24, 0, 0, 0, 0, 0, 0)
    return b"BM" + struct.pack("<IHHIIiiHHIIiiII", *numbers) + bytes(999)


def _stripe(folder: Path, data: bytes, name: str = "stripes/0.png") -> Callable[[], object]:
    return _turntable_with(folder, name, data)


for _name, _data in {
    "png_of_60000": lambda: _png_header(60_000, 60_000),
    "png_of_two_billion": lambda: _png_header(2**31 - 1, 1),
    "tiff_of_60000": lambda: _tiff_header(60_000, 60_000),
    "tiff_of_30000": lambda: _tiff_header(30_000, 30_000),
    "bmp_of_60000": lambda: _bmp_header(60_000, 60_000),
    "jpeg_of_60000": lambda: (
        cv2.imencode(".jpg", np.zeros((48, 64), np.uint8))[1].tobytes().replace(b"\0\x30\0\x40", b"\xea\x60\xea\x60", 1)
    ),
    "pgm_of_60000": lambda: b"P5 60000 60000 255\n" + bytes(1000),
    "image_of_300_megabytes": lambda: b"\x89PNG\r\n\x1a\n" + bytes(30 << 20),
    "hdr_of_60000": lambda: b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 60000 +X 60000\n" + bytes(1000),
    "sun_raster_of_60000": lambda: struct.pack(">8I", 0x59A66A95, 60_000, 60_000, 8, 0, 1, 0, 0) + bytes(1000),
}.items():
    CASES[_name] = _of(lambda folder, data: _stripe(folder, data()), _data)

for _name, _file, _before, _after in (
    ("name_that_leads_out", "session.toml", '"camera.yaml"', '"../camera.yaml"'),
    ("absolute_name", "session.toml", '"positions.csv"', '"/etc/passwd"'),
    ("name_of_nothing", "session.toml", '"camera.yaml"', '""'),
    ("name_of_the_folder", "session.toml", '"camera.yaml"', '"."'),
    ("long_name", "session.toml", '"camera.yaml"', '"' + "a" * 60_000 + '"'),
    ("name_with_a_zero", "session.toml", '"camera.yaml"', '"camera\\u0000.yaml"'),
    ("pattern_that_leads_out", "session.toml", '"board/*.png"', '"../*/*.png"'),
    ("pattern_of_stars", "session.toml", '"board/*.png"', '"' + "**/" * 3000 + '*.png"'),
    ("pattern_of_two_stars_and_more", "session.toml", '"board/*.png"', '"**a/*.png"'),
    ("pattern_with_a_zero", "session.toml", '"board/*.png"', '"board/\\u0000*.png"'),
    ("pattern_of_brackets", "session.toml", '"board/*.png"', '"board/' + "[a-z]*" * 3000 + '.png"'),
    ("pattern_of_nothing", "session.toml", '"board/*.png"', '"."'),
    ("long_pattern", "session.toml", '"board/*.png"', '"board/' + "a" * 60_000 + '.png"'),
    ("image_that_leads_out", "positions.csv", "stripes/0.png", "../session.truth.json"),
    ("absolute_scan", "positions.csv", "scans/0.csv", "/etc/passwd"),
    ("scan_with_a_long_name", "positions.csv", "scans/0.csv", "s" * 60_000),
    ("scan_with_a_zero", "positions.csv", "scans/0.csv", "s\0.csv"),
    ("placement_that_leads_out", "positions.csv", ",here", ",.."),
    ("placement_with_a_long_name", "positions.csv", ",here", "," + "h" * 60_000),
    ("placement_of_stars", "positions.csv", ",here", ",**"),
    ("angle_of_a_thousand_digits", "positions.csv", "0,0,", "0," + "9" * 100_000 + ","),
):
    CASES[_name] = _of(_edited, _file, _before, _after)

for _name, _before, _after in (
    ("clouds_that_lead_out", "clouds/p0/*.pcd", "../../*/*.pcd"),
    ("absolute_clouds", "clouds/p0/*.pcd", "/tmp/*.pcd"),
    ("clouds_with_a_zero", "clouds/p0/*.pcd", "clouds/\0*.pcd"),
    ("clouds_of_two_stars_and_more", "clouds/p0/*.pcd", "**p0/*.pcd"),
    ("clouds_of_stars", "clouds/p0/*.pcd", "**/" * 3000 + "*.pcd"),
    ("clouds_of_nothing", "clouds/p0/*.pcd", "."),
    ("clouds_with_a_long_name", "clouds/p0/*.pcd", "c" * 60_000),
    ("world_of_1e300", "0,1.5,0", "1e300,1.5,0"),
):
    CASES[_name] = _of(_corners_edited, _before, _after)


@case
def session_that_is_a_loop(folder: Path) -> Callable[[], object]:
    (folder / "a").symlink_to(folder / "b")
    (folder / "b").symlink_to(folder / "a")
    return lambda: load_turntable(folder / "a")


def _replaced(folder: Path, name: str, make: Callable[[Path], object]) -> Callable[[], object]:
    session = make_turntable(folder)
    (session / name).unlink()
    make(session / name)
    return lambda: load_turntable(session)


for _name in ("session.toml", "camera.yaml", "positions.csv", "scans/0.csv", "stripes/0.png"):
    _word = Path(_name).name.replace(".", "_")
    CASES[f"loop_for_{_word}"] = _of(_replaced, _name, lambda path: path.symlink_to(path))
    CASES[f"folder_for_{_word}"] = _of(_replaced, _name, Path.mkdir)
    CASES[f"pipe_for_{_word}"] = _of(_replaced, _name, os.mkfifo)
    CASES[f"device_for_{_word}"] = _of(_replaced, _name, lambda path: path.symlink_to("/dev/zero"))


@case
def cloud_that_is_a_loop(folder: Path) -> Callable[[], object]:
    session = make_corners(folder)
    (session / "clouds/p0/0.pcd").unlink()
    (session / "clouds/p0/0.pcd").symlink_to(session / "clouds/p0/0.pcd")
    return lambda: load_corners(session)


@case
def folders_in_a_loop(folder: Path) -> Callable[[], object]:
    action = _corners_edited(folder, "clouds/p0/*.pcd", "**/*.pcd")
    for k in range(3):
        (folder / "corners" / "clouds" / f"again{k}").symlink_to(folder / "corners")
    return action


def _npy(path: Path, shape: str, descr: str = "<f4", data: bytes = b"") -> None:
    head = f"{{'descr': '{descr}', 'fortran_order': False, 'shape': {shape}, }}".encode()
    head += b" " * (-(len(head) + 11) % 64) + b"\n"
    path.write_bytes(b"\x93NUMPY\x01\0" + struct.pack("<H", len(head)) + head + data)


def _recording(folder: Path, shape: str, descr: str = "<f4", data: bytes = b"") -> Callable[[], object]:
    (folder / "recording.toml").write_text('format = "lidarpose/sweep-recording@1"\n')
    _npy(folder / "turntable_angle_deg.npy", "(4,)", "<f8", np.arange(4.0).tobytes())
    _npy(folder / "beam_angle_deg.npy", "(5,)", "<f8", np.arange(5.0).tobytes())
    _npy(folder / "range_m.npy", shape, descr, data)
    return lambda: read_recording(folder)


for _name, _shape, _descr in (
    ("recording_of_1e9_beams", "(4, 1000000000)", "<f4"),
    ("recording_of_1e18_beams", "(1000000000, 1000000000)", "<f4"),
    ("recording_of_minus_one", "(-1, -1)", "<f4"),
    ("recording_of_objects", "(4, 5)", "|O"),
    ("recording_of_text", "(4, 5)", "<U1000000"),
    ("recording_of_complex_numbers", "(4, 5)", "<c16"),
    ("recording_of_nothing", "(0, 0)", "<f4"),
    ("recording_of_many_axes", "(" + "1, " * 3000 + ")", "<f4"),
):
    CASES[_name] = _of(_recording, _shape, _descr)


@case
def recording_with_a_hole_of_a_terabyte(folder: Path) -> Callable[[], object]:
    action = _recording(folder, "(4, 60000000000)")
    os.truncate(folder / "range_m.npy", 128 + 4 * 4 * 60_000_000_000)
    return action


@case
def scene_of_a_million_disks(folder: Path) -> Callable[[], object]:
    (folder / "s.toml").write_text(SCENE + "[[disks]]\ncentre_m = [0, 0, 1]\ndiameter_m = 0.1\n" * 250_000)
    return lambda: read_scene(folder / "s.toml")


@case
def image_whose_camera_is_huge(folder: Path) -> Callable[[], object]:
    (folder / "i.png").write_bytes(_png_header(60_000, 60_000))
    return lambda: FileImage(folder / "i.png", "i.png", 60_000, 60_000).load()


def _limited(action: Callable[[], object]) -> dict[str, object]:
    """How an action ends that may take so much memory; what making its files took does not count."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + (MEGABYTES << 20),) * 2)
    spent = time.process_time()
    signal.setitimer(signal.ITIMER_PROF, 5.0 * SECONDS)  # ends a reader that never comes back
    try:
        action()
        end, message = "data", ""
    except LidarposeError as error:
        end, message = type(error).__name__, str(error)
    except BaseException:
        end, message = "bad", traceback.format_exc(limit=-3)
    return {"end": end, "message": message[:50_000], "seconds": time.process_time() - spent}


def attempt(name: str) -> dict[str, object]:
    """Make a case and read it, both in a child."""
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report"
        process = os.fork()
        if process == 0:
            (Path(folder) / "case").mkdir()
            result = _limited(CASES[name](Path(folder) / "case"))
            report.write_text(json.dumps(result))
            os._exit(0)
        _, status = os.waitpid(process, 0)
        return json.loads(report.read_text()) if report.exists() else {"end": "killed", "message": f"status {status}"}


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:  # libraries are loaded before memory is limited
        load_turntable(make_turntable(Path(folder)))
        load_corners(make_corners(Path(folder)))
        with suppress(LidarposeError):
            _camera(Path(folder), "x.xml", "<a>")()
        _recording(Path(folder), "(4, 5)", "<f4", np.ones((4, 5), np.float32).tobytes())()
    for name in sys.argv[1:] or CASES:
        sys.stdout.flush()
        print(json.dumps({"case": name, **attempt(name)}), flush=True)


if __name__ == "__main__":
    main()
