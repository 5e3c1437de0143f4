"""PLY: ascii, binary of either byte order. The vertices with all their properties; other elements are passed over.

A reader of our own, because the rows are those of PCD once the header is read: exact counts, no list of faces parsed
that nobody wants, and a count in the header that a writer can mend at the end.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import Columns, CountedFile, cloud_of_rows, lent_points, parse_table, read_rows
from lidarpose.storage.clouds.headers import fill, read_header_lines, whole_number
from lidarpose.storage.limits import file_size, require_bytes

_TYPES = {
    "char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2", "ushort": "u2",
    "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4", "float": "f4", "float32": "f4",
    "double": "f8", "float64": "f8",
}  # fmt: skip
_NAMES = {
    "i1": "char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint", "f4": "float",
    "f8": "double",
}  # fmt: skip
_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_HEADER_MARGIN = 64


@dataclass
class _Element:
    name: str
    count: int
    properties: list[tuple[str, str]]
    least_bytes: int = 0  # of one entry beyond its fixed properties: the lengths of its lists
    least_numbers: int = 0
    has_list: bool = False


def read(path: Path) -> Cloud:
    """Read the vertices of a PLY file."""
    order, offset, dtype, before, vertex, after = _read_layout(path)
    if order:
        start = _binary_start(path, offset, dtype, before, vertex, after)
        return read_rows(path, start, dtype, vertex.count)
    return cloud_of_rows(_read_ascii(path, offset, dtype, before, vertex, after), path)


def lent(path: Path) -> NDArray[np.floating[Any]] | None:
    """The points of a binary file in memory that the next call writes over (see `columns.lent_points`), if possible."""
    order, offset, dtype, before, vertex, after = _read_layout(path)
    if not order:
        return None
    return lent_points(path, _binary_start(path, offset, dtype, before, vertex, after), dtype, vertex.count)


def _read_layout(path: Path) -> tuple[str, int, np.dtype[Any], list[_Element], _Element, list[_Element]]:
    """Byte order, where the elements begin, a vertex as a row, and the elements before it, itself, and after it."""
    order, elements, offset = _read_header(path)
    before = []
    for element in elements:
        if element.name == "vertex":
            break
        before.append(element)
    else:
        raise InputError(path, "has no element vertex", expected="a PLY file with points")
    vertex, after = elements[len(before)], elements[len(before) + 1 :]
    if vertex.has_list:
        raise InputError(path, "has a list among its properties", field="element vertex", expected="numbers alone")
    dtype = np.dtype([(name, (order or "=") + code) for name, code in vertex.properties])
    return order, offset, dtype, before, vertex, after


def _read_header(path: Path) -> tuple[str, list[_Element], int]:
    lines, offset = read_header_lines(path, "end_header")
    if lines[0] != "ply":
        raise InputError(path, f"starts with {lines[0][:20]!r}", expected="the line 'ply'")
    order: str | None = None
    elements: list[_Element] = []
    for number, line in enumerate(lines[1:-1], start=2):
        words = line.split()
        place = f"line {number}"
        if not words or words[0] in ("comment", "obj_info"):
            continue
        if words[0] == "format" and len(words) == 3 and words[1] in _ORDERS and order is None:
            order = _ORDERS[words[1]]
        elif words[0] == "element" and len(words) == 3:
            elements.append(_Element(words[1], whole_number(path, place, words[2]), []))
        elif words[0] == "property" and elements:
            _add_property(path, place, elements[-1], words[1:])
        else:
            raise InputError(path, f"{line[:60]!r} has no meaning here", field=place, expected="a PLY header")
    if order is None:
        raise InputError(path, "has no line 'format'", expected="ascii, binary_little_endian or binary_big_endian")
    return order, elements, offset


def _add_property(path: Path, place: str, element: _Element, words: list[str]) -> None:
    if len(words) == 4 and words[0] == "list" and words[1] in _TYPES and words[2] in _TYPES:
        element.has_list = True
        element.least_bytes += int(_TYPES[words[1]][1])
        element.least_numbers += 1
        return
    if len(words) != 2 or words[0] not in _TYPES:
        raise InputError(path, f"{' '.join(words)[:60]!r} is no property", field=place, expected="a type and a name")
    if words[1] in (name for name, _ in element.properties):
        raise InputError(path, f"{words[1]} is there twice", field=place, expected="each name once")
    element.properties.append((words[1], _TYPES[words[0]]))
    element.least_bytes += int(_TYPES[words[0]][1])
    element.least_numbers += 1


def _binary_start(
    path: Path,
    offset: int,
    dtype: np.dtype[Any],
    before: list[_Element],
    vertex: _Element,
    after: list[_Element],
) -> int:
    """Where the vertices begin in a file that holds exactly what its header promises."""
    if lists := [element.name for element in before if element.has_list]:
        raise InputError(path, f"has lists in {lists[0]} before the vertices", expected="the vertices first")
    start = offset + sum(element.count * element.least_bytes for element in before)
    size = file_size(path)
    least = start - offset + vertex.count * dtype.itemsize + sum(e.count * e.least_bytes for e in after)
    require_bytes(path, "element vertex", least, size - offset)
    if size - offset != least and not any(element.has_list for element in after):
        extra = size - offset - least
        raise InputError(path, f"has {extra} bytes more than its elements take", expected="the promised elements alone")
    return start


def _read_ascii(
    path: Path, offset: int, dtype: np.dtype[Any], before: list[_Element], vertex: _Element, after: list[_Element]
) -> NDArray[Any]:
    every = [*before, vertex, *after]
    require_bytes(
        path, "element vertex", sum(e.count * max(1, 2 * e.least_numbers) for e in every) - 1, file_size(path) - offset
    )
    with path.open("rb") as file:
        file.seek(offset)
        _skip_lines(path, file, sum(element.count for element in before))
        start = file.tell()
        _skip_lines(path, file, vertex.count)
        end = file.tell()
        _skip_lines(path, file, sum(element.count for element in after))
        if file.read().strip():
            raise InputError(path, "has more lines than its elements take", expected="the promised elements alone")
        file.seek(start)
        return parse_table(path, file, dtype, vertex.count) if end > start else np.empty(0, dtype=dtype)


def _skip_lines(path: Path, file: IO[bytes], count: int) -> None:
    """Pass over `count` lines that are not blank."""
    while count:
        line = file.readline()
        if not line:
            raise InputError(path, f"ends {count} lines early", field="element vertex", expected="all elements")
        count -= bool(line.strip())


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write a little-endian binary PLY; the number of points is put into the header at the end."""
    with path.open("wb") as file:
        out = _Writer(file, columns, shown)
        yield out
        out.finish()


class _Writer(CountedFile):
    def __init__(self, file: IO[bytes], columns: Columns, shown: Path) -> None:
        for name, item in columns.fields.items():
            if item.str[1:] not in _NAMES:
                wanted = "numbers of up to 4 bytes, or double"
                raise InputError(shown, f"PLY has no type for {item}", field=name, expected=wanted)
            if not name.isascii() or name.split() != [name]:
                raise InputError(shown, "is no name for a property of a PLY file", field=name, expected="one word")
        self._row = columns.row()
        self._length = len("\n".join(self._lines(0))) + _HEADER_MARGIN
        super().__init__(file, columns)

    def _put_header(self) -> None:
        self._file.write(fill(self._lines(self._count), "comment metres", self._length))

    def _lines(self, count: int) -> list[str]:
        row = self._row
        properties = [f"property {_NAMES[row[name].str[1:]]} {name}" for name in row.names or ()]
        return ["ply", "format binary_little_endian 1.0", f"element vertex {count}", *properties, "end_header"]
