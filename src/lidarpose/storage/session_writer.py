"""Turntable sessions written as folders in the fixed format (docs/formats.md), with the truth beside them if known."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np

from lidarpose.errors import InputError
from lidarpose.model.image import ImageSource
from lidarpose.model.scan import Scan
from lidarpose.model.session import DEFAULT_PLACEMENT, TurntablePlace, TurntableSession
from lidarpose.storage.atomic import replacing_folder, restore_folder, write_text
from lidarpose.storage.camera_info import write_camera_info
from lidarpose.storage.session import SESSION_FORMAT
from lidarpose.storage.session_folder import check_free
from lidarpose.storage.truth import truth_path

Step = Callable[[], None]


def count_files(session: TurntableSession) -> int:
    """How many images and scans `write_turntable_session` writes: the steps of its progress."""
    return sum(1 for _ in _images(session)) + len(session.places)


def write_turntable_session(
    folder: Path,
    session: TurntableSession,
    *,
    truth: Mapping[str, Any] | None = None,
    force: bool = False,
    step: Step | None = None,
) -> None:
    """Write a session, whole or not at all, and its truth as ``FOLDER.truth.json``.

    Images and scans are loaded one at a time and written at once, so that a session of any length needs little memory.

    Parameters
    ----------
    folder
        A new or an empty folder. A session with its truth beside it (an earlier simulation) is replaced; one without
        (perhaps a recording) only with `force`; anything else never.
    truth
        A JSON object. A truth of an earlier session is removed in any case.
    step
        Called after each image and scan.

    Raises
    ------
    InputError
        If the folder holds something else, or cannot be written to.
    """
    folder = Path(folder)
    restore_folder(folder)
    check_free(folder, SESSION_FORMAT, force=force)
    with replacing_folder(folder) as temporary:
        _write_files(temporary, session, step or (lambda: None))
        write_text(temporary / "positions.csv", _positions_text(session))
        write_camera_info(temporary / "camera.yaml", session.camera)
        write_text(temporary / "session.toml", _session_text(session))
        truth_path(folder).unlink(missing_ok=True)
    if truth is not None:
        write_text(truth_path(folder), json.dumps(truth, indent=1, allow_nan=False) + "\n")


def _images(session: TurntableSession) -> Iterator[tuple[str, ImageSource]]:
    """Every image with its path in the folder."""
    for placement, shots in session.board_images.items():
        for k, source in enumerate(shots):
            yield f"{_board_folder(placement)}/{k:02d}.png", source
    for k, place in enumerate(session.places):
        if place.stripe_image is not None:
            yield _stripe_path(k), place.stripe_image


def _board_folder(placement: str) -> str:
    return "board" if placement == DEFAULT_PLACEMENT else f"board/{placement}"


def _stripe_path(index: int) -> str:
    return f"stripes/{index:03d}.png"


def _scan_path(index: int) -> str:
    return f"scans/{index:03d}.csv"


def _write_files(folder: Path, session: TurntableSession, step: Step) -> None:
    for name in ("stripes", "scans", *(_board_folder(placement) for placement in session.board_images)):
        (folder / name).mkdir(parents=True, exist_ok=True)

    def image(entry: tuple[str, ImageSource]) -> None:
        _write_png(folder / entry[0], entry[1])
        step()

    def scan(entry: tuple[int, TurntablePlace]) -> None:
        text = scan_text(entry[1].scan.load())
        (folder / _scan_path(entry[0])).write_text(text, encoding="utf-8", newline="\n")
        step()

    images = list(_images(session))
    # One image of each kind first: what they share (a simulation's view of the scene) is then made once.
    for entry in images[:1]:
        image(entry)
    with ThreadPoolExecutor(max_workers=min(4, os.cpu_count() or 1)) as pool:
        try:
            for _ in pool.map(image, images[1:]):
                pass
            for _ in pool.map(scan, enumerate(session.places)):
                pass
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def _write_png(path: Path, source: ImageSource) -> None:
    import cv2

    done, data = cv2.imencode(".png", source.load(), [cv2.IMWRITE_PNG_COMPRESSION, 1])
    if not done:
        raise InputError(path, "cannot be encoded as PNG", expected="an image of 8 or 16 bit")
    path.write_bytes(data.tobytes())


def scan_text(scan: Scan) -> str:
    """A scan as CSV: 12 digits, and an empty range for a beam without return."""
    columns = [
        [f"{a:.12g}" for a in np.rad2deg(scan.angle_rad).tolist()],
        [f"{r:.12g}" if np.isfinite(r) else "" for r in scan.range_m.tolist()],
    ]
    header = ["angle_deg", "range_m"]
    if scan.intensity is not None:
        header.append("intensity")
        columns.append([f"{i:.9g}" if np.isfinite(i) else "" for i in scan.intensity.tolist()])
    if scan.sweep is not None:
        header.append("sweep")
        columns.append([str(s) for s in scan.sweep.tolist()])
    return "\n".join([",".join(header), *(",".join(row) for row in zip(*columns, strict=True))]) + "\n"


def _positions_text(session: TurntableSession) -> str:
    moved = any(place.placement != DEFAULT_PLACEMENT for place in session.places)
    lines = ["position,turntable_angle_deg,stripe_image,scan" + (",placement" if moved else "")]
    for k, place in enumerate(session.places):
        angle = f"{float(np.rad2deg(place.turntable_angle_rad)):.12g}"
        image = "" if place.stripe_image is None else _stripe_path(k)
        cells = [place.position, angle, image, _scan_path(k), *([place.placement] if moved else [])]
        lines.append(",".join(cells))
    return "\n".join(lines) + "\n"


def _session_text(session: TurntableSession) -> str:
    lines = [
        f'format = "{SESSION_FORMAT}"',
        'camera = "camera.yaml"',
        'positions = "positions.csv"',
        "",
        "[board]",
        'images = "board/*.png"',
    ]
    for panel in session.panels:
        lines += ["", "[[board.panels]]", f"columns = {panel.columns}", f"rows = {panel.rows}"]
        lines.append(f"square_m = {panel.square_m!r}")
    lines += ["", "[lidar]"]
    if session.lidar.model is not None:
        # A JSON string is a TOML basic string too.
        lines.append(f"model = {json.dumps(session.lidar.model)}")
    if session.lidar.range_sigma_m is not None:
        lines.append(f"range_sigma_m = {session.lidar.range_sigma_m!r}")
    said = {"beams": session.stated.beams, "table": session.stated.table}
    if any(said.values()):
        lines += ["", "[turning]", *(f'{key} = "{sense}"' for key, sense in said.items() if sense)]
    return "\n".join(lines) + "\n"
