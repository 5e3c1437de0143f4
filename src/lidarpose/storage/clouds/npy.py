"""NPY: an (N, 3) array of coordinates, or a structured array (N,) with fields x, y, z and others.

A plain (N, k) array with k > 3 is read too; its further columns have no names and become ``column_4`` and so on.
Pickled objects are never read.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.lib import format as npy_format

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import Columns, CountedFile, read_rows
from lidarpose.storage.npy_header import read_npy_header


def read(path: Path) -> Cloud:
    """Read a cloud from an NPY file."""
    shape, _, dtype, offset = read_npy_header(path)
    if dtype.names is not None and len(shape) == 1:
        return read_rows(path, offset, dtype, shape[0])
    array = np.load(path, allow_pickle=False)
    if dtype.names is None and dtype.kind in "fiu" and len(shape) == 2 and shape[1] >= 3:
        kept = np.float32 if dtype.kind == "f" and dtype.itemsize == 4 else np.float64
        fields = {f"column_{k + 1}": np.ascontiguousarray(array[:, k]) for k in range(3, shape[1])}
        return Cloud(np.ascontiguousarray(array[:, :3], dtype=kept), fields)
    raise InputError(
        path, f"holds an array {shape} of {dtype}", expected="(N, 3) numbers, or (N,) rows with fields x, y, z"
    )


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write an NPY file; the number of points is put into the header at the end."""
    with path.open("wb") as file:
        out = _Writer(file, columns)
        yield out
        out.finish()


class _Writer(CountedFile):
    def _put_header(self) -> None:
        # numpy pads its header so that the first extent can grow without changing the length.
        plain = not self._columns.fields
        dtype = self._columns.xyz.newbyteorder("<") if plain else self._columns.row()
        shape = (self._count, 3) if plain else (self._count,)
        header = {"descr": npy_format.dtype_to_descr(dtype), "fortran_order": False, "shape": shape}
        npy_format.write_array_header_1_0(self._file, header)
