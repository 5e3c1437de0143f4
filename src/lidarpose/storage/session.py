"""Turntable sessions: the folder described in docs/formats.md becomes a `TurntableSession`.

What can be checked without decoding an image is checked here: every file named is there, angles and sizes are
plausible, rows are in the order in which a turntable turns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path, PurePosixPath
from typing import Annotated, Literal

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray, IntArray
from lidarpose.model.camera import Camera
from lidarpose.model.image import ImageSource
from lidarpose.model.scan import LidarSpec, Scan
from lidarpose.model.sense import Sense, StatedSense
from lidarpose.model.session import DEFAULT_PLACEMENT, TurntablePlace, TurntableSession
from lidarpose.model.targets import Panel
from lidarpose.storage.camera_files import read_camera
from lidarpose.storage.documents import check_format, read_toml, shown
from lidarpose.storage.images import FileImage
from lidarpose.storage.limits import find_files, is_file
from lidarpose.storage.sections import Within, read_sections
from lidarpose.storage.tables import TextTable, read_number_table, read_text_table

SESSION_FORMAT = "lidarpose/turntable-session@1"
CORNER_SESSION_FORMAT = "lidarpose/corner-session@1"
MAX_PLACES = 10_000
# A beam beyond this is no 2D LiDAR's on a turntable but one in millimetres.
MAX_RANGE_M = 500.0


@dataclass(frozen=True)
class LidarSection:
    """The optional [lidar] table of sessions and recordings."""

    model: str | None = None
    range_sigma_m: Annotated[float, Within(gt=0.0, le=0.5)] | None = None

    def spec(self) -> LidarSpec:
        return LidarSpec(self.model, self.range_sigma_m)


@dataclass(frozen=True)
class _PanelSection:
    columns: Annotated[int, Within(ge=3, le=500)]
    rows: Annotated[int, Within(ge=3, le=500)]
    square_m: Annotated[float, Within(gt=0.0, le=1.0)]


@dataclass(frozen=True)
class _BoardSection:
    images: str
    panels: Annotated[list[_PanelSection], Within(min_length=2, max_length=2)]


@dataclass(frozen=True)
class _TurningSection:
    beams: Sense | None = None
    table: Sense | None = None


@dataclass(frozen=True)
class _SessionFile:
    format: Literal["lidarpose/turntable-session@1"]
    camera: str
    positions: str
    board: _BoardSection
    lidar: LidarSection = field(default_factory=LidarSection)
    turning: _TurningSection = field(default_factory=_TurningSection)


@dataclass(frozen=True)
class FileScan:
    """One scan file of a session, read when asked for."""

    path: Path
    name: str

    def load(self) -> Scan:
        """Read the scan.

        Raises
        ------
        InputError
            If it is missing or cut off, a number is not finite, a range is zero or negative, or beams are out of order.
        """
        return read_scan(self.path)


def read_turntable_session(folder: Path | str, *, any_order: bool = False) -> TurntableSession:
    """Read a session's description; images and scans are read later, when they are asked for.

    Parameters
    ----------
    folder
        The session's folder.
    any_order
        Accept equal readings and readings that go back and forth.

    Raises
    ------
    InputError
        Naming the file, the key or line, what was expected and how to mend it.
    """
    folder = Path(folder)
    file = folder / "session.toml"
    if not folder.is_dir():
        raise InputError(
            folder, "is missing" if not folder.exists() else "is not a folder", expected="a session's folder"
        )
    document = read_sections(file, _SessionFile, check_format(file, read_toml(file), SESSION_FORMAT))
    panels = tuple(_panel(file, k, section) for k, section in enumerate(document.board.panels))
    camera = read_camera(inside(folder, document.camera, file, "camera"))
    places = _read_positions(folder, inside(folder, document.positions, file, "positions"), camera, any_order)
    board_images = _find_board_images(folder, file, document.board.images, camera, {p.placement for p in places})
    stated = StatedSense(document.turning.beams, document.turning.table)
    return TurntableSession(str(folder), camera, panels, board_images, places, document.lidar.spec(), stated)


def session_format(folder: Path) -> str:
    """What kind of session a folder holds: the `format` of its session.toml. Raises InputError if it has none."""
    file = folder / "session.toml"
    if not folder.is_dir():
        raise InputError(
            folder, "is missing" if not folder.exists() else "is not a folder", expected="a session's folder"
        )
    found = read_toml(file).get("format")
    if not isinstance(found, str):
        raise InputError(file, "is missing", field="format", expected=f'"{SESSION_FORMAT}" or another session format')
    return found


def session_files(folder: Path, session: TurntableSession) -> list[Path]:
    """All files that a session read from a folder stands on."""
    document = read_sections(folder / "session.toml", _SessionFile, read_toml(folder / "session.toml"))
    files = [folder / "session.toml", folder / document.camera, folder / document.positions]
    sources = [source for shots in session.board_images.values() for source in shots]
    sources += [place.stripe_image for place in session.places if place.stripe_image is not None]
    files += [source.path for source in sources if isinstance(source, FileImage)]
    files += [place.scan.path for place in session.places if isinstance(place.scan, FileScan)]
    return files


def _panel(file: Path, index: int, section: _PanelSection) -> Panel:
    if max(section.columns, section.rows) * section.square_m > 20.0:
        raise InputError(
            file,
            f"is {section.square_m:g}, which makes a board of {section.columns * section.square_m:g} m",
            field=f"board.panels.{index}.square_m",
            expected="the side of one square in metres, for instance 0.020",
        )
    return Panel(section.columns, section.rows, section.square_m)


def inside(folder: Path, name: str, file: Path, field: str) -> Path:
    """The path of a file that a session names, which must lie in the session's folder and be there."""
    relative = PurePosixPath(name.strip())
    if not name.strip() or relative.is_absolute() or ".." in relative.parts:
        raise InputError(file, f"is {shown(name)}", field=field, expected="a path inside the session's folder")
    path = folder / relative
    if not is_file(path):
        raise InputError(
            file,
            f"names {shown(name)}, which is missing",
            field=field,
            expected=f"a file of the folder {folder}",
            remedy="Put the file in its place, or take its row out.",
        )
    return path


def _find_board_images(
    folder: Path, file: Path, pattern: str, camera: Camera, placements: set[str]
) -> Mapping[str, tuple[ImageSource, ...]]:
    """By placement; where the board was moved, each placement's shots lie in a sub-folder of its name."""
    relative = PurePosixPath(pattern)
    found: dict[str, tuple[ImageSource, ...]] = {}
    for placement in sorted(placements):
        here = relative if placement == DEFAULT_PLACEMENT else relative.parent / placement / relative.name
        paths = find_files(folder, str(here))
        if paths is None:
            expected = "a pattern inside the session's folder, such as board/*.png"
            raise InputError(file, f"is {shown(pattern)}", field="board.images", expected=expected)
        if not paths:
            raise InputError(
                file,
                f"no image matches {shown(str(here))}",
                field="board.images",
                expected="at least one image of the board in bright light",
            )
        found[placement] = tuple(
            FileImage(p, p.relative_to(folder).as_posix(), camera.width, camera.height) for p in paths
        )
    return found


def _read_positions(folder: Path, path: Path, camera: Camera, any_order: bool) -> tuple[TurntablePlace, ...]:
    table = read_text_table(path, ("position", "turntable_angle_deg", "stripe_image", "scan"), ("placement",))
    if not table.rows:
        raise InputError(path, "has no positions", expected="a row for each stop of the turntable, three or more")
    if len(table.rows) > MAX_PLACES:
        raise InputError(path, f"has {len(table.rows)} rows", expected=f"at most {MAX_PLACES}")
    _check_unique(table, "position")
    _check_unique(table, "scan")
    _check_files(folder, table)
    angles = np.array([table.number(k, "turntable_angle_deg") for k in range(len(table.rows))])
    _check_angles(table, angles, any_order)
    return tuple(_place(folder, table, k, float(np.deg2rad(a)), camera) for k, a in enumerate(angles))


def _check_files(folder: Path, table: TextTable) -> None:
    """Name every missing file at once: nobody wants to learn of them one by one."""
    named = [
        (line, column, cells[column])
        for cells, line in zip(table.rows, table.lines, strict=True)
        for column in ("stripe_image", "scan")
        if cells[column]
    ]
    missing = [entry for entry in named if not is_file(folder / entry[2])]
    if len(missing) > 1:
        listed = ", ".join(f"{name[:60]} (line {line})" for line, _, name in missing[:5])
        more = f" and {len(missing) - 5} more" if len(missing) > 5 else ""
        raise InputError(
            table.path,
            f"{len(missing)} of {len(named)} files are missing: {listed}{more}",
            field="/".join(dict.fromkeys(column for _, column, _ in missing)),
            expected="every file named to be in the session's folder",
            remedy="Put the files in their places, or take their rows out.",
        )


def _place(folder: Path, table: TextTable, row: int, angle_rad: float, camera: Camera) -> TurntablePlace:
    cells, line = table.rows[row], table.lines[row]
    image: ImageSource | None = None
    if cells["stripe_image"]:
        path = inside(folder, cells["stripe_image"], table.path, f"line {line}: stripe_image")
        image = FileImage(path, cells["stripe_image"], camera.width, camera.height)
    scan = FileScan(inside(folder, cells["scan"], table.path, f"line {line}: scan"), cells["scan"])
    placement = cells.get("placement", DEFAULT_PLACEMENT)
    if "placement" in table.columns and (not placement or set(placement) & set("/*?[") or placement.startswith(".")):
        raise InputError(
            table.path,
            f"line {line} has {shown(placement)}",
            field="placement",
            expected="the name of the board images' sub-folder",
        )
    return TurntablePlace(cells["position"], angle_rad, image, scan, placement)


def _check_unique(table: TextTable, column: str) -> None:
    seen: dict[str, int] = {}
    for cells, line in zip(table.rows, table.lines, strict=True):
        if not cells[column]:
            raise InputError(table.path, f"line {line} has none", field=column, expected="a value in every row")
        if cells[column] in seen:
            raise InputError(
                table.path,
                f"{cells[column]!r} stands in lines {seen[cells[column]]} and {line}",
                field=column,
                expected="each once",
            )
        seen[cells[column]] = line


def _check_angles(table: TextTable, angle_deg: FloatArray, any_order: bool) -> None:
    path, field = table.path, "turntable_angle_deg"
    too_large = np.abs(angle_deg) > 36_000.0
    if too_large.any():
        line = table.lines[int(np.argmax(too_large))]
        raise InputError(path, f"line {line} has {angle_deg[too_large][0]:g}", field=field, expected="degrees")
    if any_order:
        return
    # A board that is moved while the table turns back is met once a placement.
    placements = np.array([cells.get("placement", "") for cells in table.rows])
    for placement in dict.fromkeys(placements):
        rows = np.flatnonzero(placements == placement)
        _check_one_way(table, rows, angle_deg[rows])


def _check_one_way(table: TextTable, rows: IntArray, angle_deg: FloatArray) -> None:
    lines = [table.lines[int(k)] for k in rows]
    remedy = "If the table really moved so, say --any-order."
    first_at: dict[float, int] = {}
    for line, angle in zip(lines, angle_deg, strict=True):
        if float(angle) in first_at:
            raise InputError(
                table.path,
                f"{angle:g} stands in lines {first_at[float(angle)]} and {line}",
                field="turntable_angle_deg",
                expected="another reading at each stop",
                remedy=remedy,
            )
        first_at[float(angle)] = line
    wrong = first_out_of_order(angle_deg)
    if wrong is not None:
        turn = "repeat" if angle_deg[wrong] == angle_deg[wrong - 1] else "turn back"
        raise InputError(
            table.path,
            f"the readings {turn} at line {lines[wrong]} ({angle_deg[wrong]:g} after {angle_deg[wrong - 1]:g})",
            field="turntable_angle_deg",
            expected="readings that only grow or only fall, as the table turns",
            remedy=f"Look whether images and scans belong to their rows (10 sorts before 2). {remedy}",
        )


def first_out_of_order(angle_deg: FloatArray) -> int | None:
    """Index of the first angle that turns against the first step; passing from 359 to 0 is no turning back."""
    if np.all(np.diff(angle_deg) > 0.0) or np.all(np.diff(angle_deg) < 0.0):
        return None
    steps = (np.diff(angle_deg) + 180.0) % 360.0 - 180.0
    against = steps * np.sign(steps[0]) <= 0.0
    return int(np.argmax(against)) + 1 if against.any() else None


def read_scan(path: Path) -> Scan:
    """Read a scan: angle_deg,range_m[,intensity][,sweep]; an empty range is a beam without return.

    Raises
    ------
    InputError
        Naming the line: see `FileScan.load`.
    """
    table = read_number_table(path, ("angle_deg", "range_m"), ("intensity", "sweep"), ("range_m", "intensity"))
    angle_deg, range_m = table["angle_deg"], table["range_m"]
    if not len(angle_deg):
        raise InputError(path, "has no beams", expected="a row for each beam", remedy="Record the scan again.")
    _check_ranges(path, range_m)
    if np.abs(angle_deg).max() > 720.0:
        raise InputError(path, f"reaches {np.abs(angle_deg).max():g}", field="angle_deg", expected="degrees")
    sweep = table.get("sweep")
    _check_beam_order(path, angle_deg, np.zeros(len(angle_deg)) if sweep is None else sweep)
    return Scan(
        np.deg2rad(angle_deg), range_m, table.get("intensity"), None if sweep is None else sweep.astype(np.int64)
    )


def _check_ranges(path: Path, range_m: FloatArray) -> None:
    with np.errstate(invalid="ignore"):
        wrong = range_m <= 0.0
        far = range_m > MAX_RANGE_M
    if wrong.any():
        row = int(np.argmax(wrong))
        raise InputError(
            path,
            f"row {row + 1} below the header has {range_m[row]:g}",
            field="range_m",
            expected="metres above zero",
            remedy="Leave the range empty where a beam has no return.",
        )
    if far.any():
        row = int(np.argmax(far))
        raise InputError(
            path,
            f"row {row + 1} below the header has {range_m[row]:g}",
            field="range_m",
            expected=f"metres, at most {MAX_RANGE_M:g}",
            remedy="Ranges in millimetres have to be divided by 1000.",
        )


def _check_beam_order(path: Path, angle_deg: FloatArray, sweep: FloatArray) -> None:
    starts = np.flatnonzero(np.diff(sweep, prepend=np.nan) != 0.0)
    if len(starts) != len(np.unique(sweep)):
        raise InputError(path, "the rows of a sweep do not stand together", field="sweep", expected="sweep after sweep")
    for start, stop in zip(starts, [*starts[1:], len(sweep)], strict=True):
        wrong = first_out_of_order(angle_deg[start:stop])
        if wrong is not None:
            row = start + wrong
            problem = "repeats" if angle_deg[row] == angle_deg[row - 1] else "turns back"
            raise InputError(
                path,
                f"{problem} in row {row + 1} below the header ({angle_deg[row]:g} after {angle_deg[row - 1]:g})",
                field="angle_deg",
                expected="beams in order, each once",
                remedy="Several sweeps in one file need a column sweep.",
            )
