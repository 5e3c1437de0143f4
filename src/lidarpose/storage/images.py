"""Grey images from files, decoded only when asked for, and never larger than what the camera can have taken."""

from __future__ import annotations

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.image import GrayImage

MAX_IMAGE_BYTES = 512 * 2**20
MAX_PIXELS = 2**26
_PNG = b"\x89PNG\r\n\x1a\n"


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
        data = _read_bytes(self.path)
        size = png_size(self.path, data) if data.startswith(_PNG) else other_size(data)
        if size is not None:
            self._check_size(*size)
        image = _decode(self.path, data)
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
    size = png_size(path, data) if data.startswith(_PNG) else other_size(data)
    if size is None or not 0 < size[0] * size[1] <= MAX_PIXELS:
        found = "is of no known kind" if size is None else f"has {size[0]} x {size[1]} pixels"
        raise InputError(path, f"an image {found}", field=where, expected="PNG, JPEG or BMP of at most 2^26 pixels")
    return _decode(path, data)


def _read_bytes(path: Path) -> bytes:
    try:
        if path.stat().st_size > MAX_IMAGE_BYTES:
            raise InputError(path, f"is larger than {MAX_IMAGE_BYTES // 2**20} MB", expected="an image")
        return path.read_bytes()
    except OSError as error:
        raise InputError(path, f"cannot be read: {error.strerror or error}", expected="an image") from error


def _decode(path: Path, data: bytes) -> GrayImage:
    grey = _fast_png(data)
    if grey is not None:
        return grey
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


def _fast_png(data: bytes) -> GrayImage | None:
    """A PNG of 8 bit grey in half of OpenCV's time, by a library of the `fast` extra; None for all else.

    What is wrong with a file is left to OpenCV to find, so that it is the same with and without the extra.
    """
    # Bit depth 8, grey, not interlaced: bytes 24, 25 and 28 of the header.
    if not data.startswith(_PNG) or len(data) < 29 or data[24:26] != b"\x08\x00" or data[28] != 0:
        return None
    try:
        from kornia_rs.io import decode_image_png_u8
    except ImportError:
        return None
    width, height = struct.unpack_from(">II", data, len(_PNG) + 8)
    try:
        return np.asarray(decode_image_png_u8(data, (height, width), "mono"), np.uint8)[..., 0]
    except Exception:
        return None


def png_size(path: Path, data: bytes) -> tuple[int, int]:
    """Width and height of a PNG, after a look whether its chunks are all there."""
    offset = len(_PNG)
    while offset + 12 <= len(data):
        length, kind = struct.unpack_from(">I4s", data, offset)
        offset += 12 + length
        if kind == b"IEND" and offset <= len(data):
            width, height = struct.unpack_from(">II", data, len(_PNG) + 8)
            return int(width), int(height)
    raise InputError(path, "is cut off", expected="a whole PNG image", remedy="Copy or record it again.")


def other_size(data: bytes) -> tuple[int, int] | None:
    """Width and height from the header of a BMP or JPEG, before anything is decoded; None for other formats."""
    if data[:2] == b"BM" and len(data) >= 26:
        width, height = struct.unpack_from("<ii", data, 18)
        return abs(width), abs(height)
    if data[:2] == b"\xff\xd8":
        return _jpeg_size(data)
    return None


def _jpeg_size(data: bytes) -> tuple[int, int] | None:
    offset = 2
    while offset + 9 <= len(data) and data[offset] == 0xFF:
        marker = data[offset + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack_from(">HH", data, offset + 5)
            return int(width), int(height)
        offset += 2 + int(struct.unpack_from(">H", data, offset + 2)[0])
    return None
