"""Grey images from files, decoded only when asked for, and never larger than what the camera can have taken."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.image import GrayImage
from lidarpose.storage.limits import file_size
from lidarpose.storage.png import SIGNATURE, PngHeader, decode_fast, png_header

MAX_PIXELS = 2**27


@dataclass(frozen=True)
class FileImage:
    """One image file of a session.

    Attributes
    ----------
    path
        Where it is.
    name
        What the session's files call it.
    width, height
        What the camera takes; another size is an error.
    """

    path: Path
    name: str
    width: int
    height: int

    def load(self) -> GrayImage:
        """Decode to grey, 8 or 16 bit, raw (not rectified).

        Raises
        ------
        InputError
            If the file is missing, cut off, no image, or of another size than the camera's.
        """
        # Raw 16-bit colour with transparency takes eight bytes a pixel; nothing of the camera's takes more.
        data = _read_bytes(self.path, 9 * self.width * self.height + 2**20)
        header = png_header(self.path, data) if data.startswith(SIGNATURE) else None
        size = other_size(data) if header is None else (header.width, header.height)
        if size is None:
            raise InputError(self.path, "is of no known kind", expected="a PNG, BMP, TIFF or JPEG image")
        self._check_size(*size)
        if size[0] * size[1] > MAX_PIXELS:
            raise InputError(self.path, f"has {size[0]} x {size[1]} pixels", expected=f"at most {MAX_PIXELS} in all")
        image = _decode(self.path, data, header)
        self._check_size(image.shape[1], image.shape[0])
        return image

    def _check_size(self, width: int, height: int) -> None:
        if (width, height) != (self.width, self.height):
            raise InputError(
                self.path,
                f"is {width} x {height} pixels",
                expected=f"{self.width} x {self.height}, the size in the camera's file",
                remedy="Use raw images of the calibrated camera, neither scaled nor cropped.",
            )


def decode_image(path: Path, data: bytes, *, where: str | None = None) -> GrayImage:
    """Decode the bytes of an image file that stands inside another one, such as a bag.

    Raises
    ------
    InputError
        If the bytes are no whole image, of a kind whose size is not known beforehand, or of too many pixels.
    """
    header = png_header(path, data) if data.startswith(SIGNATURE) else None
    size = other_size(data) if header is None else (header.width, header.height)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        found = "is of no known kind" if size is None else f"has {size[0]} x {size[1]} pixels"
        raise InputError(
            path, f"an image {found}", field=where, expected=f"PNG, JPEG, TIFF or BMP of at most {MAX_PIXELS} pixels"
        )
    return _decode(path, data, header)


def _read_bytes(path: Path, limit: int) -> bytes:
    size = file_size(path)
    if size > limit:
        raise InputError(path, f"is {size / 2**20:.1f} MB large", expected="an image of the camera's size")
    try:
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", expected="an image") from error


def _decode(path: Path, data: bytes, header: PngHeader | None) -> GrayImage:
    plain = None if header is None else decode_fast(data, header)
    if plain is not None:
        return plain
    import cv2

    image = None
    if data:
        try:
            image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH)
        except cv2.error:
            image = None
    if image is None or image.dtype not in (np.uint8, np.uint16):
        raise InputError(
            path, "cannot be decoded", expected="a PNG, BMP, TIFF or JPEG image of 8 or 16 bit", remedy="Copy it again."
        )
    return np.asarray(image, np.uint8) if image.dtype == np.uint8 else np.asarray(image, np.uint16)


def other_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the header of a BMP, JPEG or TIFF, before anything is decoded; None for other formats."""
    if data[:2] == b"BM" and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    if data[:4] in (b"II*\0", b"MM\0*") and len(data) >= 8:
        return _tiff_size(data, "<" if data[:2] == b"II" else ">")
    return None


def _tiff_size(data: bytes, order: str) -> tuple[int, int] | None:
    """Width and height from a TIFF's first directory; None if they are not there as numbers."""
    start = int(struct.unpack_from(f"{order}I", data, 4)[0])
    found: dict[int, int] = {}
    if start + 2 <= len(data):
        count = int(struct.unpack_from(f"{order}H", data, start)[0])
        for at in range(start + 2, min(start + 2 + 12 * count, len(data) - 11), 12):
            tag, kind = struct.unpack_from(f"{order}HH", data, at)
            if tag in (256, 257) and kind in (3, 4):
                found.setdefault(tag, int(struct.unpack_from(order + ("H" if kind == 3 else "I"), data, at + 8)[0]))
    return (found[256], found[257]) if len(found) == 2 else None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, offset + 5)
            return int(width), int(height)
        offset += 2 + int(struct.unpack_from(">H", data, offset + 2)[0])
    return None
