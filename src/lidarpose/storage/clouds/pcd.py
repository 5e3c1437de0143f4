"""PCD, the Point Cloud Library's format: ascii, binary, and binary_compressed; version 0.6 and 0.7.

The header is read strictly and compared with the file before anything is allocated. Up to 64 kB of zeros after the
last point are passed over: the library's own writer leaves them. The viewpoint does not move the points, as in the
library itself.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any, Literal

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.atomic import replacing
from lidarpose.storage.clouds import lzf
from lidarpose.storage.clouds.columns import (
    RGB,
    Columns,
    CountedFile,
    cloud_of_rows,
    lent_points,
    parse_table,
    read_rows,
)
from lidarpose.storage.clouds.headers import fill, read_header_lines, whole_number
from lidarpose.storage.limits import file_size, require_bytes

_TYPES = {"F": {4: "f4", 8: "f8"}, "U": {1: "u1", 2: "u2", 4: "u4", 8: "u8"}, "I": {1: "i1", 2: "i2", 4: "i4", 8: "i8"}}
_MAX_COUNT = 4096
"""Elements of one field; histograms of features, the largest in use, have some hundred."""
_MAX_PADDING = 1 << 16
_HEADER_MARGIN = 64


@dataclass(frozen=True)
class _Header:
    row: np.dtype[Any]
    padding: tuple[str, ...]
    points: int
    data: str
    offset: int


def read(path: Path) -> Cloud:
    """Read a PCD file."""
    header = _read_header(path)
    available = file_size(path) - header.offset
    if header.data == "ascii":
        # A number and a blank each: the least that the promised points can take.
        numbers = sum(int(np.prod(header.row[name].shape)) for name in header.row.names or ())
        require_bytes(path, "POINTS", header.points * numbers * 2 - 1, available)
        cloud = cloud_of_rows(_read_ascii(path, header), path, skip=header.padding)
    elif header.data == "binary":
        _check_binary(path, header, available)
        cloud = read_rows(path, header.offset, header.row, header.points, skip=header.padding)
    else:
        cloud = cloud_of_rows(_read_compressed(path, header, available), path, skip=header.padding)
    return unpack_colours(cloud)


def lent(path: Path) -> NDArray[np.floating[Any]] | None:
    """The points of a binary file in memory that the next call writes over (see `columns.lent_points`), if possible."""
    header = _read_header(path)
    if header.data != "binary":
        return None
    _check_binary(path, header, file_size(path) - header.offset)
    return lent_points(path, header.offset, header.row, header.points)


def _read_header(path: Path) -> _Header:
    lines, offset = read_header_lines(path, "DATA")
    entries: dict[str, list[str]] = {}
    for line in lines:
        words = line.split()
        if not words or words[0].startswith("#"):
            continue
        if words[0] in entries:
            raise InputError(path, "is there twice", field=words[0], expected="each header line once")
        entries[words[0]] = words[1:]
    row, padding = _row_type(path, entries)
    data = entries["DATA"]
    if data not in (["ascii"], ["binary"], ["binary_compressed"]):
        raise InputError(path, f"is {' '.join(data)!r}", field="DATA", expected="ascii, binary or binary_compressed")
    return _Header(row, padding, _point_count(path, entries), data[0], offset)


def _row_type(path: Path, entries: dict[str, list[str]]) -> tuple[np.dtype[Any], tuple[str, ...]]:
    names = _entry(path, entries, "COLUMNS" if "COLUMNS" in entries and "FIELDS" not in entries else "FIELDS")
    sizes, types = _entry(path, entries, "SIZE"), _entry(path, entries, "TYPE")
    counts = entries.get("COUNT", ["1"] * len(names))
    for key, values in (("SIZE", sizes), ("TYPE", types), ("COUNT", counts)):
        if len(values) != len(names):
            raise InputError(
                path, f"has {len(values)} entries", field=key, expected=f"one for each of {len(names)} fields"
            )
    described = (tuple(names), tuple(sizes), tuple(types), tuple(counts))
    if described in _rows:
        return _rows[described]
    items: list[tuple[str, str, tuple[int, ...]]] = []
    padding: list[str] = []
    for name, size, kind, count in zip(names, sizes, types, counts, strict=True):
        code = _TYPES.get(kind, {}).get(whole_number(path, "SIZE", size, high=8))
        if code is None:
            raise InputError(path, f"{name} has type {kind[:10]} of {size} bytes", field="TYPE", expected="F, U or I")
        elements = whole_number(path, "COUNT", count, low=1, high=_MAX_COUNT)
        if name == "_":
            name = f"_{len(padding)}"
            padding.append(name)
        if name in (item[0] for item in items):
            raise InputError(path, f"{name} is there twice", field="FIELDS", expected="each name once")
        items.append((name, "<" + code, (elements,) if elements > 1 else ()))
    found = np.dtype(items), tuple(padding)
    if len(_rows) < _MOST_ROWS:
        _rows[described] = found
    return found


# The frames of a session are alike: what their headers say of a row is made out once.
_rows: dict[tuple[tuple[str, ...], ...], tuple[np.dtype[Any], tuple[str, ...]]] = {}
_MOST_ROWS = 64


def _point_count(path: Path, entries: dict[str, list[str]]) -> int:
    width, height = (whole_number(path, key, " ".join(_entry(path, entries, key))) for key in ("WIDTH", "HEIGHT"))
    points = whole_number(path, "POINTS", " ".join(entries.get("POINTS", [str(width * height)])))
    if points != width * height:
        raise InputError(path, f"is {points}", field="POINTS", expected=f"WIDTH times HEIGHT, {width * height}")
    return points


def _entry(path: Path, entries: dict[str, list[str]], key: str) -> list[str]:
    if not entries.get(key):
        raise InputError(
            path, "is missing", field=key, expected="a PCD header with FIELDS, SIZE, TYPE, WIDTH, HEIGHT, DATA"
        )
    return entries[key]


def _read_ascii(path: Path, header: _Header) -> NDArray[Any]:
    with path.open("rb") as file:
        file.seek(header.offset)
        rows = parse_table(path, file, header.row, None)
    if len(rows) != header.points:
        raise InputError(
            path, f"is {header.points}, but {len(rows)} points follow", field="POINTS", expected="all of them"
        )
    return rows


def _check_binary(path: Path, header: _Header, available: int) -> None:
    needed = header.points * header.row.itemsize
    require_bytes(path, "POINTS", needed, available)
    if available != needed:
        _require_padding(path, header.offset + needed)


def _read_compressed(path: Path, header: _Header, available: int) -> NDArray[Any]:
    needed = header.points * header.row.itemsize
    if header.points == 0 and available == 0:
        return np.empty(0, dtype=header.row)
    with path.open("rb") as file:
        file.seek(header.offset)
        sizes = file.read(8)
        require_bytes(path, "DATA", 8, len(sizes))
        compressed, inflated = struct.unpack("<II", sizes)
        require_bytes(path, "DATA", compressed, available - 8)
        if inflated != needed or inflated > compressed * lzf.MAX_RATIO:
            raise InputError(
                path, f"says that {compressed} bytes inflate to {inflated}", field="DATA", expected=f"{needed} bytes"
            )
        body = file.read(compressed)
    _require_padding(path, header.offset + 8 + compressed)
    try:
        inflated_body = lzf.decompress(body, inflated)
    except ValueError as error:
        raise InputError(path, str(error), field="DATA", expected="a complete file") from error
    return _rows_of_columns(inflated_body, header)


def _rows_of_columns(body: bytes, header: _Header) -> NDArray[Any]:
    """Compressed PCD holds one whole column after the other."""
    rows = np.empty(header.points, dtype=header.row)
    start = 0
    for name in header.row.names or ():
        item = header.row[name]
        column = np.frombuffer(body, dtype=item, count=header.points, offset=start)
        rows[name] = column
        start += item.itemsize * header.points
    return rows


def _require_padding(path: Path, end: int) -> None:
    """Nothing but a little padding of zeros may follow the last point."""
    extra = file_size(path) - end
    if extra == 0:
        return
    if extra <= _MAX_PADDING:
        with path.open("rb") as file:
            file.seek(end)
            if not file.read(extra).strip(b"\0"):
                return
    raise InputError(path, f"has {extra} bytes more than its points take", field="POINTS", expected="the points alone")


def unpack_colours(cloud: Cloud) -> Cloud:
    """``rgb`` or ``rgba``, 0xAARRGGBB packed in four bytes, as red, green and blue."""
    for name in ("rgb", "rgba"):
        packed = cloud.fields.get(name)
        if packed is None or packed.dtype.itemsize != 4 or packed.ndim != 1:
            continue
        if set(RGB) & set(cloud.fields):
            continue
        octets = packed.view(np.uint32)
        colours = {
            colour: (octets >> shift & 0xFF).astype(np.uint8) for colour, shift in zip(RGB, (16, 8, 0), strict=True)
        }
        if name == "rgba":
            colours["alpha"] = (octets >> 24).astype(np.uint8)
        others = {key: column for key, column in cloud.fields.items() if key != name}
        return Cloud(cloud.points, {**others, **colours}, cloud.frame)
    return cloud


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write a binary PCD; the number of points is put into the header at the end."""
    with path.open("wb") as file:
        out = _Writer(file, columns, shown)
        yield out
        out.finish()


class _Writer(CountedFile):
    def __init__(self, file: IO[bytes], columns: Columns, shown: Path) -> None:
        self._packs = all(columns.fields.get(name) == np.uint8 for name in RGB)
        fields = dict(columns.fields)
        if self._packs:
            fields = {name: item for name, item in fields.items() if name not in RGB} | {"rgb": np.dtype(np.float32)}
        packed = Columns(columns.xyz, fields)
        self.row = packed.row()
        for name, item in fields.items():
            if item.base.kind not in "fiu" or item.base.itemsize > 8 or item.base == np.float16 or len(item.shape) > 1:
                raise InputError(shown, f"PCD has no type for {item}", field=name, expected="numbers of up to 8 bytes")
            if not name.isascii() or name.split() != [name]:
                raise InputError(shown, "is no name for a field of a PCD file", field=name, expected="one word")
        self._length = len("\n".join(self._lines(0))) + _HEADER_MARGIN
        super().__init__(file, packed)

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        super().append(self._pack(cloud) if self._packs else cloud)

    def _put_header(self) -> None:
        self._file.write(fill(self._lines(self._count), "# metres", self._length))

    def _lines(self, count: int) -> list[str]:
        row = self.row
        names = row.names or ()
        return [
            "# .PCD v0.7 - Point Cloud Data file format",
            "VERSION 0.7",
            "FIELDS " + " ".join(names),
            "SIZE " + " ".join(str(row[name].base.itemsize) for name in names),
            "TYPE " + " ".join(row[name].base.kind.upper() for name in names),
            "COUNT " + " ".join(str(int(np.prod(row[name].shape))) for name in names),
            f"WIDTH {count}",
            "HEIGHT 1",
            "VIEWPOINT 0 0 0 1 0 0 0",
            f"POINTS {count}",
            "DATA binary",
        ]

    def _pack(self, cloud: Cloud) -> Cloud:
        red, green, blue = (cloud.fields[name].astype(np.uint32) for name in RGB)
        others = {name: column for name, column in cloud.fields.items() if name not in RGB}
        packed = (red << 16 | green << 8 | blue).view(np.float32)
        return Cloud(cloud.points, {**others, "rgb": packed}, cloud.frame)


def write_encoded(path: Path, cloud: Cloud, encoding: Literal["ascii", "binary_compressed"]) -> None:
    """Write a PCD in one of its other encodings, in memory, for programs that insist on one.

    Raises
    ------
    InputError
        If the file cannot be written, or PCD cannot hold a field of the cloud.
    """
    fields = {name: np.dtype((column.dtype, column.shape[1:])) for name, column in cloud.fields.items()}
    with replacing(path) as temporary, temporary.open("w+b") as file:
        out = _Writer(file, Columns(np.dtype(cloud.points.dtype), fields), path)
        out.append(cloud)
        out.finish()
        file.seek(0)
        header, _, body = file.read().partition(b"DATA binary\n")
        rows = np.frombuffer(body, dtype=out.row)
        file.seek(0)
        file.truncate()
        file.write(header + b"DATA " + encoding.encode() + b"\n")
        if encoding == "ascii":
            _put_ascii(file, rows)
        else:
            columns = b"".join(np.ascontiguousarray(rows[name]).tobytes() for name in out.row.names or ())
            packed = lzf.compress(columns)
            file.write(struct.pack("<II", len(packed), len(columns)) + packed)


def _put_ascii(file: IO[bytes], rows: NDArray[Any]) -> None:
    formats: list[str] = []
    columns: list[NDArray[Any]] = []
    for name in rows.dtype.names or ():
        flat = rows[name].reshape(len(rows), -1)
        digits = "%d" if flat.dtype.kind in "iu" else "%.9g" if flat.itemsize == 4 else "%.17g"
        columns.extend(flat.T)
        formats.extend([digits] * flat.shape[1])
    table = np.empty(len(rows), dtype=[(f"c{k}", column.dtype) for k, column in enumerate(columns)])
    for k, column in enumerate(columns):
        table[f"c{k}"] = column
    np.savetxt(file, table, fmt=formats)
