"""Grey images, and the promise of one that is read only when it is needed."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

GrayImage = NDArray[np.uint8] | NDArray[np.uint16]
"""(height, width), linear in light up to saturation at the type's largest value."""


class ImageSource(Protocol):
    """An image somewhere; sessions hold these so that 200 images need not be in memory at once."""

    @property
    def name(self) -> str:
        """What a person calls it: the path as the session's files write it."""
        ...

    def load(self) -> GrayImage:
        """Read it. Raises InputError if it is missing or unreadable."""
        ...
