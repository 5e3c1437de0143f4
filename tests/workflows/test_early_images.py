"""Images decoded before they are asked for, by this process or a copy of it."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pytest

from lidarpose.errors import InputError
from lidarpose.model.image import GrayImage
from lidarpose.workflows import early_images
from lidarpose.workflows.early_images import EarlyImages
from lidarpose.workflows.forked import copies_allowed, share


@dataclass
class Source:
    """Not to be hashed, as any source may be."""

    image: GrayImage | None
    name: str = "image"
    asked: list[None] = field(default_factory=list)

    def load(self) -> GrayImage:
        self.asked.append(None)
        if self.image is None:
            raise InputError(self.name, "is no image")
        return self.image


def some(count: int, shape: tuple[int, int] = (30, 40)) -> list[Source]:
    rng = np.random.default_rng(1)
    return [Source(rng.integers(0, 256, shape).astype(np.uint8)) for _ in range(count)]


def test_images_that_copies_decoded_are_here() -> None:
    sources = some(5)
    early = EarlyImages(sources, (30, 40))
    early.keep(share(early.decode, len(early), copies=copies_allowed()))
    here = [len(source.asked) for source in sources]
    for source, before in zip(sources, here, strict=True):
        np.testing.assert_array_equal(early.load(source), source.image)
        assert len(source.asked) == before


def test_what_cannot_be_kept_is_loaded_when_it_is_asked_for() -> None:
    sources = [*some(1), *some(1, (40, 30)), Source(np.full((30, 40), 4000, dtype=np.uint16)), *some(1)]
    early = EarlyImages(sources, (30, 40))
    decoded = [early.decode(k) for k in range(4)]
    assert decoded == [True, False, False, True]
    early.keep(decoded)
    for source in (*sources, *some(1)):
        found = early.load(source)
        np.testing.assert_array_equal(found, source.image)
        assert found.dtype == (np.uint8 if source.image is None else source.image.dtype)
    assert [len(source.asked) for source in sources] == [1, 2, 2, 1]


def test_there_is_a_limit_of_number_and_of_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    assert len(EarlyImages(some(early_images.MOST + 3), (30, 40))) == early_images.MOST
    monkeypatch.setattr(early_images, "MOST_BYTES", 2 * 30 * 40 + 1)
    assert len(EarlyImages(some(5), (30, 40))) == 2
    assert len(EarlyImages(some(5), (300, 400))) == 0
    assert len(EarlyImages([], (30, 40))) == 0


def test_an_unreadable_image_is_said_to_be_so() -> None:
    early = EarlyImages([Source(None, "dark.png")], (30, 40))
    with pytest.raises(InputError, match=r"dark\.png"):
        early.decode(0)
