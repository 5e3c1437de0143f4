"""Text: one point a line, numbers apart by blanks, tabs, commas or semicolons.

A first line that starts with ``#``, ``//`` or a letter names the columns; without it the first three are x, y, z and
the others ``column_4`` and so on.
"""

from __future__ import annotations

import io
import re
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import XYZ, Columns, blocks, cloud_of_rows, parse_table
from lidarpose.storage.limits import MAX_HEADER_BYTES

_MAX_COLUMNS = 256
_BLOCK_ROWS = 1 << 16
_UNITS = re.compile(r"(_m|\[m\]|\(m\))$")


def read(path: Path) -> Cloud:
    """Read a cloud from text."""
    with path.open("rb") as file:
        names, separator = _read_head(path, file)
        body: IO[bytes] = file
        if separator != " ":
            body = io.BytesIO(file.read().replace(separator.encode(), b" "))
        rows = parse_table(path, body, np.dtype([(name, np.float64) for name in names]), None)
    return cloud_of_rows(rows, path)


def _read_head(path: Path, file: IO[bytes]) -> tuple[list[str], str]:
    """Column names and what separates columns; leaves the file at the first row of numbers."""
    named: list[str] = []
    while True:
        start = file.tell()
        line = file.readline(MAX_HEADER_BYTES).decode("latin-1")
        if not line:
            raise InputError(path, "holds no points", expected="lines of x y z")
        text = line.strip()
        if not text:
            continue
        separator = next((mark for mark in ",;" if mark in text), " ")
        comment = text.startswith(("#", "//"))
        words = text.lstrip("#/ ").replace(separator, " ").split()
        if not words and not comment:
            raise InputError(path, f"{text[:60]!r} is no point", expected="lines of x y z")
        if not comment and _is_number(words[0]):
            break
        if comment and not {"x", "y", "z"} <= {_UNITS.sub("", word.lower()) for word in words}:
            continue
        if named:
            raise InputError(path, f"{text[:60]!r} is no point", expected="numbers after the line of names")
        named = words
    file.seek(start)
    if len(words) > _MAX_COLUMNS:
        raise InputError(path, f"has {len(words)} columns", expected=f"3 to {_MAX_COLUMNS}")
    names = [_UNITS.sub("", n.lower()) if _UNITS.sub("", n.lower()) in XYZ else n for n in named]
    if not names:
        names = [*XYZ, *(f"column_{k}" for k in range(4, len(words) + 1))][: len(words)]
    if len(set(names)) != len(names):
        raise InputError(path, "names a column twice", field=" ".join(names)[:80], expected="each name once")
    return names, separator


def _is_number(word: str) -> bool:
    try:
        float(word)
    except ValueError:
        return False
    return True


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write text with a line of names; numbers have the digits that their type holds."""
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
