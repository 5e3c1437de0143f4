"""Images from files: as they were written, to the bit, or refused."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.storage.images import FileImage, decode_image

GREY = np.random.default_rng(0).integers(0, 256, (37, 53), dtype=np.uint8)


def png(image: np.ndarray, *, filters: int = cv2.IMWRITE_PNG_ALL_FILTERS) -> bytes:
    return bytes(cv2.imencode(".png", image, [cv2.IMWRITE_PNG_FILTER, filters])[1])


@pytest.mark.parametrize("filters", [cv2.IMWRITE_PNG_FILTER_NONE, cv2.IMWRITE_PNG_ALL_FILTERS])
def test_grey_images_come_back_to_the_bit(filters) -> None:
    np.testing.assert_array_equal(decode_image(Path("a.png"), png(GREY, filters=filters)), GREY)


def test_sixteen_bits_are_kept() -> None:
    deep = GREY.astype(np.uint16) * 257
    found = decode_image(Path("a.png"), png(deep))
    assert found.dtype == np.uint16
    np.testing.assert_array_equal(found, deep)


def test_colour_becomes_grey() -> None:
    colour = np.random.default_rng(1).integers(0, 256, (20, 30, 3), dtype=np.uint8)
    expected = cv2.cvtColor(colour, cv2.COLOR_BGR2GRAY).astype(int)
    assert np.abs(decode_image(Path("a.png"), png(colour)).astype(int) - expected).max() <= 1


def test_a_damaged_image_is_refused(tmp_path) -> None:
    data = bytearray(png(GREY))
    data[len(data) // 2] ^= 0x55
    path = tmp_path / "a.png"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png.*cannot be decoded"):
        FileImage(path, "a.png", 53, 37).load()
