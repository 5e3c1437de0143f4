"""The truth that simulations write beside a session: OUT.truth.json, with transforms as in a calibration file."""

from __future__ import annotations

from pathlib import Path

from lidarpose.model.turntable import TurntableMotion
from lidarpose.storage.documents import read_json


def truth_path(folder: Path) -> Path:
    """Where the truth of a simulated session or recording lies: beside the folder, never in it."""
    resolved = folder.resolve()
    return resolved.with_name(resolved.name + ".truth.json")


def read_turntable_truth(folder: Path | str) -> TurntableMotion | None:
    """The true motion of a simulated session; None where there is no truth beside it, or one of another kind.

    Raises
    ------
    InputError
        If the file is there but cannot be read.
    """
    from lidarpose.storage.calibration import transform_from

    path = truth_path(Path(folder))
    if not path.is_file():
        return None
    document = read_json(path)
    entries = document.get("transforms") if isinstance(document, dict) else None
    if not isinstance(entries, list):
        return None
    table = transform_from(path, entries, "camera", "turntable")
    lidar = transform_from(path, entries, "turntable", "lidar")
    if table is None or lidar is None:
        return None
    return TurntableMotion.from_any_frame(table, lidar)
