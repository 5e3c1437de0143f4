"""Images that are decoded before anybody knows what to look for in them, in memory that forked copies share."""

from __future__ import annotations

import mmap
from collections.abc import Sequence

import numpy as np

from lidarpose.model.image import GrayImage, ImageSource

MOST = 16
"""So many images are decoded early, at most: about what a copy has time for while the boards are found."""
MOST_BYTES = 1 << 26


class EarlyImages:
    """The first of some images, each in a place of its own that is there before a fork, so that nothing has to be sent.

    Parameters
    ----------
    sources
        Only those of 8 bits and `shape` (height, width) can be kept; the others are loaded when they are asked for.
    """

    def __init__(self, sources: Sequence[ImageSource], shape: tuple[int, int]) -> None:
        self._shape, self._size = shape, shape[0] * shape[1]
        self._sources = sources[: min(MOST, MOST_BYTES // self._size)]
        self._memory = mmap.mmap(-1, max(len(self) * self._size, 1))  # shared with copies, and in no file
        self._there: dict[int, int] = {}  # by id: sources of others need not be hashable

    def __len__(self) -> int:
        return len(self._sources)

    def decode(self, k: int) -> bool:
        """Load image k; whether it could be kept. Raises InputError as its source does."""
        image = self._sources[k].load()
        kept = image.dtype == np.uint8 and image.shape == self._shape
        if kept:
            self._place(k)[...] = image
        return kept

    def keep(self, decoded: Sequence[bool]) -> None:
        """What `decode` has answered, whoever was asked."""
        self._there = {id(source): k for k, source in enumerate(self._sources) if decoded[k]}

    def load(self, source: ImageSource) -> GrayImage:
        """An image, decoded before or now."""
        k = self._there.get(id(source))
        return source.load() if k is None else self._place(k)

    def _place(self, k: int) -> GrayImage:
        found = np.frombuffer(self._memory, np.uint8, self._size, k * self._size)
        return found.reshape(self._shape)
