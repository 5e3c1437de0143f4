"""How a sweep recording's folder is told from others, without the modules that read one."""

from __future__ import annotations

from pathlib import Path

HEAD = "recording.toml"


def is_recording(path: Path) -> bool:
    """True for a folder with a recording's head file in it."""
    return (Path(path) / HEAD).is_file()
