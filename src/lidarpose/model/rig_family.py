"""Kinds of simulated turntable rigs. Nothing heavy is imported: commands offer them as choices."""

from __future__ import annotations

from typing import Literal, get_args

Family = Literal[
    "paper",
    "upside-down",
    "left",
    "right",
    "axis-up",
    "axis-down",
    "far-axis",
    "offset-readings",
    "tilted-scan-plane",
    "flat-scan-plane",
    "few-places",
    "many-places",
    "fold-horizontal",
    "fold-vertical",
    "mixed",
    "axis-in-scan-plane",
    "other-boards",
    "other-lenses",
]
FAMILIES: tuple[Family, ...] = get_args(Family)
