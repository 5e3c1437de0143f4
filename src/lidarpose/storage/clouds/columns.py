"""Columns of a cloud as rows of a file: what PCD, PLY and NPY share."""

from __future__ import annotations

import errno
import io
import os
import re
import sys
import threading
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud

XYZ = ("x", "y", "z")
RGB = ("red", "green", "blue")
_is_little = sys.byteorder == "little"
BLOCK_BYTES = 1 << 17
"""Rows are put together and taken apart in blocks that stay in the cache; larger ones took twice the time."""


RESERVED_FROM_BYTES = 1 << 20
LENT_BYTES = 1 << 23
"""Files of more bytes are read into memory of their own, which is given back."""


class CloudWriter(Protocol):
    """Takes clouds one after the other; all have the fields that the writer was opened with."""

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        ...


@dataclass(frozen=True)
class Columns:
    """The columns of a cloud: the type of x, y, z, and the others by name (a type with a shape for (N, k) columns)."""

    xyz: np.dtype[Any]
    fields: Mapping[str, np.dtype[Any]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.xyz not in (np.dtype(np.float32), np.dtype(np.float64)):
            raise ValueError(f"coordinates are float32 or float64, not {self.xyz}")
        if taken := set(self.fields) & set(XYZ):
            raise ValueError(f"{sorted(taken)} are names of coordinates")

    def row(self) -> np.dtype[Any]:
        """One packed little-endian row: x, y, z, then the fields in order."""
        items = [(name, self.xyz) for name in XYZ] + list(self.fields.items())
        return np.dtype([(name, item.base.newbyteorder("<"), item.shape) for name, item in items])

    def require_same(self, cloud: Cloud) -> None:
        """ValueError if a cloud lacks a field or has another one."""
        if set(cloud.fields) != set(self.fields):
            raise ValueError(f"the writer was opened for the fields {list(self.fields)}, found {list(cloud.fields)}")


class CountedFile:
    """A cloud file of rows whose header says how many: written first as of none, and again at the end, as long."""

    def __init__(self, file: IO[bytes], columns: Columns) -> None:
        self._file, self._columns, self._count = file, columns, 0
        self._put_header()

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        write_rows(self._file, self._columns, cloud)
        self._count += len(cloud)

    def finish(self) -> None:
        """Put the number of points into the header."""
        self._file.seek(0)
        self._put_header()

    def _put_header(self) -> None:
        raise NotImplementedError


def write_rows(file: IO[bytes], columns: Columns, cloud: Cloud) -> None:
    """Append the cloud's rows to an open file, a block at a time."""
    columns.require_same(cloud)
    row = columns.row()
    _reserve(file, len(cloud) * row.itemsize)
    as_they_lie = cloud.points.dtype == columns.xyz and cloud.points.flags.c_contiguous and _is_little
    if as_they_lie and not columns.fields:
        file.write(cloud.points.reshape(-1).view(np.uint8).data)
        return
    sources: dict[str, NDArray[Any]] = {name: cloud.points[:, axis] for axis, name in enumerate(XYZ)}
    if as_they_lie and row.itemsize % columns.xyz.itemsize:
        # In rows of odd lengths NumPy copies one long item twice as quickly as three numbers.
        whole = np.dtype((np.void, 3 * columns.xyz.itemsize))
        row = np.dtype([("xyz", whole), *((name, row[name]) for name in columns.fields)])
        sources = {"xyz": cloud.points.view(whole)[:, 0]}
    sources |= {name: cloud.fields[name] for name in columns.fields}
    buffer = np.empty(_block_rows(row, len(cloud)), dtype=row)
    for block in blocks(len(cloud), len(buffer)):
        part = buffer[: block.stop - block.start]
        for name, source in sources.items():
            part[name] = source[block]
        file.write(part.view(np.uint8).data)


def _reserve(file: IO[bytes], size: int) -> None:
    """Let the file system set aside room for what comes next.

    ext4 flushes a file whose room is not yet set aside to the disk when it is renamed over another one (its option
    auto_da_alloc), which takes longer than writing it to the page cache. A full disk is noticed here at the latest.
    """
    if size < RESERVED_FROM_BYTES or not hasattr(os, "posix_fallocate"):
        return
    try:
        os.posix_fallocate(file.fileno(), file.tell(), size)
    except OSError as error:
        if error.errno not in (errno.EOPNOTSUPP, errno.EINVAL, errno.ENODEV, errno.ESPIPE):
            raise


def read_rows(path: Path, offset: int, row: np.dtype[Any], count: int, *, skip: tuple[str, ...] = ()) -> Cloud:
    """A cloud of `count` rows from a byte offset, a block at a time: the rows are never in memory as a whole.

    Raises
    ------
    InputError
        If x, y or z is missing, or fewer rows are there.
    """
    single = _require_coordinates(row, path)
    if row.names == XYZ and row in (np.dtype([(name, kind) for name in XYZ]) for kind in ("<f4", "<f8")) and _is_little:
        flat = np.fromfile(path, dtype=row["x"], count=3 * count, offset=offset)
        _require_all(path, len(flat) // 3, count)
        return Cloud(flat.reshape(-1, 3))
    points = np.empty((count, 3), dtype=np.float32 if single else np.float64)
    names = [name for name in row.names or () if name not in XYZ and name not in skip]
    fields = {name: np.empty((count, *row[name].shape), row[name].base.newbyteorder("=")) for name in names}
    buffer = np.empty(_block_rows(row, count), dtype=row)
    with path.open("rb", buffering=0) as file:
        file.seek(offset)
        for block in blocks(count, len(buffer)):
            part = buffer[: block.stop - block.start]
            got = _fill(file, part.view(np.uint8).data)
            _require_all(path, block.start + got // row.itemsize, count if got < part.nbytes else block.stop)
            target = points[block]
            for axis, name in enumerate(XYZ):
                target[:, axis] = part[name]
            for name, column in fields.items():
                column[block] = part[name]
    return Cloud(points, fields)


class _Lent(threading.local):
    """Memory of a thread's own into which rows are read that nobody keeps."""

    def __init__(self) -> None:
        self.memory = np.empty(0, dtype=np.uint8)

    def bytes(self, size: int) -> NDArray[np.uint8]:
        if len(self.memory) < size:
            # The next frame may hold a few points more.
            self.memory = np.empty(size + size // 8, dtype=np.uint8)
        return self.memory[:size]


_lent = _Lent()


def lent_points(path: Path, offset: int, row: np.dtype[Any], count: int) -> NDArray[np.floating[Any]] | None:
    """Points (N, 3) of `count` rows from a byte offset where they lie among the other columns, in memory of the calling
    thread that its next call writes over; None where they are too many or lie otherwise than side by side.

    Raises
    ------
    InputError
        If x, y or z is missing, or fewer rows are there.
    """
    _require_coordinates(row, path)
    layout = _side_by_side(row)
    if layout is None or count * row.itemsize > LENT_BYTES:
        return None
    kind, first = layout
    memory = _lent.bytes(count * row.itemsize)
    with path.open("rb", buffering=0) as file:
        file.seek(offset)
        _require_all(path, _fill(file, memory.data) // max(row.itemsize, 1), count)
    return np.ndarray((count, 3), kind, memory.data, first, (row.itemsize, kind.itemsize))


@lru_cache(maxsize=16)
def _side_by_side(row: np.dtype[Any]) -> tuple[np.dtype[Any], int] | None:
    """The type of x, y and z, and where x lies in a row, if they lie side by side as NumPy wants them."""
    kind = row[XYZ[0]]
    if kind not in (np.dtype(np.float32), np.dtype(np.float64)) or any(row[name] != kind for name in XYZ):
        return None
    first, *others = (row.fields[name][1] for name in XYZ) if row.fields else (0,)
    aligned = (first | row.itemsize) % kind.itemsize == 0
    return (kind, first) if aligned and others == [first + kind.itemsize, first + 2 * kind.itemsize] else None


def _fill(file: io.FileIO, target: memoryview) -> int:
    """Read until `target` is full or the file ends; how many bytes came."""
    got = 0
    while got < len(target) and (more := file.readinto(target[got:])):
        got += more
    return got


def _require_all(path: Path, found: int, promised: int) -> None:
    if found != promised:
        raise InputError(path, f"holds {found} points where its header promises {promised}", expected="all of them")


def cloud_of_rows(rows: NDArray[Any], path: Path, *, skip: tuple[str, ...] = ()) -> Cloud:
    """A cloud of structured rows (N,) with fields x, y, z and others; native byte order, contiguous columns.

    Raises
    ------
    InputError
        If x, y or z is missing.
    """
    single = _require_coordinates(rows.dtype, path)
    points = np.empty((len(rows), 3), dtype=np.float32 if single else np.float64)
    for axis, name in enumerate(XYZ):
        points[:, axis] = rows[name]
    names = [name for name in rows.dtype.names or () if name not in XYZ and name not in skip]
    return Cloud(points, {name: _native(rows[name]) for name in names})


def _require_coordinates(row: np.dtype[Any], path: Path) -> bool:
    """InputError unless a row has x, y and z, one number each; True if all three are float32."""
    names = row.names or ()
    missing = [name for name in XYZ if name not in names]
    if missing:
        raise InputError(
            path,
            f"has no {', '.join(missing)} among its fields ({', '.join(names) or 'none'})",
            expected="the fields x, y and z",
        )
    if any(row[name].shape or row[name].kind not in "fiu" for name in XYZ):
        raise InputError(path, "has more than one number, or no number, in x, y or z", expected="one number each")
    return all(row[name].kind == "f" and row[name].itemsize == 4 for name in XYZ)


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("="))


def _block_rows(row: np.dtype[Any], count: int) -> int:
    return max(1, min(count, BLOCK_BYTES // row.itemsize))


def blocks(count: int, rows: int) -> Iterator[slice]:
    """Slices of at most `rows` that cover `count`."""
    for start in range(0, count, rows):
        yield slice(start, min(start + rows, count))


def parse_table(
    path: Path, file: IO[bytes], dtype: np.dtype[Any], count: int | None, *, comments: str | None = None
) -> NDArray[Any]:
    """Rows (N,) of whitespace-separated numbers from where `file` stands, one line each; blank lines are no rows.

    Parameters
    ----------
    dtype
        Structured; sub-arrays take as many numbers as they have elements.
    count
        How many rows to read; None reads to the end of the file.
    comments
        What begins the part of a line that is passed over.

    Raises
    ------
    InputError
        If a line has a number too many or too few, or something that is no number of its column's type, or if there
        are fewer than `count` rows.
    """
    text = io.TextIOWrapper(file, encoding="latin-1", newline=None)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # "no data": the count says so below
            warnings.simplefilter("error", DeprecationWarning)  # a float where an integer belongs
            rows = np.loadtxt(text, dtype=dtype, comments=comments, max_rows=count, ndmin=1)
    except (ValueError, OverflowError, TypeError, DeprecationWarning) as error:
        wanted = sum(int(np.prod(dtype[name].shape)) for name in dtype.names or ())
        # numpy counts from 0 where it names the column, too, and from 1 elsewhere.
        row = re.search(r"at row (\d+)(, column)?", str(error))
        place = f"point {int(row[1]) + bool(row[2])}" if row else None
        problem = re.sub(r"[;.] *(use `usecols`.*|)$", "", str(error).splitlines()[0])
        raise InputError(path, f"cannot be read: {problem}", field=place, expected=f"{wanted} numbers a line") from None
    finally:
        text.detach()
    if rows.dtype != dtype:
        rows = np.empty(0, dtype=dtype)
    if count is not None and len(rows) != count:
        raise InputError(path, f"holds {len(rows)} points where its header promises {count}", expected="all of them")
    return rows
