"""LAS and LAZ by laspy and lazrs, the header compared with the file first.

Coordinates are stored as multiples of 0.01 mm from an offset near the first points, so rounding moves no point by
more than 0.005 mm; that reaches 21 km from the offset. LAS names the time of a point ``gps_time`` (here ``time``) and
has 16 bits of intensity; an intensity of another type is kept exactly in the extra dimension ``intensity_exact``
beside the rounded one. Fields that LAS does not know become extra dimensions.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import laspy
import lazrs
import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.clouds.columns import RGB, Columns
from lidarpose.storage.limits import file_size, require_bytes, require_count

SCALE_M = 1e-5
"""Step of the stored coordinates, 0.01 mm."""
_CHUNK = 1_000_000
_EXACT_INTENSITY = "intensity_exact"
_LEAST_HEADER = 227
_VLR_BYTES, _EVLR_BYTES = 54, 60
_VARIABLE, _MAX_CHUNK = 2**32 - 1, 1 << 24
"""Points in a chunk of LAZ: not fixed, or at most so many (writers use 50 000)."""
_RAW = {"X", "Y", "Z"}
_MAX_LAZ_RATIO = 5000
"""LAZ codes runs of equal points in next to nothing: two million of them were compressed 2850 times."""


def read(path: Path) -> Cloud:
    """Read a LAS or LAZ file."""
    _check_header(path)
    try:
        with laspy.open(path) as reader:
            if reader.header.are_points_compressed:
                _check_chunks(path, reader.header)
            return _read_points(path, reader)
    except (InputError, KeyboardInterrupt, SystemExit):
        raise
    except BaseException as error:  # laspy raises every kind on damaged files, lazrs Rust's panics, no Exceptions
        problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(path, f"cannot be read as LAS: {problem}", expected="a complete LAS or LAZ file") from error


def _check_header(path: Path) -> None:
    """Compare what the public header promises with the bytes that are there (LAS 1.4, section 2.4)."""
    size = file_size(path)
    with path.open("rb") as file:
        head = file.read(375)
    if head[:4] != b"LASF":
        raise InputError(path, "does not start with LASF", expected="a LAS or LAZ file")
    require_bytes(path, "header", _LEAST_HEADER, size)
    header_size, point_offset, vlr_count = struct.unpack_from("<HII", head, 94)
    point_format, record_length, count = head[104], *struct.unpack_from("<HI", head, 105)
    if header_size < _LEAST_HEADER or point_offset < header_size:
        raise InputError(path, f"is {header_size}, with points from byte {point_offset}", field="header size")
    require_bytes(path, "offset to points", point_offset, size)
    require_bytes(path, "number of VLRs", vlr_count * _VLR_BYTES, point_offset - header_size)
    if (head[24], head[25]) >= (1, 4):
        require_bytes(path, "header", 375, min(header_size, size))
        evlr_start, evlr_count, count = struct.unpack_from("<QIQ", head, 235)
        if evlr_count:
            require_bytes(path, "number of EVLRs", evlr_start + evlr_count * _EVLR_BYTES, size)
    require_count(path, "number of points", count)
    if record_length == 0:
        raise InputError(path, "is 0", field="point record length", expected="at least 20 bytes")
    compressed = bool(point_format & 0x80)
    ratio = _MAX_LAZ_RATIO if compressed else 1
    require_bytes(path, "number of points", count * record_length, (size - point_offset) * ratio)
    scales = struct.unpack_from("<6d", head, 131)
    if not (np.isfinite(scales).all() and min(scales[:3]) > 0.0):
        raise InputError(path, f"are {scales}", field="scale and offset", expected="finite numbers, scales above 0")


def _check_chunks(path: Path, header: Any) -> None:
    """Compare LAZ's own header and table of chunks with the file: lazrs allocates what they promise, or aborts."""
    compression = lazrs.LazVlr(header.vlrs[header.vlrs.index("LasZipVlr")].record_data)
    if compression.item_size() != header.point_format.size:
        raise InputError(
            path, f"is {compression.item_size()}", field="size of LAZ items", expected=str(header.point_format.size)
        )
    if compression.chunk_size() != _VARIABLE and not 0 < compression.chunk_size() <= _MAX_CHUNK:
        raise InputError(path, f"is {compression.chunk_size()}", field="chunk size", expected=f"1 to {_MAX_CHUNK}")
    size, start = file_size(path), header.offset_to_point_data
    with path.open("rb") as file:
        file.seek(start)
        (table,) = struct.unpack("<q", file.read(8).ljust(8, b"\0"))
        if table == -1:  # written as a stream: the last eight bytes tell
            file.seek(size - 8)
            (table,) = struct.unpack("<q", file.read(8))
        if not start + 8 <= table <= size - 8:
            raise InputError(
                path, f"is {table}", field="offset of the chunk table", expected=f"{start + 8} to {size - 8}"
            )
        file.seek(table + 4)
        (chunks,) = struct.unpack("<I", file.read(4))
        require_bytes(path, "number of chunks", chunks, table - start - 8)
        file.seek(start)
        entries = lazrs.read_chunk_table(file, compression) if chunks else []
    require_bytes(path, "sizes of chunks", sum(entry[1] for entry in entries), table - start - 8)
    points = sum(entry[0] for entry in entries)
    variable = compression.chunk_size() == _VARIABLE
    if points < header.point_count or (variable and points != header.point_count):
        expected = f"{header.point_count} points in its chunks"
        raise InputError(path, f"has chunks for {points} points", field="chunk table", expected=expected)


def _read_points(path: Path, reader: Any) -> Cloud:
    promised = reader.header.point_count
    chunks: list[Cloud] = []
    found = 0
    for chunk in reader.chunk_iterator(_CHUNK):
        chunks.append(_cloud_of_chunk(chunk))
        found += len(chunks[-1])
    if found != promised:
        raise InputError(path, f"holds {found} points where its header promises {promised}", expected="all of them")
    if not chunks:
        return Cloud(np.empty((0, 3)))
    points = np.concatenate([chunk.points for chunk in chunks])
    fields = {name: np.concatenate([chunk.fields[name] for chunk in chunks]) for name in chunks[0].fields}
    extra = set(reader.header.point_format.extra_dimension_names)
    return Cloud(points, _natural_fields(fields, extra))


def _cloud_of_chunk(chunk: Any) -> Cloud:
    points = np.column_stack([np.asarray(axis, dtype=np.float64) for axis in (chunk.x, chunk.y, chunk.z)])
    names = [name for name in chunk.point_format.dimension_names if name not in _RAW]
    return Cloud(points, {name: np.array(chunk[name]) for name in names})


def _natural_fields(fields: dict[str, NDArray[Any]], extra: set[str]) -> dict[str, NDArray[Any]]:
    """Fields as the other formats have them. A dimension of the standard that is zero throughout says nothing."""
    kept = {name: column for name, column in fields.items() if name in extra or name == "gps_time" or column.any()}
    if "gps_time" in kept:
        kept["time"] = kept.pop("gps_time")
    if _EXACT_INTENSITY in kept:
        kept["intensity"] = kept.pop(_EXACT_INTENSITY)
    colours = [fields[name] for name in RGB if name in fields]
    if any(name in kept for name in RGB) and all(not (column % 257).any() for column in colours):
        kept |= {name: (column // 257).astype(np.uint8) for name, column in zip(RGB, colours, strict=True)}
    return kept


@contextmanager
def writer(path: Path, columns: Columns, shown: Path) -> Iterator[_Writer]:
    """Write LAS 1.4, or LAZ where the suffix says so, a chunk at a time."""
    out = _Writer(path, columns, shown)
    try:
        yield out
        out.require_open()
    finally:
        out.close()


@contextmanager
def _as_os_errors() -> Iterator[None]:
    """A full disk, as lazrs tells it, is an OSError like any other."""
    try:
        yield
    except lazrs.LazrsError as error:
        raise OSError(str(error)) from error


class _Writer:
    def __init__(self, path: Path, columns: Columns, shown: Path) -> None:
        self._path, self._columns, self._shown = path, columns, shown
        self._out: Any = None

    def append(self, cloud: Cloud) -> None:
        """Write the points of `cloud` after those before."""
        self._columns.require_same(cloud)
        if len(cloud) == 0:
            return
        self._require_finite(cloud)
        if self._out is None:
            self._open(np.round(np.median(cloud.points.astype(np.float64), axis=0)))
        for start in range(0, len(cloud), _CHUNK):
            self._write(cloud, slice(start, start + _CHUNK))

    def require_open(self) -> None:
        """A cloud without points is a file, too."""
        if self._out is None:
            self._open(np.zeros(3))

    def close(self) -> None:
        if self._out is not None:
            with _as_os_errors():
                self._out.close()

    def _open(self, offset: NDArray[Any]) -> None:
        has_time = "time" in self._columns.fields
        has_colour = all(name in self._columns.fields for name in RGB)
        header = laspy.LasHeader(version="1.4", point_format=2 * has_colour + has_time)
        header.offsets, header.scales = offset, np.full(3, SCALE_M)
        header.generating_software = "lidarpose"
        standard = set(header.point_format.standard_dimension_names)
        for name, item in self._columns.fields.items():
            if target := self._extra_name(name, item, standard):
                header.add_extra_dim(laspy.ExtraBytesParams(name=target, type=item))
        self._header = header
        compress = self._shown.suffix.lower() == ".laz"
        self._out = laspy.open(self._path, mode="w", header=header, do_compress=compress)

    def _extra_name(self, name: str, item: np.dtype[Any], standard: set[str]) -> str | None:
        """The extra dimension for a field, or None where a standard one holds it exactly."""
        if name == "intensity":
            return None if item in (np.uint8, np.uint16) else _EXACT_INTENSITY
        if (name == "time" and item == np.float64) or (
            name in RGB and name in standard and item in (np.uint8, np.uint16)
        ):
            return None
        if item.shape or item.kind not in "fiu" or item.itemsize > 8 or item == np.float16:
            raise InputError(self._shown, f"LAS has no type for {item}", field=name, expected="one number a point")
        if not name.isascii() or len(name) > 32 or name in standard:
            raise InputError(self._shown, "cannot be an extra dimension of LAS", field=name, expected="another name")
        return name

    def _write(self, cloud: Cloud, block: slice) -> None:
        points = cloud.points[block].astype(np.float64)
        steps = np.rint((points - self._header.offsets) / SCALE_M)
        if np.abs(steps).max() >= 2**31:
            raise InputError(
                self._shown,
                f"points lie more than {2**31 * SCALE_M / 1e3:.0f} km apart",
                expected="a cloud whose coordinates fit LAS at steps of 0.01 mm",
                remedy="Write PLY instead.",
            )
        record = laspy.ScaleAwarePointRecord.zeros(len(points), header=self._header)
        record.X, record.Y, record.Z = steps.astype(np.int32).T
        for name in self._columns.fields:
            self._set(record, name, cloud.fields[name][block])
        with _as_os_errors():
            self._out.write_points(record)

    def _set(self, record: Any, name: str, column: NDArray[Any]) -> None:
        extra = set(self._header.point_format.extra_dimension_names)
        if name == "intensity":
            finite = np.nan_to_num(column.astype(np.float64), nan=0.0, posinf=65535.0, neginf=0.0)
            record.intensity = np.clip(np.rint(finite), 0, 65535).astype(np.uint16)
            if _EXACT_INTENSITY in extra:
                record[_EXACT_INTENSITY] = column
        elif name in extra:
            record[name] = column
        elif name == "time":
            record.gps_time = column
        else:  # a colour: eight bits fill LAS's sixteen, as its standard wants
            record[name] = column.astype(np.uint16) * (257 if column.dtype == np.uint8 else 1)

    def _require_finite(self, cloud: Cloud) -> None:
        if not np.isfinite(cloud.points).all():
            raise InputError(
                self._shown,
                "LAS holds no points that are not finite",
                expected="finite coordinates",
                remedy="Drop them, or write PLY or PCD.",
            )
