"""The fast decoder gives what OpenCV gives, and keeps its hands off everything else."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage import images, png
from lidarpose.storage.images import decode_image
from lidarpose.storage.png import decode_fast, png_header

GREY = np.random.default_rng(0).integers(0, 256, (37, 53), dtype=np.uint8)
FILTERS = [
    cv2.IMWRITE_PNG_FILTER_NONE,
    cv2.IMWRITE_PNG_FILTER_SUB,
    cv2.IMWRITE_PNG_FILTER_UP,
    cv2.IMWRITE_PNG_FILTER_AVG,
    cv2.IMWRITE_PNG_FILTER_PAETH,
    cv2.IMWRITE_PNG_ALL_FILTERS,
]


@pytest.fixture(autouse=True)
def alone(monkeypatch: pytest.MonkeyPatch) -> None:
    """As in a process without threads; those that run tests in parallel have some."""
    pytest.importorskip("kornia_rs", reason="the fast decoder is not installed")
    monkeypatch.setattr("lidarpose.storage.png.threading.active_count", lambda: 1)


def chunk(kind: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))


def made_png(*, colour: int = 0, interlaced: int = 0, before: bytes = b"", raw: bytes | None = None) -> bytes:
    """A PNG of GREY put together by hand."""
    height, width = GREY.shape
    header = struct.pack(">IIBBBBB", width, height, 8, colour, 0, 0, interlaced)
    raw = b"".join(b"\0" + row.tobytes() for row in GREY) if raw is None else raw
    body = chunk(b"IHDR", header) + before + chunk(b"IDAT", zlib.compress(raw)) + chunk(b"IEND", b"")
    return png.SIGNATURE + body


def fast(data: bytes) -> np.ndarray | None:
    return decode_fast(data, png_header(Path("a.png"), data))


@pytest.mark.parametrize("filters", FILTERS)
@pytest.mark.parametrize("shape", [(37, 53), (1, 1), (1, 300), (300, 1), (128, 256)])
def test_grey_images_are_decoded_to_the_bit(filters: int, shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).normal(scale=3.0, size=shape)
    smooth = np.add.outer(np.linspace(20, 90, shape[0]), np.linspace(0, 140, shape[1]))
    for image in (np.clip(smooth + noise, 0, 255).astype(np.uint8), np.zeros(shape, np.uint8)):
        data = bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_FILTER, filters])[1])
        found = fast(data)
        assert found is not None
        assert found.dtype == np.uint8
        np.testing.assert_array_equal(found, image)


def test_a_comment_does_not_matter() -> None:
    np.testing.assert_array_equal(fast(made_png(before=chunk(b"tEXt", b"Comment\0bright"))), GREY)


@pytest.mark.parametrize(
    "data",
    [
        bytes(cv2.imencode(".png", GREY.astype(np.uint16) * 257)[1]),
        bytes(cv2.imencode(".png", np.dstack([GREY] * 3))[1]),
        bytes(cv2.imencode(".png", (GREY > 99).astype(np.uint8) * 255, [cv2.IMWRITE_PNG_BILEVEL, 1])[1]),
        made_png(before=chunk(b"tRNS", b"\0\7")),
        made_png(before=chunk(b"gAMA", struct.pack(">I", 45455))),
        made_png(interlaced=1),
    ],
    ids=["16 bit", "colour", "1 bit", "transparent", "gamma", "interlaced"],
)
def test_every_other_kind_is_left_to_opencv(data: bytes) -> None:
    assert fast(data) is None


@pytest.mark.parametrize(
    "data",
    [
        made_png(raw=b"\0" * 500),
        made_png(raw=b"\7" * (37 * 54)),
        made_png()[:80] + b"\x55" + made_png()[81:],
    ],
    ids=["too short", "unknown filter", "damaged"],
)
def test_broken_images_are_refused_as_before(data: bytes) -> None:
    assert fast(data) is None
    with pytest.raises(InputError, match="cannot be decoded"):
        decode_image(Path("a.png"), data)


def test_images_read_from_files_take_the_fast_way(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(images, "decode_fast", lambda data, header: GREY + 1)
    np.testing.assert_array_equal(decode_image(Path("a.png"), made_png()), GREY + 1)


def test_beside_threads_and_without_it_opencv_decodes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lidarpose.storage.png.threading.active_count", lambda: 2)
    assert fast(made_png()) is None
    monkeypatch.setattr("lidarpose.storage.png.threading.active_count", lambda: 1)
    monkeypatch.setattr(png, "_is_installed", lambda: False)
    assert fast(made_png()) is None
    np.testing.assert_array_equal(decode_image(Path("a.png"), made_png()), GREY)
