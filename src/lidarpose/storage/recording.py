"""Sweep recordings as folders of NumPy files, read strictly: every size is checked against the file before mapping."""

from __future__ import annotations

import json
import mmap
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.lib import format as npy

from lidarpose.errors import InputError
from lidarpose.model.calibration import TurntableCalibration
from lidarpose.model.recording import RealArray, SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.model.turntable import PARAMETER_NAMES, TurntableMotion
from lidarpose.storage.atomic import replacing_folder, restore_folder, write_text
from lidarpose.storage.calibration import transform_entry, write_calibration
from lidarpose.storage.documents import check_format, read_toml
from lidarpose.storage.npy_header import read_npy_header
from lidarpose.storage.recording_head import HEAD
from lidarpose.storage.sections import read_sections
from lidarpose.storage.session import LidarSection
from lidarpose.storage.session_folder import check_free
from lidarpose.storage.truth import truth_path

FORMAT = "lidarpose/sweep-recording@1"

_ARRAYS = ("turntable_angle_deg", "beam_angle_deg", "range_m", "intensity", "time_s")
_FILES = {HEAD, *(f"{name}.npy" for name in _ARRAYS)}

# Readings of a turntable and beam angles beyond these are no degrees, ranges beyond no metres of any LiDAR.
_LARGEST_ANGLE_DEG = 3.6e5
_LARGEST_RANGE_M = 2000.0


@dataclass(frozen=True)
class _HeadFile:
    format: Literal["lidarpose/sweep-recording@1"]
    lidar: LidarSection = field(default_factory=LidarSection)


def recording_files(folder: Path) -> list[Path]:
    """The files of a recording that are there."""
    return [Path(folder) / name for name in sorted(_FILES) if (Path(folder) / name).is_file()]


def read_recording(folder: Path) -> SweepRecording:
    """Open a recording; its large arrays are memory maps.

    Raises
    ------
    InputError
        If a file is missing, truncated, of a wrong type or shape, or its numbers cannot be what the name says.
    """
    folder = Path(folder)
    if not folder.is_dir():
        problem = "is not a folder" if folder.exists() else "is missing"
        raise InputError(folder, problem, expected="the folder of a sweep recording")
    if not (folder / HEAD).exists() and (folder / "session.toml").is_file():
        raise InputError(folder, "is a session", expected=f"the folder of a sweep recording, with {HEAD}")
    lidar = _read_head(folder / HEAD)
    arrays: dict[str, RealArray | None] = {
        name: _map_array(folder / f"{name}.npy", required=name not in ("intensity", "time_s")) for name in _ARRAYS
    }
    recording = _join(folder, lidar, arrays)
    _check_angles(folder / "turntable_angle_deg.npy", recording.turntable_angle_deg)
    _check_angles(folder / "beam_angle_deg.npy", recording.beam_angle_deg)
    _check_times(folder / "time_s.npy", recording.time_s)
    _check_ranges(folder / "range_m.npy", recording.range_m)
    release_pages(recording)
    return recording


def write_recording(folder: Path, recording: SweepRecording) -> None:
    """Write a recording as a folder, whole or not at all; an earlier recording there is replaced.

    Raises
    ------
    InputError
        If the folder holds anything but a recording, or cannot be written to, or the ranges are millimetres.
    """
    folder = Path(folder)
    _check_ranges(folder, np.asarray(recording.range_m))
    restore_folder(folder)
    _check_replaceable(folder)
    arrays: dict[str, Any] = {
        "turntable_angle_deg": np.asarray(recording.turntable_angle_deg, dtype=np.float64),
        "beam_angle_deg": np.asarray(recording.beam_angle_deg, dtype=np.float64),
        "range_m": np.asarray(recording.range_m, dtype=np.float32),
        "intensity": recording.intensity,
        "time_s": recording.time_s,
    }
    with replacing_folder(folder) as temporary:
        for name, array in arrays.items():
            if array is not None:
                with (temporary / f"{name}.npy").open("wb") as file:
                    npy.write_array(file, np.ascontiguousarray(array), allow_pickle=False)
        write_text(temporary / HEAD, _head_text(recording.lidar))


def write_simulated_recording(
    out: Path,
    recording: SweepRecording,
    motion: TurntableMotion,
    truth: Mapping[str, Any] | None = None,
    *,
    force: bool = False,
) -> None:
    """Write a simulated recording with OUT.calibration.json and OUT.truth.json beside it.

    Raises
    ------
    InputError
        If the folder holds anything but an earlier simulation; `force` also replaces a recording without truth.
    """
    restore_folder(out)
    check_free(out, FORMAT, force=force, head=HEAD)
    calibration = Path(f"{out}.calibration.json")
    # What is left if this run is killed must not belong to another recording.
    truth_path(out).unlink(missing_ok=True)
    calibration.unlink(missing_ok=True)
    write_recording(out, recording)
    # The truth is known exactly, which is not the same as nobody knows how well.
    exact = np.zeros((len(PARAMETER_NAMES), len(PARAMETER_NAMES)))
    write_calibration(calibration, TurntableCalibration(motion, exact))
    transforms = [
        transform_entry("camera", "turntable", motion.T_camera_turntable),
        transform_entry("turntable", "lidar", motion.T_turntable_lidar),
    ]
    document = {**(truth or {}), "transforms": transforms}
    write_text(truth_path(out), json.dumps(document, indent=2, allow_nan=False) + "\n")


def _check_replaceable(folder: Path) -> None:
    """InputError unless the folder is new, empty, or a recording with nothing else in it."""
    try:
        if folder.exists() and not folder.is_dir():
            raise InputError(folder, "exists and is no folder", expected="the name of a folder to write")
        others = sorted({path.name for path in folder.iterdir()} - _FILES) if folder.exists() else []
    except OSError as error:
        raise InputError(folder, f"cannot be read: {error.strerror or error}") from error
    if others:
        raise InputError(folder, f"holds {others[0]!r}, which is no part of a recording", expected="a new folder")


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
    return read_sections(path, _HeadFile, document).lidar.spec()


def _map_array(path: Path, *, required: bool) -> RealArray | None:
    if not path.exists() and not required:
        return None
    shape, fortran, dtype, start = read_npy_header(path)
    if dtype.kind not in "fiu":
        raise InputError(path, f"holds {dtype}", expected="real numbers (float32, float64 or integers)")
    if 0 in shape:
        return np.zeros(shape, dtype=dtype)
    try:
        return np.memmap(path, dtype=dtype, mode="r", offset=start, shape=shape, order="F" if fortran else "C")
    except (OSError, ValueError, OverflowError) as error:
        raise InputError(path, f"cannot be mapped into memory: {error}", expected="an array of usual size") from error


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
