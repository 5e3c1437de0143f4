"""Simulated sessions on disk, made once a test run and copied by the tests that spoil them."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from lidarpose.cli.main import run

PLACES = 8


def write_simulated_session(folder: Path, *options: str) -> Path:
    """A small turntable session with its truth beside it."""
    assert run(["simulate", "turntable", str(folder), "--seed", "3", "--places", str(PLACES), "--quiet", *options]) == 0
    return folder


def copy_session(session: Path, target: Path) -> Path:
    """A copy of a session, with its truth."""
    shutil.copytree(session, target)
    truth = session.with_name(session.name + ".truth.json")
    if truth.exists():
        shutil.copy(truth, target.with_name(target.name + ".truth.json"))
    return target


def edit_text(path: Path, change: Callable[[str], str]) -> None:
    """Rewrite a text file."""
    before = path.read_text(encoding="utf-8")
    after = change(before)
    assert after != before, f"nothing to change in {path}"
    path.write_text(after, encoding="utf-8")


def blank_images(paths: list[Path]) -> None:
    """Overwrite images by dark ones of the same size."""
    for path in paths:
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        assert image is not None
        dark = np.asarray(np.random.default_rng(0).integers(0, 6, image.shape), dtype=np.uint8)
        assert cv2.imwrite(str(path), dark)


def hide_panel_stripe(path: Path, bright: Path, left: bool) -> None:
    """Darken the left or right half of a stripe image, so that one panel shows no stripe."""
    image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    middle = image.shape[1] // 2
    part = image[:, :middle] if left else image[:, middle:]
    part[...] = np.random.default_rng(1).integers(0, 6, part.shape, dtype=np.uint8)
    assert cv2.imwrite(str(path), image)
