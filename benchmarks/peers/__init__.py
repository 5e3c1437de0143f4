"""What lidarpose is measured against: other libraries where they are installed, and the literature's methods."""

from __future__ import annotations

from importlib import import_module
from importlib.util import find_spec
from typing import Any


def peer(name: str) -> Any | None:
    """A library by its module's name; None where it is not installed (`make bench-setup` installs them)."""
    return import_module(name) if find_spec(name) is not None else None
