"""Text: one point a line, numbers apart by blanks, tabs, commas or semicolons; decimals by a point or a comma.

A first line that starts with ``#``, ``//`` or a letter names the columns; without it the first three are x, y, z and
the others ``column_4`` and so on. A line with one whole number before the points says how many follow (PTS).
"""

from __future__ import annotations

import codecs
import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import XYZ, Columns, blocks, cloud_of_rows, parse_table
from lidarpose.storage.limits import MAX_HEADER_BYTES

_MAX_COLUMNS = 256
_BLOCK_ROWS = 1 << 16
_UNITS = re.compile(r" ?(_m|\[m\]|\(m\))$")


@dataclass(frozen=True)
class _Head:
    """What stands before the points; `separator` and `decimal` are those of the first of them."""

    names: tuple[str, ...]
    count: int | None
    separator: str
    decimal: str


def read(path: Path) -> Cloud:
    """Read a cloud from text."""
    with path.open("rb") as file:
        head = _read_head(path, file)
        body: IO[bytes] = file
        if head.separator != " " or head.decimal != ".":
            plain = bytes.maketrans(*(f"{a}{b}".encode() for a, b in ((head.separator, head.decimal), " .")))
            body = io.BytesIO(file.read().translate(plain))
        row = np.dtype([(name, np.float64) for name in head.names])
        rows = parse_table(path, body, row, None, comments="#")
    if head.count not in (None, len(rows)):
        raise InputError(path, f"holds {len(rows)} points where its first line promises {head.count}")
    return cloud_of_rows(rows, path)


def _read_head(path: Path, file: IO[bytes]) -> _Head:
    """Column names and how numbers are written; leaves the file at the first row of them."""
    named: list[str] = []
    count: int | None = None
    if (mark := file.read(3)) != codecs.BOM_UTF8:
        if mark[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
            raise InputError(path, "is text of 16 bits", expected="text in UTF-8 or ASCII")
        file.seek(0)
    while True:
        start = file.tell()
        line = file.readline(MAX_HEADER_BYTES).decode("latin-1")
        if not line:
            raise InputError(path, "holds no points", expected="lines of x y z")
        text = line.strip()
        if not text:
            continue
        if not text.strip(",;"):
            raise InputError(path, f"{text[:60]!r} is no point", expected="lines of x y z")
        if text.isdecimal() and count is None:
            count = int(text[:18])
            continue
        comment = text.startswith(("#", "//"))
        separator, decimal = _marks(text)
        cells = text.split(None if separator == " " else separator)
        if not comment and _is_number(cells[0].strip().replace(decimal, ".")):
            break
        names = _names(text.lstrip("#/ "))
        if comment and not set(XYZ) <= set(names):
            continue
        if named:
            raise InputError(path, f"{text[:60]!r} is no point", expected="numbers after the line of names")
        named = names
    file.seek(start)
    words = text.partition("#")[0].replace(separator, " ").split()
    if len(words) > _MAX_COLUMNS:
        raise InputError(path, f"has {len(words)} columns", expected=f"3 to {_MAX_COLUMNS}")
    names = named or [*XYZ, *(f"column_{k}" for k in range(4, len(words) + 1))][: len(words)]
    if len(set(names)) != len(names):
        raise InputError(path, "names a column twice", field=" ".join(names)[:80], expected="each name once")
    return _Head(tuple(names), count, separator, decimal)


def _marks(text: str) -> tuple[str, str]:
    """What separates a line's numbers, and their decimal mark: a comma that other marks leave no other meaning."""
    if ";" in text:
        return ";", "," if "," in text else "."
    if "," not in text:
        return " ", "."
    # Blanks inside of what commas separate: 1,5 2,5 3,0.
    inside = any(len(cell.split()) > 1 for cell in text.split(","))
    return (" ", ",") if inside and not text.startswith(("#", "//")) else (",", ".")


def _names(text: str) -> list[str]:
    """Names of columns without quotes and metres; those of ParaView and VeloView are points:0 and so on."""
    mark = next((mark for mark in ",;\t" if mark in text), None)
    cells = [re.sub(r"""^(["'])(.*)\1$""", r"\2", cell.strip()) for cell in text.rstrip(",;").split(mark)]
    bare = [_UNITS.sub("", cell.lower()) for cell in cells]
    if not set(XYZ) <= set(bare):
        bare = [re.sub(r"^points\w*:([012])$", lambda found: XYZ[int(found[1])], name) for name in bare]
    return [
        low if low in XYZ else cell or f"column_{k}" for k, (low, cell) in enumerate(zip(bare, cells, strict=True), 1)
    ]


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write text with a line of names; numbers have the digits that their type holds."""
    if shown.suffix.lower() == ".pts":  # begins with a count, and has no names
        raise InputError(shown, "PTS is read only", expected="another format, such as .xyz or .ply")
    with path.open("w", encoding="ascii", newline="\n") as file:
        yield _Writer(file, columns, shown)


class _Writer:
    def __init__(self, file: IO[str], columns: Columns, shown: Path) -> None:
        for name, item in columns.fields.items():
            if item.shape or item.kind not in "fiu" or not name.isascii() or name.split() != [name]:
                raise InputError(shown, "cannot be a column of text", field=name, expected="one number a point")
        self._file, self._columns = file, columns
        self._row = columns.row()
        self._file.write("# " + " ".join(self._row.names or ()) + "\n")

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        self._columns.require_same(cloud)
        formats = [_format(self._row[name].base) for name in self._row.names or ()]
        for block in blocks(len(cloud), _BLOCK_ROWS):
            columns = [*cloud.points[block].T, *(cloud.fields[name][block] for name in self._columns.fields)]
            rows = np.empty(len(columns[0]), dtype=self._row)
            for name, column in zip(self._row.names or (), columns, strict=True):
                rows[name] = column
            np.savetxt(self._file, rows, fmt=formats)


def _format(item: np.dtype[np.generic]) -> str:
    if item.kind in "iu":
        return "%d"
    return "%.9g" if item.itemsize <= 4 else "%.17g"
