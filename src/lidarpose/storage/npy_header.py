"""The header of an NPY file, read without trust and compared with the file's size."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from numpy.lib import format as npy_format

from lidarpose.errors import InputError
from lidarpose.storage.limits import file_size, require_bytes, require_count


def read_npy_header(path: Path) -> tuple[tuple[int, ...], bool, np.dtype[Any], int]:
    """Shape, whether in Fortran's order, type, and the byte offset of the data, which are there exactly.

    Raises
    ------
    InputError
        If the file is missing or no NPY file, holds Python objects, or has not the bytes that its header promises.
    """
    size = file_size(path)
    with path.open("rb") as file:
        try:
            version = npy_format.read_magic(file)
            if version not in ((1, 0), (2, 0)):
                raise ValueError(f"version {version}")
            reader = npy_format.read_array_header_1_0 if version == (1, 0) else npy_format.read_array_header_2_0
            shape, fortran, dtype = reader(file)
        except MemoryError as error:
            raise InputError(path, "is no NPY file: its header is too long", expected="an array") from error
        except Exception as error:  # numpy parses the header as Python, and lets the tokenizer's errors through
            problem = str(error).splitlines()[0][:200] if str(error) else "its header is damaged"
            raise InputError(path, f"is no readable .npy file: {problem}", expected="an array") from error
        offset = file.tell()
    if dtype.hasobject:
        raise InputError(path, "holds Python objects", expected="an array of numbers")
    for extent in shape:
        require_count(path, "shape", extent)
    needed = math.prod(shape) * dtype.itemsize
    require_bytes(path, "shape", needed, size - offset)
    if needed != size - offset:
        raise InputError(path, "has more bytes than its array takes", field="shape", expected="one array alone")
    return tuple(int(extent) for extent in shape), bool(fortran), dtype, offset
