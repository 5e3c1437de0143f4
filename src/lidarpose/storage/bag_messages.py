"""ROS messages as this package's nouns, checked: scans, readings of angles, images, cameras, clouds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.camera import COEFFICIENT_COUNTS, Camera
from lidarpose.model.cloud import Cloud
from lidarpose.model.image import GrayImage
from lidarpose.storage.clouds.columns import cloud_of_rows
from lidarpose.storage.clouds.pcd import unpack_colours
from lidarpose.storage.images import decode_image

_MAX_BEAMS = 1 << 20
_MAX_PIXELS = 1 << 28
# Two turns: more are degrees.
_MAX_SPAN_RAD = 4.0 * math.pi
_POINT_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
_GREY = {"mono8": "u1", "8UC1": "u1", "mono16": "u2", "16UC1": "u2"}
_COLOUR = {"rgb8": (0, 3), "bgr8": (2, 3), "8UC3": (2, 3), "rgba8": (0, 4), "bgra8": (2, 4), "8UC4": (2, 4)}
_LUMA = (0.299, 0.587, 0.114)


@dataclass(frozen=True, eq=False)
class ScanMessage:
    """One sweep as a LaserScan tells it; ranges that the sensor marks as invalid are NaN.

    Attributes
    ----------
    received_ns, stamp_ns
        By the recorder's clock, and by the sensor's (None where the stamp is 0).
    angle_max
        Where beams end by the message; they are taken in steps of `angle_increment` from `angle_min`.
    beam_dt_s
        Seconds from beam to beam; None where the message does not say.
    """

    received_ns: int
    stamp_ns: int | None
    angle_min: float
    angle_max: float
    angle_increment: float
    beam_dt_s: float | None
    ranges: NDArray[np.float32]
    intensities: NDArray[np.float32] | None

    @property
    def geometry(self) -> tuple[float, float, int]:
        """What two scans must share to have the same beams."""
        return self.angle_min, self.angle_increment, len(self.ranges)

    @property
    def contradicts_itself(self) -> bool:
        """Whether the beams end by more than one step elsewhere than the message says, whole turns aside."""
        beyond = self.angle_max - self.angle_min - self.angle_increment * (len(self.ranges) - 1)
        return abs(math.remainder(beyond, 2.0 * math.pi)) > 1.5 * abs(self.angle_increment)

    def beam_angle_rad(self) -> FloatArray:
        """(N,)"""
        return np.asarray(self.angle_min + self.angle_increment * np.arange(len(self.ranges)))


def stamp_ns(message: Any) -> int | None:
    """A header's stamp in ns; None where it was left 0 or there is no header."""
    header = getattr(message, "header", None)
    if header is None:
        return None
    total = int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)
    return total if total > 0 else None


def scan_message(bag: Path, topic: str, received_ns: int, message: Any) -> ScanMessage:
    """A LaserScan, or of a MultiEchoLaserScan the strongest return of each beam (without intensities the first)."""
    low, high = float(message.range_min), float(message.range_max)
    if hasattr(message.ranges, "dtype"):
        ranges = np.array(message.ranges, dtype=np.float32)
        intensities = np.array(message.intensities, dtype=np.float32)
        ranges[_invalid(ranges, low, high)] = np.nan
    else:
        ranges, intensities = _strongest_echoes(message, low, high)
    angle_min, angle_max = float(message.angle_min), float(message.angle_max)
    increment = float(message.angle_increment)
    if len(ranges) == 0:  # drivers send these while the LiDAR starts, with steps of infinity
        angle_min = angle_max = increment = 0.0
    if not np.isfinite(angle_max):
        angle_max = angle_min + increment * (len(ranges) - 1)
    span = abs(increment) * (len(ranges) - 1)
    if len(ranges) > _MAX_BEAMS or not np.isfinite([angle_min, increment]).all() or (len(ranges) > 1 and not increment):
        problem = f"has a scan of {len(ranges)} beams from {angle_min} rad in steps of {increment} rad"
        raise InputError(bag, problem, field=topic, expected="beam angles that grow or fall")
    if span > _MAX_SPAN_RAD:
        problem = f"has a scan of {len(ranges)} beams over {span:g} rad"
        raise InputError(bag, problem, field=topic, expected="angles in radians", remedy="Let the driver convert them.")
    kept = intensities if len(intensities) == len(ranges) and len(ranges) else None
    dt = _beam_dt(message, beam_share(increment, len(ranges)))
    return ScanMessage(received_ns, stamp_ns(message), angle_min, angle_max, increment, dt, ranges, kept)


def _invalid(ranges: NDArray[np.float32], low: float, high: float) -> BoolArray:
    """Those that are no return, or out of the range that the sensor states."""
    invalid = ~np.isfinite(ranges) | (ranges <= 0.0)
    if 0.0 <= low < high:
        invalid |= (ranges < low) | (ranges > high)
    return invalid


def beam_share(increment: float, beams: int) -> float:
    """Of the time of a scan, from beam to beam: the mirror turns once, also while it looks where no beams are."""
    return min(abs(increment) / (2.0 * math.pi), 1.0 / max(beams, 1))


def _beam_dt(message: Any, share: float) -> float | None:
    """From the time between beams, or from the scan's where that is left 0, as some drivers do."""
    step, whole = float(message.time_increment), float(message.scan_time)
    if np.isfinite(step) and step > 0.0:
        return step
    return whole * share if np.isfinite(whole) and whole > 0.0 and share else None


def _strongest_echoes(message: Any, low: float, high: float) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Of each beam the strongest echo that is a return."""
    echoes = [np.asarray(echo.echoes, dtype=np.float32) for echo in message.ranges]
    strengths = [np.asarray(echo.echoes, dtype=np.float32) for echo in message.intensities]
    ranges = np.full(len(echoes), np.nan, dtype=np.float32)
    known = len(strengths) == len(echoes) and all(len(a) == len(b) for a, b in zip(echoes, strengths, strict=True))
    intensities = np.full(len(echoes) if known else 0, np.nan, dtype=np.float32)
    for k, values in enumerate(echoes):
        seen = np.flatnonzero(~_invalid(values, low, high))
        if len(seen) == 0:
            continue
        best = int(seen[np.argmax(np.nan_to_num(strengths[k][seen], nan=-np.inf))]) if known else int(seen[0])
        ranges[k] = values[best]
        if known:
            intensities[k] = strengths[k][best]
    return ranges, intensities


def joint_position(bag: Path, topic: str, message: Any, joint: str | None) -> float | None:
    """The position of the named joint, or of the only one; None where the message has nothing of it."""
    names, positions = list(message.name), np.asarray(message.position, dtype=np.float64)
    if joint is None:
        if len(positions) > 1:
            listed = ", ".join(names)
            raise InputError(bag, f"has several joints: {listed}", field=topic, expected="--joint NAME, one of these")
        return float(positions[0]) if len(positions) else None
    if joint not in names:
        return None
    index = names.index(joint)
    return float(positions[index]) if index < len(positions) else None


def grey_image(bag: Path, topic: str, message: Any) -> GrayImage:
    """An Image or CompressedImage as grey, 8 or 16 bit."""
    if hasattr(message, "format"):
        return decode_image(bag, bytes(np.asarray(message.data, dtype=np.uint8)), where=topic)
    height, width, step = int(message.height), int(message.width), int(message.step)
    data = np.asarray(message.data, dtype=np.uint8)
    encoding = str(message.encoding)
    item = _GREY.get(encoding)
    row = width * (np.dtype(item).itemsize if item else _COLOUR.get(encoding, (0, 1))[1])
    if not 0 < height * width <= _MAX_PIXELS or step < row or len(data) != step * height:
        problem = f"has an image of {width} x {height} in {len(data)} bytes, {step} a row"
        raise InputError(bag, problem, field=topic, expected=f"rows of at least {row} bytes for {encoding}")
    pixels = data.reshape(height, step)[:, :row]
    if item is not None:
        order = ">" if message.is_bigendian else "<"
        grey = np.ascontiguousarray(pixels).view(order + item)
        return np.asarray(grey, np.uint8) if item == "u1" else np.asarray(grey, np.uint16)
    if encoding not in _COLOUR:
        known = ", ".join([*_GREY, *_COLOUR])
        raise InputError(bag, f"has images of encoding {encoding[:40]!r}", field=topic, expected=known)
    first, channels = _COLOUR[encoding]
    planes = pixels.reshape(height, width, channels)
    mixed = sum(weight * planes[..., abs(first - k)].astype(np.float32) for k, weight in enumerate(_LUMA))
    return np.asarray(np.rint(mixed), np.uint8)


def camera_of(bag: Path, topic: str, message: Any) -> Camera:
    """A CameraInfo as a camera. ROS 1 writes K and D, ROS 2 k and d."""
    K = np.asarray(message.k if hasattr(message, "k") else message.K, dtype=np.float64).reshape(-1)
    D = np.asarray(message.d if hasattr(message, "d") else message.D, dtype=np.float64).reshape(-1)
    model = str(message.distortion_model) or "plumb_bob"
    if model == "fisheye":
        model = "equidistant"
    if model not in COEFFICIENT_COUNTS or K.size != 9:
        expected = " or ".join(COEFFICIENT_COUNTS)
        raise InputError(bag, f"has the distortion model {model[:40]!r}", field=topic, expected=expected)
    try:
        return Camera(int(message.width), int(message.height), K.reshape(3, 3), model, D)
    except ValueError as error:
        remedy = "The camera was not calibrated; give its file by --camera."
        raise InputError(bag, str(error), field=topic, remedy=remedy) from error


def point_cloud(bag: Path, topic: str, message: Any) -> Cloud:
    """A PointCloud2 with all its fields; points without return (NaN) are kept."""
    step, count = int(message.point_step), int(message.height) * int(message.width)
    data = np.asarray(message.data, dtype=np.uint8)
    row_step = int(message.row_step)
    if step < 1 or row_step < step * int(message.width) or len(data) != row_step * int(message.height):
        problem = f"has a cloud of {message.width} x {message.height} points of {step} bytes in {len(data)} bytes"
        raise InputError(bag, problem, field=topic, expected="row_step times height bytes")
    names, formats, offsets = [], [], []
    order = ">" if message.is_bigendian else "<"
    for item in message.fields:
        code = _POINT_TYPES.get(int(item.datatype))
        number = max(1, int(item.count))
        if code is None or int(item.offset) + np.dtype(code).itemsize * number > step or item.name in names:
            problem = f"has the field {str(item.name)[:40]!r} of type {item.datatype} at byte {item.offset} of {step}"
            raise InputError(bag, problem, field=topic, expected="fields of known types, each once, inside the point")
        names.append(str(item.name))
        formats.append((order + code, (number,) if number > 1 else ()))
        offsets.append(int(item.offset))
    row = np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": step})
    packed = data.reshape(int(message.height), row_step)[:, : step * int(message.width)] if count else data[:0]
    rows = np.ascontiguousarray(packed).reshape(-1).view(row)
    return unpack_colours(cloud_of_rows(rows, bag))
