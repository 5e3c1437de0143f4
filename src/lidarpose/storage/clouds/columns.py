"""Columns of a cloud as rows of a file: what PCD, PLY and NPY share."""

from __future__ import annotations

import io
import re
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Protocol

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud

XYZ = ("x", "y", "z")
RGB = ("red", "green", "blue")
BLOCK_ROWS = 1 << 18
"""Rows that are put together at a time when writing."""


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


def write_rows(file: IO[bytes], columns: Columns, cloud: Cloud) -> None:
    """Append the cloud's rows to an open file, a block at a time."""
    columns.require_same(cloud)
    if not columns.fields:
        for block in _blocks(len(cloud)):
            np.ascontiguousarray(cloud.points[block], dtype=columns.xyz.newbyteorder("<")).tofile(file)
        return
    rows = np.empty(min(len(cloud), BLOCK_ROWS), dtype=columns.row())
    for block in _blocks(len(cloud)):
        part = rows[: block.stop - block.start]
        _coordinates(part, columns.xyz)[...] = cloud.points[block]
        for name in columns.fields:
            part[name] = cloud.fields[name][block]
        part.tofile(file)


def cloud_of_rows(rows: NDArray[Any], path: Path, *, skip: tuple[str, ...] = ()) -> Cloud:
    """A cloud of structured rows (N,) with fields x, y, z and others; native byte order, contiguous columns.

    Raises
    ------
    InputError
        If x, y or z is missing.
    """
    names = rows.dtype.names or ()
    missing = [name for name in XYZ if name not in names]
    if missing:
        raise InputError(
            path,
            f"has no {', '.join(missing)} among its fields ({', '.join(names) or 'none'})",
            expected="the fields x, y and z",
        )
    if any(rows.dtype[name].shape or rows.dtype[name].kind not in "fiu" for name in XYZ):
        raise InputError(path, "has more than one number, or no number, in x, y or z", expected="one number each")
    single = all(rows.dtype[name].base == rows[name].dtype and rows[name].dtype.itemsize == 4 for name in XYZ)
    single = single and all(rows.dtype[name].kind == "f" for name in XYZ)
    points = _stack_coordinates(rows, np.dtype(np.float32) if single else np.dtype(np.float64))
    fields = {name: _native(rows[name]) for name in names if name not in XYZ and name not in skip}
    return Cloud(points, fields)


def _stack_coordinates(rows: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[np.floating[Any]]:
    if rows.dtype.names == XYZ and rows.dtype == np.dtype([(name, dtype) for name in XYZ]):
        return rows.view(dtype).reshape(-1, 3)  # nothing but coordinates: the rows are the points
    points = np.empty((len(rows), 3), dtype=dtype)
    for axis, name in enumerate(XYZ):
        points[:, axis] = rows[name]
    return points


def _native(column: NDArray[Any]) -> NDArray[Any]:
    return np.ascontiguousarray(column, dtype=column.dtype.newbyteorder("="))


def _coordinates(rows: NDArray[Any], dtype: np.dtype[Any]) -> NDArray[Any]:
    """View (N, 3) on the x, y, z at the head of each row."""
    return np.ndarray((len(rows), 3), dtype.newbyteorder("<"), rows, 0, (rows.dtype.itemsize, dtype.itemsize))


def _blocks(count: int) -> Iterator[slice]:
    for start in range(0, count, BLOCK_ROWS):
        yield slice(start, min(start + BLOCK_ROWS, count))


def read_rows(path: Path, offset: int, dtype: np.dtype[Any], count: int) -> NDArray[Any]:
    """`count` rows from a byte offset; InputError if fewer are there."""
    rows = np.fromfile(path, dtype=dtype, count=count, offset=offset)
    if len(rows) != count:
        raise InputError(path, f"holds {len(rows)} points where its header promises {count}", expected="all of them")
    return rows


def parse_table(path: Path, file: IO[bytes], dtype: np.dtype[Any], count: int | None) -> NDArray[Any]:
    """Rows (N,) of whitespace-separated numbers from where `file` stands, one line each; blank lines are no rows.

    Parameters
    ----------
    dtype
        Structured; sub-arrays take as many numbers as they have elements.
    count
        How many rows to read; None reads to the end of the file.

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
            rows = np.loadtxt(text, dtype=dtype, comments=None, max_rows=count, ndmin=1)
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
