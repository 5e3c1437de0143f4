"""E57 (ASTM E2807) by libE57, through pye57's low-level interface.

All scans of a file are put together in the file's frame, by their poses. Points that the file marks as invalid become
NaN. Reading is a chunk at a time, so a forged count costs no memory; libE57 verifies the checksum of every page.
Fields that the standard does not know are written as an extension of it, under the prefix ``lidarpose``.
"""

from __future__ import annotations

import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pye57 import libe57

from lidarpose.errors import InputError
from lidarpose.geometry.se3 import Pose
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import Columns
from lidarpose.storage.limits import require_bytes, require_count

_CHUNK = 1 << 18
_PREFIX = "lidarpose"
_EXTENSION = "https://lidarpose.readthedocs.io/e57-extension"
_NAMES = {"red": "colorRed", "green": "colorGreen", "blue": "colorBlue", "time": "timeStamp", "intensity": "intensity"}
_FIELDS = {theirs: ours for ours, theirs in _NAMES.items()}
_CARTESIAN = ("cartesianX", "cartesianY", "cartesianZ")
_SPHERICAL = ("sphericalRange", "sphericalAzimuth", "sphericalElevation")
_INVALID = ("cartesianInvalidState", "sphericalInvalidState")
_SIGNATURE = b"ASTM-E57"


def read(path: Path) -> Cloud:
    """Read all scans of an E57 file."""
    _check_header(path)
    try:
        image = libe57.ImageFile(str(path), "r")
    except Exception as error:
        raise _damaged(path, error) from error
    try:
        return _read_scans(path, image)
    except (InputError, MemoryError):
        raise
    except Exception as error:  # libE57's own exception, and RuntimeErrors of its binding
        raise _damaged(path, error) from error
    finally:
        image.close()


def _damaged(path: Path, error: Exception) -> InputError:
    problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
    return InputError(path, f"cannot be read as E57: {problem}", expected="a complete E57 file")


def _check_header(path: Path) -> None:
    """The file's own length, and where its XML lies (ASTM E2807, table of the file header)."""
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(48)
    if head[:8] != _SIGNATURE or len(head) < 48:
        raise InputError(path, "does not start with ASTM-E57", expected="an E57 file")
    length, xml_offset, xml_length, page = (int.from_bytes(head[k : k + 8], "little") for k in (16, 24, 32, 40))
    require_bytes(path, "filePhysicalLength", length, size)
    if length != size or page != 1024:
        raise InputError(path, f"is {length} in pages of {page}", field="filePhysicalLength", expected=f"{size}, 1024")
    require_bytes(path, "xmlLogicalLength", xml_offset + xml_length, size)


def _read_scans(path: Path, image: Any) -> Cloud:
    root = image.root()
    if not root.isDefined("data3D"):
        raise InputError(path, "has no scans", field="data3D", expected="an E57 file with points")
    scans = root["data3D"]
    clouds = [_read_scan(path, image, scans[k], k) for k in range(len(scans))]
    if not clouds:
        return Cloud(np.empty((0, 3)))
    # A field that some scans lack cannot be told for all points.
    common = [name for name in clouds[0].fields if all(name in cloud.fields for cloud in clouds)]
    fields = {name: np.concatenate([cloud.fields[name] for cloud in clouds]) for name in common}
    return Cloud(np.concatenate([cloud.points for cloud in clouds]), fields)


def _read_scan(path: Path, image: Any, scan: Any, index: int) -> Cloud:
    place = f"data3D[{index}]"
    points = scan["points"]
    prototype = libe57.StructureNode(points.prototype())
    kinds = _field_types(prototype)
    count = require_count(path, f"{place}.recordCount", points.childCount())
    names = [name for name in (*_CARTESIAN, *_SPHERICAL) if name in kinds]
    cartesian = set(_CARTESIAN) <= set(names)
    if not cartesian and not set(_SPHERICAL) <= set(names):
        raise InputError(path, "has no coordinates", field=place, expected="cartesianX, Y, Z or spherical ones")
    columns = _read_columns(path, place, image, points, kinds, count)
    if cartesian:
        xyz = np.column_stack([columns.pop(name) for name in _CARTESIAN])
    else:
        r, azimuth, elevation = (columns.pop(name).astype(np.float64) for name in _SPHERICAL)
        flat = r * np.cos(elevation)
        xyz = np.column_stack([flat * np.cos(azimuth), flat * np.sin(azimuth), r * np.sin(elevation)])
    for name in _INVALID:
        if (state := columns.pop(name, None)) is not None:
            xyz[state != 0] = np.nan
    pose = _pose(path, place, scan)
    if pose is not None:
        xyz = pose @ xyz.astype(np.float64)
    unused = {*_CARTESIAN, *_SPHERICAL}
    return Cloud(xyz, {_our_name(name): column for name, column in columns.items() if name not in unused})


def _our_name(name: str) -> str:
    return _FIELDS.get(name, name.rsplit(":", 1)[-1])


def _field_types(prototype: Any) -> dict[str, np.dtype[Any]]:
    """numpy types of a scan's numeric fields."""
    kinds: dict[str, np.dtype[Any]] = {}
    for k in range(prototype.childCount()):
        node = prototype.get(k)
        kind = node.type()
        if kind == libe57.E57_FLOAT:
            single = libe57.FloatNode(node).precision() == libe57.E57_SINGLE
            kinds[node.elementName()] = np.dtype(np.float32 if single else np.float64)
        elif kind == libe57.E57_SCALED_INTEGER:
            kinds[node.elementName()] = np.dtype(np.float64)
        elif kind == libe57.E57_INTEGER:
            whole = libe57.IntegerNode(node)
            kinds[node.elementName()] = _least_integer(whole.minimum(), whole.maximum())
    return kinds


def _least_integer(low: int, high: int) -> np.dtype[Any]:
    for item in (np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32):
        if np.iinfo(item).min <= low and high <= np.iinfo(item).max:
            return np.dtype(item)
    return np.dtype(np.int64)


def _read_columns(
    path: Path, place: str, image: Any, points: Any, kinds: dict[str, np.dtype[Any]], count: int
) -> dict[str, NDArray[Any]]:
    if count == 0:  # libE57 has no reader for a scan without packets
        return {name: np.empty(0, dtype=item) for name, item in kinds.items()}
    capacity = min(_CHUNK, count)
    buffers = libe57.VectorSourceDestBuffer()
    arrays = {name: np.empty(capacity, dtype=_buffer_type(item)) for name, item in kinds.items()}
    for name, array in arrays.items():
        buffers.append(libe57.SourceDestBuffer(image, name, array, capacity, True, True))
    parts: dict[str, list[NDArray[Any]]] = {name: [] for name in kinds}
    found = 0
    reader = points.reader(buffers)
    try:
        while got := reader.read():
            found += got
            for name, item in kinds.items():
                parts[name].append(arrays[name][:got].astype(item))
    finally:
        reader.close()
    if found != count:
        raise InputError(path, f"holds {found} of {count} points", field=f"{place}.recordCount", expected="all of them")
    return {name: np.concatenate(chunks) for name, chunks in parts.items()}


def _buffer_type(item: np.dtype[Any]) -> np.dtype[Any]:
    """Whole numbers of 32 bits and more go through ``long long``: the binding takes numpy's int64 for 32 bits."""
    return np.dtype(np.longlong) if item.kind in "iu" and item.itemsize >= 4 else item


def _pose(path: Path, place: str, scan: Any) -> Pose | None:
    if not scan.isDefined("pose"):
        return None
    pose = scan["pose"]
    quaternion, translation = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 0.0]
    if pose.isDefined("rotation"):
        quaternion = [float(pose["rotation"][axis].value()) for axis in "xyzw"]
    if pose.isDefined("translation"):
        translation = [float(pose["translation"][axis].value()) for axis in "xyz"]
    if quaternion == [0.0, 0.0, 0.0, 1.0] and not any(translation):
        return None
    try:
        return Pose.from_quaternion_xyzw(quaternion, translation)
    except ValueError as error:
        raise InputError(path, str(error), field=f"{place}.pose", expected="a rigid motion") from error


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write one scan, a chunk at a time; coordinates keep their precision, single or double."""
    with _as_os_errors():
        image = libe57.ImageFile(str(path), "w")
    try:
        out = _Writer(image, columns, shown)
        yield out
        out.close()
    except BaseException:
        image.cancel()
        raise
    with _as_os_errors():
        image.close()


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """A full disk, as libE57 tells it, is an OSError like any other."""
    try:
        yield
    except Exception as error:  # libE57's own exception, and RuntimeErrors of its binding
        raise OSError(f"libE57 says: {' '.join(str(error).split())[:200]}") from error


class _Writer:
    def __init__(self, image: Any, columns: Columns, shown: Path) -> None:
        self._columns, self._shown = columns, shown
        self._kinds = dict.fromkeys(_CARTESIAN, columns.xyz)
        self._sources = dict(zip(_CARTESIAN, (0, 1, 2), strict=True))
        self._fields = {self._their_name(name, item): name for name, item in columns.fields.items()}
        self._kinds |= {theirs: columns.fields[ours] for theirs, ours in self._fields.items()}
        self._arrays = {name: np.zeros(_CHUNK, dtype=_buffer_type(item)) for name, item in self._kinds.items()}
        self._state = np.zeros(_CHUNK, dtype=np.int8)
        self._out = self._begin(image)

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        self._columns.require_same(cloud)
        for start in range(0, len(cloud), _CHUNK):
            block = slice(start, min(start + _CHUNK, len(cloud)))
            points = cloud.points[block]
            finite = np.isfinite(points).all(axis=1)
            count = len(points)
            self._state[:count] = np.where(finite, 0, 2)
            for axis, name in enumerate(_CARTESIAN):
                self._arrays[name][:count] = np.where(finite, points[:, axis], 0.0)
            for theirs, ours in self._fields.items():
                self._arrays[theirs][:count] = cloud.fields[ours][block]
            with _as_os_errors():
                self._out.write(count)

    def close(self) -> None:
        """End the scan."""
        with _as_os_errors():
            self._out.close()

    def _their_name(self, name: str, item: np.dtype[Any]) -> str:
        if item.shape or item.kind not in "fiu" or item in (np.float16, np.uint64) or item.itemsize > 8:
            raise InputError(self._shown, f"E57 has no type for {item}", field=name, expected="one number a point")
        if not (name.isascii() and name.isidentifier()):
            raise InputError(
                self._shown, "is no name for a field of an E57 file", field=name, expected="letters and digits"
            )
        return _NAMES.get(name, f"{_PREFIX}:{name}")

    def _begin(self, image: Any) -> Any:
        """The file's tree (ASTM E2807), with one scan; returns the writer of its points."""
        image.extensionsAdd("", libe57.E57_V1_0_URI)
        if any(":" in name for name in self._fields):
            image.extensionsAdd(_PREFIX, _EXTENSION)
        root = image.root()
        root.set("formatName", libe57.StringNode(image, "ASTM E57 3D Imaging Data File"))
        root.set("guid", libe57.StringNode(image, f"{{{uuid.uuid4()}}}"))
        root.set("versionMajor", libe57.IntegerNode(image, libe57.E57_FORMAT_MAJOR))
        root.set("versionMinor", libe57.IntegerNode(image, libe57.E57_FORMAT_MINOR))
        root.set("e57LibraryVersion", libe57.StringNode(image, libe57.E57_LIBRARY_ID))
        scans = libe57.VectorNode(image, True)
        root.set("data3D", scans)
        root.set("images2D", libe57.VectorNode(image, True))
        scan = libe57.StructureNode(image)
        scan.set("guid", libe57.StringNode(image, f"{{{uuid.uuid4()}}}"))
        scan.set("name", libe57.StringNode(image, "lidarpose"))
        prototype = libe57.StructureNode(image)
        buffers = libe57.VectorSourceDestBuffer()
        for name, item in self._kinds.items():
            prototype.set(name, _node(image, item))
            buffers.append(libe57.SourceDestBuffer(image, name, self._arrays[name], _CHUNK, True, True))
        prototype.set(_INVALID[0], libe57.IntegerNode(image, 0, 0, 2))
        buffers.append(libe57.SourceDestBuffer(image, _INVALID[0], self._state, _CHUNK, True, True))
        points = libe57.CompressedVectorNode(image, prototype, libe57.VectorNode(image, True))
        scan.set("points", points)
        scans.append(scan)
        return points.writer(buffers)


def _node(image: Any, item: np.dtype[Any]) -> Any:
    if item.kind == "f":
        return libe57.FloatNode(image, 0.0, libe57.E57_SINGLE if item.itemsize == 4 else libe57.E57_DOUBLE)
    limits = np.iinfo(item)
    return libe57.IntegerNode(image, 0, int(limits.min), int(limits.max))
