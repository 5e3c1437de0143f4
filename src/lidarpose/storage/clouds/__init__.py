"""Point clouds in and out, the format chosen by the suffix: PLY, PCD, LAS, LAZ, E57, NPY, XYZ text.

Fields beyond x, y, z keep their names and types. Points that are not finite (a PCD of an organised cloud marks beams
without return so) are kept; `Cloud.finite` drops them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.atomic import replacing
from lidarpose.storage.clouds.columns import CloudWriter, Columns
from lidarpose.storage.limits import file_size

Result = TypeVar("Result")

# Modules are named as text: LAS and E57 libraries are imported only where such a file is met.
_FORMATS = {
    ".ply": "ply",
    ".pcd": "pcd",
    ".las": "las",
    ".laz": "las",
    ".e57": "e57",
    ".npy": "npy",
    ".xyz": "xyz",
    ".txt": "xyz",
    ".csv": "xyz",
    ".pts": "xyz",
    ".asc": "xyz",
}
CLOUD_SUFFIXES = tuple(_FORMATS)
"""The suffixes that name a cloud, in lower case."""

MILLIMETRE_DISTANCE_M = 300.0
"""No sensor that this package calibrates sees half of its points beyond 300 m, and none that writes millimetres sees
half of them within 300 mm."""


def read_cloud(path: Path) -> Cloud:
    """Read a cloud; its format is chosen by the suffix.

    Returns
    -------
    Cloud
        Points (N, 3) as float32 where the file holds float32, else float64, in the file's unit and frame; further
        fields under the file's names, except that colours are ``red``, ``green``, ``blue``, and the time of a point
        in LAS and E57 is ``time``. Non-finite points are kept.

    Raises
    ------
    InputError
        If the suffix names no format, or the file does not hold exactly what its header promises.
    """
    path = Path(path)
    module = _format(path)
    file_size(path)
    try:
        cloud: Cloud = import_module(module).read(path)
    except MemoryError as error:
        raise InputError(path, "does not fit into memory", expected="a smaller cloud") from error
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}") from error
    return cloud


def look_at_points(path: Path, look: Callable[[NDArray[np.floating[Any]]], Result]) -> Result:
    """What `look` makes of the points (N, 3) that `read_cloud` would return, without memory for them.

    `look` gets an array that may be written over once it has returned; it keeps nothing of it but copies.

    Raises
    ------
    InputError
        As `read_cloud` does.
    """
    lend = getattr(import_module(_format(path)), "lent", None)
    points = None
    if lend is not None:
        file_size(path)
        try:
            points = lend(path)
        except OSError as error:
            raise InputError(path, f"cannot be read: {error.strerror or error}") from error
    return look(read_cloud(path).points if points is None else points)


def write_cloud(path: Path, cloud: Cloud) -> None:
    """Write a cloud whole or not at all, in the format that the suffix names, with all its fields.

    Raises
    ------
    InputError
        If the suffix names no format, the file cannot be written, or the format cannot hold the cloud (LAS holds no
        NaN).
    """
    fields = {name: np.dtype((column.dtype, column.shape[1:])) for name, column in cloud.fields.items()}
    columns = Columns(np.dtype(cloud.points.dtype), fields)
    with _open(Path(path), columns) as writer:
        writer.append(cloud)


@contextmanager
def open_cloud_writer(
    path: Path, *, fields: Mapping[str, DTypeLike] | None = None, dtype: DTypeLike = np.float32
) -> Iterator[CloudWriter]:
    """A writer for clouds larger than memory: ``append`` clouds one after the other, each with all of `fields`.

    The file appears under its name when the block ends well, and not at all otherwise.

    Parameters
    ----------
    fields
        Names and types of the columns beyond x, y, z.
    dtype
        float32 or float64, the type of x, y, z where the format leaves a choice.
    """
    columns = Columns(np.dtype(dtype), {name: np.dtype(d) for name, d in (fields or {}).items()})
    with _open(Path(path), columns) as writer:
        yield writer


@contextmanager
def _open(path: Path, columns: Columns) -> Iterator[CloudWriter]:
    module = import_module(_format(path))
    with replacing(path, durable=False) as temporary, module.writer(temporary, columns, path) as writer:
        yield writer


def looks_like_millimetres(cloud: Cloud) -> bool:
    """Whether a cloud in a sensor's own frame is in millimetres: half of its points beyond 300 units.

    Not for clouds in a world frame, whose origin may be anywhere.
    """
    points = cloud.points
    if len(points) > 100_000:
        points = points[:: len(points) // 50_000]
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return False
    distance = np.linalg.norm(points.astype(np.float64), axis=1)
    seen = distance[distance > 0.0]
    return bool(len(seen) and np.median(seen) > MILLIMETRE_DISTANCE_M)


def _format(path: Path) -> str:
    name = _FORMATS.get(path.suffix.lower())
    if name is None:
        problem = f"the suffix {path.suffix} names no cloud format" if path.suffix else "has no suffix"
        raise InputError(path, problem, expected="one of " + " ".join(CLOUD_SUFFIXES))
    return f"lidarpose.storage.clouds.{name}"
