"""Chessboards in bright images: every inner corner of every panel, averaged over the shots.

Boards are searched first as grids of whatever size, then by detectors that know the size. Corners are refined in every
full-size shot, by the gradients around them, and averaged. A smooth map from the grid to the image (`GridMap`) is
fitted to the averages: its residuals give the standard deviation that is stated, whatever the image's noise, blur and
contrast, and the board's outline.

Order of equal panels: the file cannot tell two panels of the same size apart. They are taken from left to right, or
from top to bottom where their centres are further apart vertically than horizontally.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from lidarpose.detect.grid_map import GridFit, GridMap, fit_grid_map, grid_points
from lidarpose.detect.grid_search import GridSearch, find_grids
from lidarpose.detect.lattice import Image8
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import BoolArray, FloatArray
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import PanelCorners
from lidarpose.model.targets import Panel

# Shots whose corners are further than this from the others' (median over a panel) show a board or camera that moved.
MOVED_PX = 0.15
# Errors that neither averaging nor neighbours show: interpolation, blur that varies, printing.
_FLOOR_PX = 0.01


class BoardNotFoundError(UndeterminedError):
    """A panel is in none of the bright images.

    Attributes
    ----------
    panel
        Its index in the session.
    other_sizes
        Columns and rows of inner corners of chessboards that are in the images and nobody asked for.
    """

    def __init__(
        self, what: str, *, remedy: str, panel: int = 0, other_sizes: tuple[tuple[int, int], ...] = ()
    ) -> None:
        super().__init__(what, remedy=remedy)
        self.panel = panel
        self.other_sizes = other_sizes


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The panels in the bright images of one placement.

    Attributes
    ----------
    corners
        By panel, in the order that was asked for, averaged over the shots that agree.
    maps
        By panel: the smooth map from grid coordinates (squares) to pixels.
    outlines
        By panel: polygon (M, 2) in pixels around the squares, the outer ones included.
    shot_shift_px : (shots, panels)
        How far the panel's corners lie from those of the shots that were averaged (median over the corners); NaN
        where the panel was not found in that shot.
    shots_used : (shots,)
    notes
        What the user should know, in words.
    """

    corners: tuple[PanelCorners, ...]
    maps: tuple[GridMap, ...]
    shot_shift_px: FloatArray
    shots_used: BoolArray
    notes: tuple[str, ...] = field(default=())

    @property
    def outlines(self) -> tuple[FloatArray, ...]:
        return tuple(grid_map.outline() for grid_map in self.maps)


def find_panels(images: Sequence[GrayImage], panels: Sequence[Panel]) -> BoardDetection:
    """Find all `panels` in bright `images` (shots of the same scene).

    Parameters
    ----------
    images
        Grey, all of one size; 8 or 16 bit.
    panels
        One or more chessboards; any place, order and rotation in the image.

    Raises
    ------
    BoardNotFoundError
        If a panel is in none of the shots.
    """
    if not images:
        raise BoardNotFoundError("There is no bright image of the board", remedy="Record at least one.")
    reference, start = _first_shot_with_all(images, panels)
    refined = [_refine_or_find_again(image, panels, start, index == reference) for index, image in enumerate(images)]
    found = [np.stack([shot[k] for shot in refined]) for k in range(len(panels))]
    shifts, used = _compare_shots(found)
    results = [_average(panel, pixels[used]) for panel, pixels in zip(panels, found, strict=True)]
    first = images[int(np.flatnonzero(used)[0])]
    return BoardDetection(
        corners=tuple(
            replace(corners, first_dark=_first_dark(first, panel, corners.pixels))
            for (corners, _), panel in zip(results, panels, strict=True)
        ),
        maps=tuple(fit.map for _, fit in results),
        shot_shift_px=shifts,
        shots_used=used,
        notes=_notes(shifts, used),
    )


def _first_shot_with_all(images: Sequence[GrayImage], panels: Sequence[Panel]) -> tuple[int, list[FloatArray]]:
    failure: BoardNotFoundError | None = None
    # More than three unsuccessful shots of one scene will not be cured by a fourth.
    for index, image in enumerate(images[:3]):
        search = _locate(image, panels, thorough=index == 0)
        if all(corners is not None for corners in search.grids):
            return index, [corners for corners in search.grids if corners is not None]
        failure = failure or _not_found(search, panels)
    assert failure is not None
    raise failure


def _not_found(search: GridSearch, panels: Sequence[Panel]) -> BoardNotFoundError:
    missing = [k for k, corners in enumerate(search.grids) if corners is None]
    panel = panels[missing[0]]
    seen = [f"{panels[k].columns} x {panels[k].rows}" for k in range(len(panels)) if k not in missing]
    seen += [f"{columns} x {rows}" for columns, rows in search.other_sizes[:3]]
    found = f"found: {', '.join(seen)}" if seen else "no chessboard was found at all"
    return BoardNotFoundError(
        f"Panel {missing[0] + 1} was not found in the bright images: "
        f"expected {panel.columns} x {panel.rows} inner corners; {found}",
        remedy="Check columns and rows (inner corners, not squares), and that the whole panel is in view, sharp, "
        "evenly lit and not over-exposed.",
        panel=missing[0],
        other_sizes=search.other_sizes,
    )


def _locate(image: GrayImage, panels: Sequence[Panel], *, thorough: bool = True) -> GridSearch:
    """Corners of each panel to about a pixel, equal panels in the stated order."""
    sizes = [(panel.columns, panel.rows) for panel in panels]
    search = find_grids(_to_8_bit(image), sizes, thorough=thorough)
    return replace(search, grids=tuple(_in_stated_order(list(search.grids), panels)))


def _in_stated_order(located: list[FloatArray | None], panels: Sequence[Panel]) -> list[FloatArray | None]:
    """Equal panels from left to right, or from top to bottom."""
    ordered = list(located)
    for size in {(p.columns, p.rows) for p in panels}:
        same = [k for k, p in enumerate(panels) if (p.columns, p.rows) == size and located[k] is not None]
        if len(same) < 2:
            continue
        grids = [corners for k in same if (corners := located[k]) is not None]
        centres = np.stack([grid.mean(axis=0) for grid in grids])
        axis = int(np.argmax(np.ptp(centres, axis=0)))
        for k, source in zip(same, np.argsort(centres[:, axis], kind="stable"), strict=True):
            ordered[k] = grids[int(source)]
    return ordered


def _refine_or_find_again(
    image: GrayImage, panels: Sequence[Panel], start: list[FloatArray], is_reference: bool
) -> list[FloatArray]:
    """Corners of all panels in one shot; NaN where a panel is not in it."""
    refined = [refine_corners(image, corners, panel) for corners, panel in zip(start, panels, strict=True)]
    plausible = [_agrees(a, b) for a, b in zip(refined, start, strict=True)]
    if is_reference or all(plausible):
        return refined
    located = _locate(image, panels).grids
    return [
        np.full(first.shape, np.nan) if corners is None else refine_corners(image, corners, panel)
        for corners, panel, first in zip(located, panels, start, strict=True)
    ]


def _agrees(refined: FloatArray, start: FloatArray) -> bool:
    return bool(np.median(np.linalg.norm(refined - start, axis=1)) < 2.0)


def refine_corners(image: GrayImage, corners: FloatArray, panel: Panel) -> FloatArray:
    """Corners (N, 2) to a few hundredths of a pixel: every gradient around one is at right angles to the way there.

    Source: Foerstner and Guelch (1987), as in OpenCV's cornerSubPix. The window grows with the squares: a wide one
    averages more of the edges, but must not reach the next corner.
    """
    grid = corners.reshape(panel.rows, panel.columns, 2)
    pitch = min(
        np.linalg.norm(np.diff(grid, axis=axis), axis=-1).min() if grid.shape[axis] > 1 else np.inf for axis in (0, 1)
    )
    half_window = int(np.clip(0.55 * pitch, 2, 15))
    low = np.maximum(np.floor(corners.min(axis=0)).astype(int) - 2 * half_window, 0)
    high = np.ceil(corners.max(axis=0)).astype(int) + 2 * half_window + 1
    crop = image[low[1] : high[1], low[0] : high[0]]
    smooth = cv2.GaussianBlur(np.asarray(crop, dtype=np.float32) if crop.dtype == np.uint16 else crop, (0, 0), 1.0)
    start = (corners - low).astype(np.float32).reshape(-1, 1, 2)
    criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    refined = cv2.cornerSubPix(smooth, start, (half_window, half_window), (-1, -1), criteria)
    return np.asarray(np.asarray(refined, dtype=np.float64).reshape(-1, 2) + low)


def _compare_shots(found: list[FloatArray]) -> tuple[FloatArray, BoolArray]:
    """Shift of every shot from the median one, by panel, and which shots agree."""
    with np.errstate(all="ignore"):
        shifts = np.stack(
            [np.linalg.norm(np.median(shots - np.nanmedian(shots, axis=0), axis=1), axis=-1) for shots in found], axis=1
        )
    used = np.all(shifts <= MOVED_PX, axis=1)
    if not used.any():
        # Two shots that contradict each other: keep the first, the shift is told in the notes.
        used = np.zeros(len(shifts), dtype=bool)
        used[int(np.flatnonzero(np.all(np.isfinite(shifts), axis=1))[0])] = True
    means = [shots[used].mean(axis=0) for shots in found]
    shifts = np.stack(
        [np.linalg.norm(np.median(s - m, axis=1), axis=-1) for s, m in zip(found, means, strict=True)], axis=1
    )
    return shifts, used


def _average(panel: Panel, shots: FloatArray) -> tuple[PanelCorners, GridFit]:
    """The mean of the shots (S, N, 2), and the standard deviation that its distance from a smooth map shows."""
    pixels = np.median(shots, axis=0) if len(shots) > 4 else shots.mean(axis=0)
    fit = fit_grid_map(panel.columns, panel.rows, grid_points(panel.columns, panel.rows), pixels)
    sigma = np.hypot(fit.sigma_px, _FLOOR_PX)
    # A corner that disagrees with its neighbours is not used, but states what it is worth.
    own = np.abs(fit.residuals_px).max(axis=1)
    each = np.where(fit.inliers, sigma, np.maximum(own, sigma))
    return PanelCorners(panel.corners_panel(), pixels, each), fit


def _first_dark(image: GrayImage, panel: Panel, pixels: FloatArray) -> bool:
    """Whether the square between the first corners is a black one, by the brightness in the middle of all squares."""
    grid = pixels.reshape(panel.rows, panel.columns, 2)
    middles = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
    column, row = np.rint(middles).astype(int).transpose(2, 0, 1)
    light = image[row.clip(0, image.shape[0] - 1), column.clip(0, image.shape[1] - 1)].astype(np.float64)
    like_first = np.indices(light.shape).sum(axis=0) % 2 == 0
    return bool(light[like_first].mean() < light[~like_first].mean())


def _notes(shifts: FloatArray, used: BoolArray) -> tuple[str, ...]:
    notes = []
    for shot in np.flatnonzero(~used):
        if not np.all(np.isfinite(shifts[shot])):
            notes.append(f"bright image {shot + 1}: a panel was not found in it; not used")
        else:
            notes.append(
                f"bright image {shot + 1}: the board or the camera moved by {shifts[shot].max():.2f} pixels "
                "against the other bright images; not used"
            )
    return tuple(notes)


def _to_8_bit(image: GrayImage) -> Image8:
    """Stretch to 8 bit: dark 16-bit images hold their board in a few per cent of the range."""
    if image.dtype == np.uint8:
        return np.asarray(image, dtype=np.uint8)
    low, high = np.percentile(image[::4, ::4], [0.5, 99.5])
    scale = 255.0 / max(float(high - low), 1.0)
    return np.asarray(np.clip((image.astype(np.float32) - low) * scale, 0.0, 255.0), dtype=np.uint8)
