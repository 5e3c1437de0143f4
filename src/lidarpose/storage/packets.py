"""Velodyne packets in a pcap file, by velodyne-decoder (the extra ``packets``)."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.cloud import Cloud
from lidarpose.storage.bag_import import ImportReport
from lidarpose.storage.cloud_import import PlaceOptions, add_place
from lidarpose.storage.limits import file_size

_MAGICS = {b"\xd4\xc3\xb2\xa1", b"\xa1\xb2\xc3\xd4", b"\x4d\x3c\xb2\xa1", b"\xa1\xb2\x3c\x4d"}
_FIELDS = ("intensity", "time", "column", "ring", "return_type")


def read_packets(path: Path) -> Iterator[Cloud]:
    """Clouds of a Velodyne's turns, in the sensor's frame, metres; `time` in seconds of each point, `ring` its laser.

    Raises
    ------
    InputError
        If the extra is not installed, the file is no pcap, is cut off, or has no Velodyne packets.
    """
    _check_records(path)
    try:
        import velodyne_decoder
    except ImportError as error:
        raise InputError(
            path, "needs velodyne-decoder", expected="the extra packets", remedy="pip install 'lidarpose[packets]'"
        ) from error
    found = 0
    try:
        for stamp, points in velodyne_decoder.read_pcap(str(path), as_pcl_structs=True):
            found += 1
            yield _cloud(stamp, points)
    except Exception as error:  # the decoder raises RuntimeError and ValueError on packets that it does not know
        problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(path, f"cannot be decoded: {problem}", expected="Velodyne packets") from error
    if not found:
        raise InputError(path, "has no whole turn of a Velodyne", expected="Velodyne packets, UDP port 2368")


def import_packets(path: Path, out: Path, place: PlaceOptions) -> ImportReport:
    """Add the turns as one place to a corner session."""
    return ImportReport("corner", *add_place(out, read_packets(path), place, path))


def _cloud(stamp: Any, points: Any) -> Cloud:
    names = points.dtype.names
    xyz = np.column_stack([points[axis] for axis in "xyz"]).astype(np.float32)
    fields = {name: np.ascontiguousarray(points[name]) for name in _FIELDS if name in names}
    if "time" in fields:
        first = getattr(stamp, "host", stamp)
        fields["time"] = float(first) + fields["time"].astype(np.float64)
    return Cloud(xyz, fields, "lidar")


def _check_records(path: Path) -> None:
    """Walk the pcap's records: every one is there as a whole."""
    size = file_size(path)
    with path.open("rb") as file:
        head = file.read(24)
        if len(head) < 24 or head[:4] not in _MAGICS:
            raise InputError(
                path, "does not start as a pcap file", expected="a pcap file (pcapng: `editcap -F pcap` converts it)"
            )
        order = "<" if head[:4] in (b"\xd4\xc3\xb2\xa1", b"\x4d\x3c\xb2\xa1") else ">"
        position = 24
        while position < size:
            record = file.read(16)
            length = struct.unpack(order + "I", record[8:12])[0] if len(record) == 16 else size
            position += 16 + length
            if position > size:
                raise InputError(
                    path, f"ends inside the record at byte {position - 16 - length}", expected="whole records"
                )
            file.seek(length, 1)
