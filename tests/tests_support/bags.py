"""Bags that tests write: the same messages as ROS 1, ROS 2 sqlite3 or MCAP."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from lz4.frame import compress as lz4_compress
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_typestore

KINDS = (
    *("ros1", "ros1-lz4", "ros1-bz2"),
    *("sqlite3", "sqlite3-zstd-message", "sqlite3-zstd-file"),
    *("mcap", "mcap-zstd", "mcap-lz4"),
)

_STORES = {True: get_typestore(Stores.ROS1_NOETIC), False: get_typestore(Stores.ROS2_HUMBLE)}


class Messages:
    """Makes messages of one ROS version."""

    def __init__(self, ros1: bool) -> None:
        self.ros1, self.store = ros1, _STORES[ros1]
        self.types = self.store.types

    def make(self, kind: str, /, **values: Any) -> Any:
        cls = self.types[kind]
        if self.ros1 and kind == "std_msgs/msg/Header":
            values = {"seq": 0, **values}
        if self.ros1 and kind == "sensor_msgs/msg/CameraInfo":
            values = {name.upper() if name in ("k", "d", "r", "p") else name: v for name, v in values.items()}
        return cls(**values)

    def header(self, time_s: float | None) -> Any:
        ns = 0 if time_s is None else round(time_s * 1e9)
        stamp = self.make("builtin_interfaces/msg/Time", sec=ns // 10**9, nanosec=ns % 10**9)
        return self.make("std_msgs/msg/Header", stamp=stamp, frame_id="laser")

    def scan(self, stamp: float | None, ranges: np.ndarray, **more: Any) -> Any:
        n = len(ranges)
        values = {
            "angle_min": -1.0,
            "angle_max": -1.0 + 0.01 * (n - 1),
            "angle_increment": 0.01,
            "time_increment": 1e-4,
            "scan_time": 0.1,
            "range_min": 0.1,
            "range_max": 30.0,
            "ranges": np.asarray(ranges, dtype=np.float32),
            "intensities": np.asarray(ranges, dtype=np.float32) * 10.0,
        }
        return self.make("sensor_msgs/msg/LaserScan", header=self.header(stamp), **{**values, **more})

    def multi_echo(self, stamp: float, echoes: list[list[float]], strengths: list[list[float]]) -> Any:
        def pack(lists: list[list[float]]) -> list[Any]:
            return [self.make("sensor_msgs/msg/LaserEcho", echoes=np.array(x, dtype=np.float32)) for x in lists]

        plain = self.scan(stamp, np.ones(len(echoes)))
        names = ("angle_min", "angle_max", "angle_increment", "time_increment", "scan_time", "range_min", "range_max")
        values = {name: getattr(plain, name) for name in names}
        return self.make(
            "sensor_msgs/msg/MultiEchoLaserScan",
            header=plain.header,
            ranges=pack(echoes),
            intensities=pack(strengths),
            **values,
        )

    def joint(self, stamp: float | None, *positions: float, names: Iterable[str] = ("turntable_joint",)) -> Any:
        empty = np.zeros(0)
        return self.make(
            "sensor_msgs/msg/JointState",
            header=self.header(stamp),
            name=list(names),
            position=np.array(positions),
            velocity=empty,
            effort=empty,
        )

    def number(self, kind: str, value: float) -> Any:
        return self.make(f"std_msgs/msg/{kind}", data=value)

    def image(self, stamp: float | None, pixels: np.ndarray, encoding: str) -> Any:
        height, width = pixels.shape[:2]
        data = np.ascontiguousarray(pixels).view(np.uint8).ravel()
        return self.make(
            "sensor_msgs/msg/Image",
            header=self.header(stamp),
            height=height,
            width=width,
            encoding=encoding,
            is_bigendian=0,
            step=len(data) // height,
            data=data,
        )

    def compressed(self, stamp: float | None, data: bytes) -> Any:
        return self.make(
            "sensor_msgs/msg/CompressedImage",
            header=self.header(stamp),
            format="png",
            data=np.frombuffer(data, dtype=np.uint8),
        )

    def camera(self, width: int, height: int, K: np.ndarray, D: np.ndarray, model: str = "plumb_bob") -> Any:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", x_offset=0, y_offset=0, height=0, width=0, do_rectify=False)
        return self.make(
            "sensor_msgs/msg/CameraInfo",
            header=self.header(None),
            height=height,
            width=width,
            distortion_model=model,
            d=np.asarray(D, dtype=np.float64),
            k=np.asarray(K, dtype=np.float64).ravel(),
            r=np.eye(3).ravel(),
            p=np.zeros(12),
            binning_x=0,
            binning_y=0,
            roi=roi,
        )

    def cloud(self, stamp: float | None, rows: np.ndarray, **more: Any) -> Any:
        codes = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}
        row = rows.dtype
        assert row.fields is not None
        assert row.names is not None
        fields = [
            self.make(
                "sensor_msgs/msg/PointField",
                name=name,
                offset=int(row.fields[name][1]),
                datatype=codes[row[name].str[1:]],
                count=1,
            )
            for name in row.names
        ]
        values = {
            "height": 1,
            "width": len(rows),
            "fields": fields,
            "is_bigendian": False,
            "point_step": rows.dtype.itemsize,
            "row_step": rows.nbytes,
            "data": np.frombuffer(rows.tobytes(), dtype=np.uint8),
            "is_dense": False,
        }
        return self.make("sensor_msgs/msg/PointCloud2", header=self.header(stamp), **{**values, **more})


def messages(kind: str) -> Messages:
    return Messages(kind.startswith("ros1"))


def write_bag(folder: Path, kind: str, entries: Iterable[tuple[str, float, Any]]) -> Path:
    """Write entries of topic, time of reception, message; returns the bag's path."""
    ordered = sorted(entries, key=lambda entry: entry[1])
    if kind.startswith("ros1"):
        path = folder / "bag.bag"
        writer1 = Writer1(path)
        if "-" in kind:
            writer1.set_compression(Writer1.CompressionFormat[kind.split("-")[1].upper()])
        with writer1:
            _fill(writer1, _STORES[True], ordered, lambda message, name: _STORES[True].serialize_ros1(message, name))
        return path
    path = folder / "bag"
    plugin = StoragePlugin.MCAP if kind.startswith("mcap") else StoragePlugin.SQLITE3
    writer2 = Writer2(path, version=9, storage_plugin=plugin)
    if "zstd" in kind:
        mode = {"mcap-zstd": "STORAGE", "sqlite3-zstd-message": "MESSAGE", "sqlite3-zstd-file": "FILE"}[kind]
        writer2.set_compression(CompressionMode[mode], CompressionFormat.ZSTD)
    with writer2:
        if kind == "mcap-lz4":
            # rosbags reads such chunks and does not write them; its writer takes any compressor.
            storage: Any = writer2.storage
            storage.compression, storage.compressor = "lz4", lz4_compress
        _fill(writer2, _STORES[False], ordered, lambda message, name: _STORES[False].serialize_cdr(message, name))
    return path


def _fill(writer: Any, store: Any, entries: list[tuple[str, float, Any]], serialize: Any) -> None:
    connections: dict[str, Any] = {}
    for topic, received, message in entries:
        name = message.__msgtype__
        if topic not in connections:
            connections[topic] = writer.add_connection(topic, name, typestore=store)
        writer.write(connections[topic], round(received * 1e9), serialize(message, name))
