"""Senses of turning as a person sees them on his rig. Nothing heavy is imported: commands offer them as choices."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

Sense = Literal[
    "clockwise-from-above",
    "anticlockwise-from-above",
    "clockwise-from-camera",
    "anticlockwise-from-camera",
    "clockwise-from-right",
    "anticlockwise-from-right",
]
"""A sense of turning and where it is seen from: above is towards the upper edge of the image, right its right edge."""


@dataclass(frozen=True)
class StatedSense:
    """What the user sees on his rig: how beams turn as beam angles grow, how the table turns as readings grow."""

    beams: Sense | None = None
    table: Sense | None = None

    def filled_from(self, other: StatedSense) -> StatedSense:
        """The same, with what is not stated here taken from another statement."""
        return StatedSense(self.beams or other.beams, self.table or other.table)
