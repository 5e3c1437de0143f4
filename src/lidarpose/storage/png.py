"""What a PNG says of itself, and a decoder twice as fast as OpenCV's for the plainest and most common kind.

The fast one is kornia-rs (extra `fast`). It holds the interpreter's lock, so that it pays only where no other thread
wants to work; and it is asked only for 8-bit grey images without anything that could change their values. Whatever it
does not decode is left to OpenCV, which also has the last word on what is broken. It checks the chunks' CRC-32, which
tells damage to a file, but not the Adler-32 of the data inside them: only a faulty writer gets that one wrong alone.
"""

from __future__ import annotations

import struct
import threading
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from lidarpose.errors import InputError

SIGNATURE = b"\x89PNG\r\n\x1a\n"
# Header, image data, and what no decoder looks at: resolution, text and time.
_WITHOUT_EFFECT = frozenset((b"IHDR", b"IDAT", b"IEND", b"pHYs", b"tEXt", b"zTXt", b"iTXt", b"tIME"))
# Depth 8, grey, and the only methods of compression and filtering that there are, not interlaced.
_PLAIN_GREY = bytes((8, 0, 0, 0, 0))


@dataclass(frozen=True)
class PngHeader:
    """Size in pixels, and whether the values are 8-bit grey levels just as they are stored."""

    width: int
    height: int
    is_plain_grey: bool


def png_header(path: Path, data: bytes) -> PngHeader:
    """The header of a PNG's bytes, after a look whether its chunks are all there (InputError if not)."""
    offset = len(SIGNATURE)
    kinds = set()
    chunk, end = struct.Struct(">I4s").unpack_from, len(data) - 12
    while offset <= end:
        length, kind = chunk(data, offset)
        offset += 12 + length
        if kind == b"IDAT":  # nearly all of them
            continue
        kinds.add(kind)
        if kind == b"IEND" and offset <= len(data):
            first = len(SIGNATURE) + 8
            width, height = struct.unpack_from(">II", data, first)
            plain = data[first - 4 : first] == b"IHDR" and data[first + 8 : first + 13] == _PLAIN_GREY
            return PngHeader(int(width), int(height), plain and kinds <= _WITHOUT_EFFECT)
    raise InputError(path, "is cut off", expected="a whole PNG image", remedy="Copy or record it again.")


def decode_fast(data: bytes, header: PngHeader) -> NDArray[np.uint8] | None:
    """The image (height, width) as OpenCV decodes it, or None where that is not certain, not possible or not faster."""
    if not header.is_plain_grey or threading.active_count() > 1 or not _is_installed():
        return None
    from kornia_rs import io

    shape = (header.height, header.width)
    try:
        found = io.decode_image_png_u8(data, shape, "mono")
    except (KeyboardInterrupt, SystemExit):
        raise
    except BaseException:  # a panic in Rust is no Exception
        return None
    image = np.asarray(found)
    return image[..., 0] if image.shape == (*shape, 1) and image.dtype == np.uint8 else None


@cache
def _is_installed() -> bool:
    return find_spec("kornia_rs") is not None
