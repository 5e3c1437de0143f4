"""Corner sessions: the folder described in docs/formats.md becomes a `CornerSession`, and the other way."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import TurntableCalibration, WorldCalibration
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CloudFrame, CornerPlace, CornerSession, CrossingBeams
from lidarpose.model.recording import SweepRecording
from lidarpose.model.scan import LidarSpec
from lidarpose.storage.atomic import replacing_folder, restore_folder, write_text
from lidarpose.storage.calibration import read_calibration, read_turntable_calibration
from lidarpose.storage.documents import check_format, read_toml, shown
from lidarpose.storage.limits import find_files
from lidarpose.storage.provenance import provenance
from lidarpose.storage.recording import recording_files
from lidarpose.storage.recording_head import HEAD, is_recording
from lidarpose.storage.sections import Within, read_sections
from lidarpose.storage.session import CORNER_SESSION_FORMAT, LidarSection, inside
from lidarpose.storage.session_folder import check_free
from lidarpose.storage.tables import TextTable, read_text_table
from lidarpose.storage.truth import truth_path

Result = TypeVar("Result")

CLOUD_SUFFIXES = (".pcd", ".ply", ".las", ".laz", ".e57", ".npy")
MAX_PLACES = 10_000
MAX_WORLD_M = 1e7

_WORLD = ("world_x_m", "world_y_m", "world_z_m")
# The lenses sit within the instrument.
_LARGEST_CROSSING_M = 0.2
_NEAR = ("near_x_m", "near_y_m", "near_z_m")


@dataclass(frozen=True)
class _LidarSection(LidarSection):
    """[lidar] of a corner session."""

    beam_crossing_m: float | None = None

    def spec(self) -> LidarSpec:
        return replace(super().spec(), beam_crossing_m=self.beam_crossing_m)


@dataclass(frozen=True)
class _SessionFile:
    format: Literal["lidarpose/corner-session@1"]
    positions: str
    world_sigma_m: Annotated[float, Within(ge=0.0, le=1.0)] | None = None
    estimate_scale: bool = False
    cloud_frame: Literal["lidar", "camera"] | None = None
    turntable_calibration: str | None = None
    lidar: _LidarSection = field(default_factory=_LidarSection)


@dataclass(frozen=True)
class FileCloud:
    """One frame of a session, read when asked for."""

    path: Path
    name: str

    def load(self) -> Cloud:
        """Read the cloud. Raises InputError if it is missing, cut off, or in a format that is not known."""
        from lidarpose.storage.clouds import read_cloud

        return read_cloud(self.path)

    def look(self, at: Callable[[NDArray[np.floating[Any]]], Result]) -> Result:
        """What `at` makes of the points (N, 3), which it does not keep. Raises InputError as `load` does."""
        from lidarpose.storage.clouds import look_at_points

        return look_at_points(self.path, at)


@dataclass(frozen=True)
class FileRecording:
    """One sweep recording of a session: a cloud, once the turntable's calibration is known."""

    path: Path
    name: str

    def recording(self) -> SweepRecording:
        """Open the recording. Raises InputError if a file of it is missing or unreadable."""
        from lidarpose.storage.recording import read_recording

        return read_recording(self.path)

    def load(self) -> Cloud:
        """Raise InputError: by itself a recording is no cloud."""
        raise InputError(
            self.path,
            "is a sweep recording, and the turntable's calibration is not given",
            expected='turntable_calibration = "calibration.json" in session.toml, or --turntable',
        )


def read_corner_session(folder: Path | str) -> CornerSession:
    """Read a corner session's description; clouds are read later, when they are asked for.

    Raises
    ------
    InputError
        Naming the file, the key or line, what was expected and how to mend it.
    """
    folder = Path(folder)
    file = folder / "session.toml"
    if not folder.is_dir():
        problem = "is missing" if not folder.exists() else "is not a folder"
        raise InputError(folder, problem, expected="a session's folder")
    document = read_sections(file, _SessionFile, check_format(file, read_toml(file), CORNER_SESSION_FORMAT))
    places = _read_places(folder, inside(folder, document.positions, file, "positions"))
    cloud_frame, turntable = _recorded(folder, file, document, places)
    crossing_m = document.lidar.beam_crossing_m
    if crossing_m:
        if not abs(crossing_m) < _LARGEST_CROSSING_M:
            raise InputError(
                file,
                f"is {crossing_m:g}",
                field="lidar.beam_crossing_m",
                expected=f"metres, between -{_LARGEST_CROSSING_M:g} and {_LARGEST_CROSSING_M:g} (a VLP-16's is 0.0419)",
            )
        if cloud_frame != "lidar":
            raise InputError(
                file,
                "is for clouds in the frame of a multi-beam LiDAR",
                field="lidar.beam_crossing_m",
                expected='cloud_frame = "lidar"',
            )
        places = tuple(_crossing(place, crossing_m) for place in places)
    return CornerSession(
        str(folder),
        places,
        document.world_sigma_m,
        document.estimate_scale,
        cloud_frame,
        document.lidar.spec(),
        turntable,
    )


def _recorded(
    folder: Path, file: Path, document: _SessionFile, places: tuple[CornerPlace, ...]
) -> tuple[CloudFrame, TurntableCalibration | None]:
    """The clouds' frame, the camera's where any is a recording, and the calibration that makes clouds of those."""
    recorded = any(isinstance(source, FileRecording) for place in places for source in place.clouds)
    if recorded and document.cloud_frame == "lidar":
        problem = f'is "{document.cloud_frame}", but places hold sweep recordings'
        raise InputError(
            file, problem, field="cloud_frame", expected='"camera", where the calibration puts their points'
        )
    frame: CloudFrame = "camera" if recorded else document.cloud_frame or "lidar"
    if document.turntable_calibration is None:
        return frame, None
    path = inside(folder, document.turntable_calibration, file, "turntable_calibration")
    return frame, read_turntable_calibration(path)


def _crossing(place: CornerPlace, crossing_m: float) -> CornerPlace:
    return replace(place, clouds=tuple(CrossingBeams(source, crossing_m) for source in place.clouds))


def _read_places(folder: Path, path: Path) -> tuple[CornerPlace, ...]:
    table = read_text_table(path, ("position", *_WORLD, "clouds"), _NEAR)
    if not table.rows:
        raise InputError(path, "has no positions", expected="a row for each place of the target, three or more")
    if len(table.rows) > MAX_PLACES:
        raise InputError(path, f"has {len(table.rows)} rows", expected=f"at most {MAX_PLACES}")
    present = [name for name in _NEAR if name in table.columns]
    if present and len(present) < len(_NEAR):
        raise InputError(path, f"has {', '.join(present)} alone", field="line 1", expected=", ".join(_NEAR))
    _check_names(table)
    return tuple(_place(folder, table, row) for row in range(len(table.rows)))


def _check_names(table: TextTable) -> None:
    for column in ("position", "clouds"):
        seen: dict[str, int] = {}
        for cells, line in zip(table.rows, table.lines, strict=True):
            value = cells[column]
            if not value:
                raise InputError(table.path, f"line {line} has none", field=column, expected="a value in every row")
            if value in seen:
                problem = f"{value!r} stands in lines {seen[value]} and {line}"
                raise InputError(table.path, problem, field=column, expected="each once")
            seen[value] = line


def _place(folder: Path, table: TextTable, row: int) -> CornerPlace:
    cells, line = table.rows[row], table.lines[row]
    world = np.array([table.number(row, name) for name in _WORLD])
    if np.abs(world).max() > MAX_WORLD_M:
        raise InputError(table.path, f"line {line} is {np.abs(world).max():g} from the origin", expected="metres")
    clouds = tuple(_find_clouds(folder, table.path, line, cells["clouds"]))
    return CornerPlace(cells["position"], world, clouds, _near(table, row))


def _near(table: TextTable, row: int) -> FloatArray | None:
    cells = [table.rows[row].get(name, "") for name in _NEAR]
    if not any(cells):
        return None
    if not all(cells):
        problem = f"line {table.lines[row]} has only a part of the hint"
        raise InputError(table.path, problem, field=",".join(_NEAR), expected="three numbers, or none")
    return np.array([table.number(row, name) for name in _NEAR])


def _find_clouds(folder: Path, file: Path, line: int, pattern: str) -> Iterator[FileCloud | FileRecording]:
    found = find_files(folder, pattern)
    recordings = _find_recordings(folder, pattern, found or [])
    if recordings:
        others = [path for path in found or [] if path.parent not in recordings]
        if others:
            problem = f"line {line}: {pattern!r} matches {others[0].name} beside sweep recordings"
            raise InputError(file, problem, field="clouds", expected="clouds, or folders of sweep recordings")
        for path in recordings:
            yield FileRecording(path, path.relative_to(folder).as_posix())
        return
    if found is None:
        expected = "a pattern inside the session's folder, such as clouds/p00/*.pcd"
        raise InputError(file, f"line {line} has {shown(pattern)}", field="clouds", expected=expected)
    found = [path for path in found if not path.name.startswith(".")]
    if not found:
        raise InputError(
            file,
            f"line {line}: no file matches {shown(pattern)}",
            field="clouds",
            expected="at least one cloud (" + " ".join(CLOUD_SUFFIXES) + "), or the folder of a sweep recording",
        )
    for path in found:
        if path.suffix.lower() not in CLOUD_SUFFIXES:
            problem = f"line {line}: {path.name} matches {pattern!r} but is no cloud"
            raise InputError(file, problem, field="clouds", expected="files " + " ".join(CLOUD_SUFFIXES))
        yield FileCloud(path, path.relative_to(folder).as_posix())


def _find_recordings(folder: Path, pattern: str, files: list[Path]) -> list[Path]:
    """Folders of sweep recordings that match a pattern, or hold the files that do."""
    heads = find_files(folder, f"{pattern}/{HEAD}") or []
    return sorted({path.parent for path in [*heads, *files] if is_recording(path.parent)})


def write_corner_session(folder: Path, session: CornerSession, *, suffix: str = ".pcd", force: bool = False) -> None:
    """Write a session as a folder, whole or not at all. The truth of an earlier simulation beside it is removed.

    Raises
    ------
    InputError
        If the folder holds something else (see `lidarpose.storage.session_folder`), or cannot be written to.
    """
    restore_folder(folder)
    check_free(folder, CORNER_SESSION_FORMAT, force=force)
    with replacing_folder(folder) as temporary:
        _write_files(temporary, session, suffix)
        truth_path(folder).unlink(missing_ok=True)


def _write_files(folder: Path, session: CornerSession, suffix: str) -> None:
    from lidarpose.storage.clouds import write_cloud

    rows = []
    for index, place in enumerate(session.places):
        sub = f"clouds/p{index:02d}"
        for k, source in enumerate(place.clouds):
            write_cloud(folder / sub / f"{k:03d}{suffix}", source.load())
        numbers = [*place.corner_world, *(place.near if place.near is not None else ())]
        cells = [place.position, *(f"{x:.6f}" for x in numbers[:3]), f"{sub}/*{suffix}"]
        rows.append([*cells, *(f"{x:.3f}" for x in numbers[3:])])
    hints = any(place.near is not None for place in session.places)
    header = ["position", *_WORLD, "clouds", *(_NEAR if hints else ())]
    lines = [",".join(row + [""] * (len(header) - len(row))) for row in [header, *rows]]
    write_text(folder / "positions.csv", "\n".join(lines) + "\n")
    write_text(folder / "session.toml", _session_toml(session))


def _session_toml(session: CornerSession) -> str:
    lines = [f'format = "{CORNER_SESSION_FORMAT}"', 'positions = "positions.csv"']
    if session.world_sigma_m is not None:
        lines.append(f"world_sigma_m = {session.world_sigma_m:.9g}")
    lines.append(f"estimate_scale = {str(session.estimate_scale).lower()}")
    lines.append(f'cloud_frame = "{session.cloud_frame}"')
    lines.append("[lidar]")
    if session.lidar.model is not None:
        lines.append(f'model = "{session.lidar.model}"')
    if session.lidar.range_sigma_m is not None:
        lines.append(f"range_sigma_m = {session.lidar.range_sigma_m:.9g}")
    return "\n".join(lines) + "\n"


def session_provenance(folder: Path, session: CornerSession, options: Mapping[str, Any]) -> dict[str, Any]:
    """A record of a run on a session: hashes of its description; of the clouds, which are large, number and size."""
    document = read_sections(folder / "session.toml", _SessionFile, read_toml(folder / "session.toml"))
    record = provenance("calibrate", folder, [folder / "session.toml", folder / document.positions], options)
    clouds = [source for place in session.places for source in place.clouds]
    files = [source.source if isinstance(source, CrossingBeams) else source for source in clouds]
    paths = [source.path for source in files if isinstance(source, FileCloud)]
    for source in files:
        paths += recording_files(source.path) if isinstance(source, FileRecording) else []
    sizes = [path.stat().st_size for path in paths]
    return record | {"clouds": {"files": len(clouds), "bytes": sum(sizes)}}


def truth_beside(folder: Path) -> Pose | None:
    """The true pose that a simulation left beside its session, as FOLDER.truth.json; None where there is none."""
    file = truth_path(folder)
    if not file.is_file():
        return None
    calibration = read_calibration(file)
    return calibration.T_world_source if isinstance(calibration, WorldCalibration) else None


def corner_truth_document(transform: dict[str, Any], positions: list[dict[str, Any]]) -> dict[str, Any]:
    """What OUT.truth.json of a simulated corner session holds: the true transform, and the corner at each place."""
    return {
        "format": "lidarpose/calibration@1",
        "kind": "world",
        "transforms": [transform],
        "scale": 1.0,
        "positions": positions,
    }
