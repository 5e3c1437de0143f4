"""Clouds of one place added to a corner session's folder."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.atomic import (
    clean_unfinished,
    mark_unfinished,
    replacing_folder,
    require_new_folder,
    write_text,
)
from lidarpose.storage.clouds import looks_like_millimetres, write_cloud
from lidarpose.storage.tables import read_text_table

_HEADER = ("position", "world_x_m", "world_y_m", "world_z_m", "clouds")
_NEAR = ("near_x_m", "near_y_m", "near_z_m")
_SESSION = 'format = "lidarpose/corner-session@1"\npositions = "positions.csv"\ncloud_frame = "lidar"\n'


@dataclass(frozen=True)
class PlaceOptions:
    """The place of the target that the clouds show.

    Attributes
    ----------
    name
        None: the next free p00, p01, ...
    corner_world_m
        The corner's coordinates; None leaves their cells empty, for the user to fill.
    """

    name: str | None = None
    corner_world_m: tuple[float, float, float] | None = None


def add_place(
    folder: Path, clouds: Iterable[Cloud], options: PlaceOptions, source: Path
) -> tuple[str, tuple[str, ...]]:
    """Write the clouds as one place of the session in `folder`, which is made if it is missing.

    The table names the place last: what a run left that was killed before that is removed by the next one.

    Returns
    -------
    tuple
        What was written, in words, and remarks.

    Raises
    ------
    InputError
        If the place is there already, its name cannot name a folder, there are no clouds, or they are in millimetres.
    """
    rows = _rows(folder)
    named = [row[rows[0].index("position")] for row in rows[1:]]
    clean_unfinished(folder / "clouds", named)
    name = options.name or _free_name(folder)
    if not re.fullmatch(r"[A-Za-z0-9_-]+", name):
        raise InputError("--place", f"is {name!r}", expected="letters, digits, _ and -")
    if name in named:
        raise InputError(
            folder / "positions.csv", f"has the place {name} already", field="position", expected="another --place"
        )
    count = points = 0
    clouds_of_place = folder / "clouds" / name
    require_new_folder(clouds_of_place)
    with replacing_folder(clouds_of_place) as temporary:
        mark = mark_unfinished(temporary)
        for count, cloud in enumerate(clouds, start=1):
            if count == 1 and looks_like_millimetres(cloud):
                raise InputError(
                    source, "has clouds that look like millimetres", expected="metres", remedy="Divide by 1000."
                )
            points += len(cloud)
            write_cloud(temporary / f"{count - 1:03d}.pcd", cloud)
        if not count:
            raise InputError(source, "has no clouds", expected="one or more frames")
    world = options.corner_world_m
    cells = ["", "", ""] if world is None else [repr(float(x)) for x in world]
    new = dict(zip(_HEADER, (name, *cells, f"clouds/{name}/*.pcd"), strict=True))
    rows.append([new.get(column, "") for column in rows[0]])
    try:
        if not (folder / "session.toml").exists():
            write_text(folder / "session.toml", _SESSION)
        write_text(folder / "positions.csv", "\n".join(",".join(row) for row in rows) + "\n")
    except BaseException:
        shutil.rmtree(clouds_of_place, ignore_errors=True)
        raise
    (clouds_of_place / mark.name).unlink(missing_ok=True)
    remarks = () if world is not None else (f"Fill in the corner's world coordinates of {name} in positions.csv.",)
    return f"place {name}: {count} clouds, {points} points", remarks


def _free_name(folder: Path) -> str:
    taken = {path.name for path in (folder / "clouds").glob("*")}
    return next(f"p{k:02d}" for k in range(len(taken) + 1) if f"p{k:02d}" not in taken)


def _rows(folder: Path) -> list[list[str]]:
    """The table's lines, its header first."""
    path = folder / "positions.csv"
    if not path.exists():
        return [list(_HEADER)]
    table = read_text_table(path, _HEADER, _NEAR)
    rows = [[row[column] for column in table.columns] for row in table.rows]
    return [list(table.columns), *rows]
