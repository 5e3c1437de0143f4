"""Sweep recordings as folders of NumPy files, read strictly: every size is checked against the file before mapping."""

from __future__ import annotations

import mmap
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib import format as npy

from lidarpose.errors import InputError
from lidarpose.model.recording import RealArray, SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.storage.atomic import replacing, write_text
from lidarpose.storage.documents import Schema, check_format, parse, read_toml
from lidarpose.storage.npy_header import read_npy_header
from lidarpose.storage.session import LidarSection

FORMAT = "lidarpose/sweep-recording@1"
HEAD = "recording.toml"

# Readings of a turntable and beam angles beyond these are no degrees, ranges beyond no metres of any LiDAR.
_LARGEST_ANGLE_DEG = 3.6e5
_LARGEST_RANGE_M = 2000.0


class _HeadFile(Schema):
    format: Literal["lidarpose/sweep-recording@1"]
    lidar: LidarSection = LidarSection()


def is_recording(path: Path) -> bool:
    """True for a folder with a recording's head file in it."""
    return (Path(path) / HEAD).is_file()


def read_recording(folder: Path) -> SweepRecording:
    """Open a recording; its large arrays are memory maps.

    Raises
    ------
    InputError
        If a file is missing, truncated, of a wrong type or shape, or its numbers cannot be what the name says.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(folder, "no such folder", expected="the folder of a sweep recording")
    lidar = _read_head(folder / HEAD)
    arrays: dict[str, RealArray | None] = {
        name: _map_array(folder / f"{name}.npy", required=required)
        for name, required in [
            ("turntable_angle_deg", True),
            ("beam_angle_deg", True),
            ("range_m", True),
            ("intensity", False),
            ("time_s", False),
        ]
    }
    recording = _join(folder, lidar, arrays)
    _check_angles(folder / "turntable_angle_deg.npy", recording.turntable_angle_deg)
    _check_angles(folder / "beam_angle_deg.npy", recording.beam_angle_deg)
    _check_times(folder / "time_s.npy", recording.time_s)
    _check_ranges(folder / "range_m.npy", recording.range_m)
    release_pages(recording)
    return recording


def write_recording(folder: Path, recording: SweepRecording) -> None:
    """Write a recording; the head comes last, so that an interrupted write is no recording."""
    folder = Path(folder)
    if folder.exists() and not folder.is_dir():
        raise InputError(folder, "exists and is no folder", expected="a new folder or one to write into")
    arrays: dict[str, Any] = {
        "turntable_angle_deg": np.asarray(recording.turntable_angle_deg, dtype=np.float64),
        "beam_angle_deg": np.asarray(recording.beam_angle_deg, dtype=np.float64),
        "range_m": np.asarray(recording.range_m, dtype=np.float32),
        "intensity": recording.intensity,
        "time_s": recording.time_s,
    }
    (folder / HEAD).unlink(missing_ok=True)
    for name, array in arrays.items():
        path = folder / f"{name}.npy"
        if array is None:
            path.unlink(missing_ok=True)
            continue
        with replacing(path) as temporary, temporary.open("wb") as file:
            npy.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
    write_text(folder / HEAD, _head_text(recording.lidar))


def release_pages(recording: SweepRecording) -> None:
    """Give the memory of pages that were read back to the system, where the arrays are memory maps.

    The maps stay valid: pages are read again when needed. Keeps the memory of a streaming pass bounded.
    """
    for array in (recording.range_m, recording.intensity, recording.turntable_angle_deg):
        _release(array)


def _release(array: RealArray | None) -> None:
    base: Any = array
    while isinstance(base, np.ndarray):
        base = base.base
    if isinstance(base, mmap.mmap) and hasattr(mmap, "MADV_DONTNEED"):
        base.madvise(mmap.MADV_DONTNEED)


def _head_text(lidar: LidarSpec) -> str:
    lines = [f'format = "{FORMAT}"']
    if lidar.model is not None or lidar.range_sigma_m is not None:
        lines.append("[lidar]")
    if lidar.model is not None:
        escaped = lidar.model.replace("\\", "\\\\").replace('"', '\\"')
        lines.append(f'model = "{escaped}"')
    if lidar.range_sigma_m is not None:
        lines.append(f"range_sigma_m = {float(lidar.range_sigma_m)!r}")
    return "\n".join(lines) + "\n"


def _read_head(path: Path) -> LidarSpec:
    document = check_format(path, read_toml(path), FORMAT)
    return parse(path, _HeadFile, document).lidar.spec()


def _map_array(path: Path, *, required: bool) -> RealArray | None:
    if not path.exists() and not required:
        return None
    shape, fortran, dtype, start = read_npy_header(path)
    if dtype.kind not in "fiu":
        raise InputError(path, f"holds {dtype}", expected="real numbers (float32, float64 or integers)")
    if 0 in shape:
        return np.zeros(shape, dtype=dtype)
    return np.memmap(path, dtype=dtype, mode="r", offset=start, shape=shape, order="F" if fortran else "C")


def _product(shape: tuple[int, ...]) -> int:
    product = 1
    for n in shape:
        product *= int(n)
    return product


def _join(folder: Path, lidar: LidarSpec, arrays: dict[str, RealArray | None]) -> SweepRecording:
    ranges, readings, beams = arrays["range_m"], arrays["turntable_angle_deg"], arrays["beam_angle_deg"]
    assert ranges is not None
    assert readings is not None
    assert beams is not None
    if 0 in ranges.shape:
        raise InputError(folder / "range_m.npy", f"is empty, with shape {ranges.shape}", expected="(sweeps, beams)")
    if ranges.dtype.kind != "f":
        raise InputError(
            folder / "range_m.npy", f"holds {ranges.dtype}", expected="float32 metres, NaN where there is no return"
        )
    try:
        return SweepRecording(
            folder.name or str(folder), readings, beams, ranges, arrays["intensity"], arrays["time_s"], lidar
        )
    except ValueError as error:
        raise InputError(folder, str(error)) from error


def _blocks(array: RealArray) -> Any:
    """The array in blocks of some megabytes, so that checks stay small in memory."""
    step = max(1, (1 << 21) // max(1, _product(array.shape[1:])))
    for first in range(0, len(array), step):
        yield first, np.asarray(array[first : first + step])
        _release(array)


def _check_angles(path: Path, array: RealArray) -> None:
    for first, block in _blocks(array):
        bad = ~(np.abs(block) <= _LARGEST_ANGLE_DEG)
        if bad.any():
            row = first + int(np.argwhere(bad)[0][0])
            value = block[tuple(np.argwhere(bad)[0])]
            raise InputError(path, f"is {value}", field=f"entry {row}", expected="an angle in degrees")


def _check_times(path: Path, array: RealArray | None) -> None:
    if array is None:
        return
    if not np.all(np.isfinite(array)):
        raise InputError(path, "holds a number that is not finite", expected="seconds")
    backwards = np.flatnonzero(np.diff(np.asarray(array, dtype=np.float64)) < 0.0)
    if backwards.size:
        raise InputError(path, "goes back in time", field=f"entry {backwards[0] + 1}", expected="times that grow")


def _check_ranges(path: Path, array: RealArray) -> None:
    """Refuse millimetres taken for metres, from a sample of the sweeps."""
    # Runs of neighbouring sweeps: single ones all over a large file would map all of it into memory.
    run = max(1, (1 << 16) // array.shape[1])
    starts = np.unique(np.linspace(0, max(0, len(array) - run), 16).astype(np.int64))
    sample = np.concatenate([np.asarray(array[k : k + run], dtype=np.float64) for k in starts])
    valid = sample[(sample > 0.0) & np.isfinite(sample)]
    if valid.size and float(np.median(valid)) > _LARGEST_RANGE_M:
        raise InputError(
            path,
            f"has a median range of {np.median(valid):.0f}",
            expected="metres",
            remedy="If these are millimetres, divide by 1000.",
        )
