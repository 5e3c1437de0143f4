"""ROS bags without ROS: ROS 1 .bag, ROS 2 sqlite3 and MCAP, by rosbags.

Messages are decoded by the definitions of ROS itself, never by those that a bag carries: the types read here are the
same in all releases, and text from a file is not turned into code. What a bag inflates is bounded (`Budget`).
"""

from __future__ import annotations

import bz2
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from lidarpose.errors import InputError
from lidarpose.storage.limits import file_size

SCAN_TYPES = ("sensor_msgs/msg/LaserScan", "sensor_msgs/msg/MultiEchoLaserScan")
CLOUD_TYPES = ("sensor_msgs/msg/PointCloud2",)
IMAGE_TYPES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_TYPES = ("sensor_msgs/msg/CameraInfo",)
JOINT_TYPES = ("sensor_msgs/msg/JointState",)
NUMBER_TYPES = tuple(
    f"std_msgs/msg/{name}"
    for name in ("Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32", "UInt64", "Float32", "Float64")
)
ANGLE_TYPES = (*JOINT_TYPES, *NUMBER_TYPES)

MAX_METADATA_BYTES = 1 << 20
_FREE_BYTES = 64 << 20
_MAX_RATIO = 100
_MAX_PIECE = 256 << 20


class Budget:
    """How many bytes a bag may inflate to: 64 MB and 100 times its size, no single piece above 256 MB.

    A recording of sensors shrinks to a tenth at most; images of nothing but black shrink more, hence the 64 MB.
    """

    def __init__(self, path: Path, size: int) -> None:
        self.path, self.left = path, _FREE_BYTES + _MAX_RATIO * size

    def limit(self) -> int:
        return min(self.left, _MAX_PIECE)

    def spend(self, count: int) -> None:
        self.left -= count

    def exceeded(self) -> InputError:
        return InputError(
            self.path,
            f"inflates to more than {_MAX_RATIO} times its size, or in one piece to more than {_MAX_PIECE >> 20} MB",
            expected="a recording of sensors",
            remedy="Store the bag without compression if it is what it should be.",
        )


_open_budgets: list[Budget] = []
"""Of the bags that are open; the last one counts. rosbags' decompressors are functions without a bag."""


@dataclass(frozen=True)
class Topic:
    """A topic of a bag; `message_count` as the bag's index states it."""

    name: str
    message_type: str
    message_count: int


class Bag:
    """An open bag. Use `open_bag`."""

    def __init__(self, path: Path, reader: Any, decode: Callable[[bytes, str], Any]) -> None:
        self.path, self._reader, self._decode = path, reader, decode
        self.topics: Mapping[str, Topic] = {}
        for connection in reader.connections:
            name, kind = str(connection.topic), str(connection.msgtype)
            before = self.topics.get(name)
            if before is not None and before.message_type != kind:
                raise InputError(path, f"has messages of {before.message_type} and {kind}", field=name)
            count = int(connection.msgcount) + (before.message_count if before else 0)
            self.topics = {**self.topics, name: Topic(name, kind, count)}

    def of_types(self, types: Iterable[str]) -> list[Topic]:
        """Topics with messages, of one of the types."""
        wanted = set(types)
        return [t for t in self.topics.values() if t.message_type in wanted and t.message_count > 0]

    def messages(self, names: Iterable[str]) -> Iterator[tuple[str, int, Any]]:
        """Topic, time of reception in ns, and decoded message, in the order of reception.

        Raises
        ------
        InputError
            If the bag is damaged.
        """
        wanted = set(names)
        connections = [c for c in self._reader.connections if str(c.topic) in wanted]
        if not connections:
            return
        with _as_input_errors(self.path):
            for connection, received, raw in self._reader.messages(connections=connections):
                yield str(connection.topic), int(received), self._decode(raw, connection.msgtype)


@contextmanager
def open_bag(path: Path) -> Iterator[Bag]:
    """Open a ROS 1 bag, a ROS 2 bag's folder, or one of its files (.db3, .mcap).

    Raises
    ------
    InputError
        If there is none, it is damaged, or it inflates beyond `Budget`.
    """
    path = Path(path)
    storage, size = _storage(path)
    _bound_decompression()
    budget = Budget(path, size)
    _open_budgets.append(budget)
    try:
        with _as_input_errors(path):
            reader, decode = _reader(storage)
            reader.open()
        try:
            with _as_input_errors(path):  # metadata.yaml may hold words where it should hold counts
                bag = Bag(path, reader, decode)
            yield bag
        finally:
            with _as_input_errors(path):
                reader.close()
    finally:
        _open_budgets.remove(budget)


def _storage(path: Path) -> tuple[Path, int]:
    """What to open, and its size in bytes."""
    if not path.is_dir():
        return path, file_size(path)
    metadata = path / "metadata.yaml"
    if metadata.exists():
        if file_size(metadata) > MAX_METADATA_BYTES:
            raise InputError(metadata, f"is larger than {MAX_METADATA_BYTES} bytes", expected="a bag's metadata")
        return path, sum(file_size(file) for file in path.iterdir() if file.is_file())
    files = [file for file in sorted(path.iterdir()) if file.suffix in (".db3", ".mcap", ".bag")]
    if len(files) != 1:
        found = ", ".join(file.name for file in files[:5]) or "none"
        raise InputError(
            path, f"has no metadata.yaml, and holds {found} of .bag, .db3, .mcap", expected="a ROS bag, or one bag file"
        )
    return files[0], file_size(files[0])


def _reader(storage: Path) -> tuple[Any, Callable[[bytes, str], Any]]:
    if storage.suffix == ".bag":
        from rosbags.rosbag1 import Reader as Reader1

        return Reader1(storage), _types("ROS1_NOETIC").deserialize_ros1
    if not storage.is_dir() and storage.suffix not in (".db3", ".mcap"):
        raise InputError(
            storage, "is no ROS bag", expected="a .bag, .db3, .mcap or .pcap file, or a ROS 2 bag's folder"
        )
    if any(mark in str(storage) for mark in "?#%"):
        raise InputError(storage, "has ?, # or % in its path, which the database takes for its own", expected="none")
    from rosbags.rosbag2 import Reader as Reader2

    return Reader2(storage), _types("ROS2_HUMBLE").deserialize_cdr


@cache
def _types(store: str) -> Any:
    from rosbags.typesys import Stores, get_typestore

    return get_typestore(Stores[store])


@contextmanager
def _as_input_errors(path: Path) -> Iterator[None]:
    try:
        yield
    except (InputError, GeneratorExit):
        raise
    except MemoryError as error:
        raise InputError(path, "promises more than fits into memory", expected="a whole ROS bag") from error
    except Exception as error:  # rosbags lets errors of every kind through on damaged bags
        problem = str(error).splitlines()[0][:200] if str(error) else type(error).__name__
        raise InputError(
            path,
            f"cannot be read as a ROS bag: {problem}",
            expected="a whole ROS 1 bag, or a ROS 2 bag of sqlite3 or MCAP",
            remedy="An unfinished bag can be mended by `rosbag reindex` or `ros2 bag reindex`.",
        ) from error


@cache
def _bound_decompression() -> None:
    """Put bounded decompressors into rosbags' tables: its own inflate whatever a file of some kB asks for."""
    from rosbags.rosbag1 import reader as reader1
    from rosbags.rosbag2 import reader as reader2
    from rosbags.rosbag2 import storage_mcap

    zstd: Any = vars(storage_mcap)["zstd"]

    def inflate_zstd(data: bytes, _: int = 0) -> bytes:
        return _bounded(zstd.ZstdDecompressor(), data)

    def inflate_lz4(data: bytes, _: int = 0) -> bytes:
        from lz4.frame import LZ4FrameDecompressor

        return _bounded(LZ4FrameDecompressor(), data)

    def inflate_bz2(data: bytes) -> bytes:
        return _bounded(bz2.BZ2Decompressor(), data)

    vars(storage_mcap)["DECOMPRESSORS"].update({"zstd": inflate_zstd, "lz4": inflate_lz4})
    vars(reader1)["decompressors"].update({"lz4": inflate_lz4, "bz2": inflate_bz2})
    vars(reader2)["zstd"] = SimpleNamespace(decompress=inflate_zstd, open=_BoundedFile.opener(zstd.open))


def _bounded(decompressor: Any, data: bytes) -> bytes:
    budget = _open_budgets[-1]
    limit = budget.limit()
    out: bytes = decompressor.decompress(data, max_length=limit + 1)
    if len(out) > limit:
        raise budget.exceeded()
    budget.spend(len(out))
    return out


class _BoundedFile:
    """A decompressing file whose reads count."""

    def __init__(self, file: Any) -> None:
        self._file = file

    @staticmethod
    def opener(function: Callable[..., Any]) -> Callable[..., Any]:
        return lambda *arguments: _BoundedFile(function(*arguments))

    def __enter__(self) -> _BoundedFile:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self, size: int = -1) -> bytes:
        budget = _open_budgets[-1]
        data: bytes = self._file.read(size if size >= 0 else budget.left + 1)
        budget.spend(len(data))
        if budget.left < 0:
            raise budget.exceeded()
        return data
