"""The laser's stripe on each panel: points on its centre line with a standard deviation each.

A light sheet of Gaussian thickness meets a board whose albedo jumps from square to square, and the lens blurs the
product of both. With the stripe's width (s) and the lens's blur (b) known, that blur of a product has a closed form: at
signed distance d from the centre line the pixel sees

    A * Gauss(d; s^2 + b^2) * albedo, taken at distance d s^2 / (s^2 + b^2)
                                      and blurred by s b / sqrt(s^2 + b^2) across and by b along the stripe

So a thin stripe under a blurred lens sees the albedo of its centre line only, and its profile is not bent by the edges
beside it; a thick one under a sharp lens sees it everywhere. This is fitted, column by column of the image (row by row
for steep stripes), with the ambient light as a multiple of the bright image, and noise that grows with the signal.

The stripe is a straight line on each panel, in the image a smooth curve. It is first sought in a reduced image: the
ridge's maxima of each column or row, and the straight line that most of them support (RANSAC).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.detect.albedo import measure_albedo
from lidarpose.detect.chessboard import BoardDetection
from lidarpose.detect.stripe_fit import fit_stripes
from lidarpose.detect.stripe_points import StripeFit
from lidarpose.detect.stripe_search import KERNELS, CoarseLine, PanelView, find_line, has_line
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.compiled import pays
from lidarpose.model.image import GrayImage
from lidarpose.model.observation import LeftOut, StripePoints

Image = GrayImage | FloatArray

# Margins within this many squares of another panel's inner corners are not used.
_KEPT_APART = 3.0


# Rows of the bright images that are combined at once.
_ROWS_AT_ONCE = 64
# By how much kernels find one sooner.
_SAVED_S_PER_STRIPE = 0.003


@dataclass(frozen=True)
class StripeDetection:
    """The stripes found in one image, by panel, and what was given up with its reason."""

    stripes: Mapping[int, StripePoints]
    problems: tuple[LeftOut, ...]


class StripeFinder:
    """Finds the stripe in the images of one placement of the board; made once, used for each image.

    Parameters
    ----------
    board
        Where the panels are.
    bright_images
        The images that `board` was found in: they give each square's light and dark level, and the ambient light.
    """

    def __init__(self, board: BoardDetection, bright_images: Sequence[GrayImage]) -> None:
        used = [image for image, is_used in zip(bright_images, board.shots_used, strict=True) if is_used]
        bright = _combine(used)
        self._shape = bright.shape
        self._limit = float(np.iinfo(bright_images[0].dtype).max)
        self._views: list[PanelView] = []
        for k, grid_map in enumerate(board.maps):
            albedo = measure_albedo(grid_map, bright)
            for other in board.maps[:k] + board.maps[k + 1 :]:
                # Which panel the margin between two panels belongs to is not known.
                albedo = albedo.apart_from(other.outline(_KEPT_APART))
            view = PanelView.make(albedo, bright)
            self._views.append(view.with_model() if has_line(view) else view)

    def find(self, image: GrayImage) -> StripeDetection:
        """Stripe points on every panel in an image of the same size as the bright ones (ValueError if not)."""
        return self.find_in([image])[0]

    def find_in(self, images: Iterable[GrayImage]) -> list[StripeDetection]:
        """The same for several images at once, which takes a fraction of the time.

        If they are loaded one by one, each is looked at while it is in the cache.
        """
        held: list[GrayImage] = []
        lines: list[list[CoarseLine | str]] = []
        for image in images:
            if image.shape != self._shape:
                raise ValueError(f"the stripe image has {image.shape} pixels, the bright images have {self._shape}")
            pays(_SAVED_S_PER_STRIPE * len(self._views), KERNELS)  # what follows asks again, for nothing more
            held.append(image)
            lines.append([find_line(view, image) for view in self._views])
        stripes: list[dict[int, StripePoints]] = [{} for _ in held]
        problems: list[list[LeftOut]] = [[] for _ in held]
        for k, view in enumerate(self._views):
            for i, fit in enumerate(_fits(view, held, [found[k] for found in lines], self._limit)):
                if isinstance(fit, str):
                    problems[i].append(LeftOut(f"stripe on panel {k + 1}", fit))
                else:
                    stripes[i][k] = fit.points
        return [StripeDetection(found, tuple(lost)) for found, lost in zip(stripes, problems, strict=True)]


def _fits(
    view: PanelView, images: Sequence[GrayImage], lines: Sequence[CoarseLine | str], limit: float
) -> list[StripeFit | str]:
    """The stripe on one panel near each image's line, or why there is none."""
    seen = [i for i, line in enumerate(lines) if not isinstance(line, str)]
    fits = fit_stripes(view, [images[i] for i in seen], [line for line in lines if not isinstance(line, str)], limit)
    found: list[StripeFit | str] = [line if isinstance(line, str) else "" for line in lines]
    for i, fit in zip(seen, fits, strict=True):
        found[i] = fit
    return found


def _combine(images: Sequence[GrayImage]) -> FloatArray:
    """One bright image (float32) of several shots: the median of three groups' means, deaf to what passes in one."""
    shots: list[Image] = list(images)
    found = np.empty(shots[0].shape, dtype=np.float32)
    for first in range(0, len(found), _ROWS_AT_ONCE):
        # A few rows at a time stay in the cache.
        found[first : first + _ROWS_AT_ONCE] = _combined([shot[first : first + _ROWS_AT_ONCE] for shot in shots])
    return found


def _combined(shots: Sequence[Image]) -> Image:
    if len(shots) == 3:
        return _middle(*shots)  # no other numbers than theirs
    levels: list[FloatArray] = [np.asarray(shot, dtype=np.float32) for shot in shots]
    if len(levels) < 3:
        return np.asarray(sum(levels[1:], levels[0]) / np.float32(len(levels)))
    return _middle(*(sum(levels[k + 3 :: 3], levels[k]) / np.float32(len(levels[k::3])) for k in range(3)))


def _middle(a: Image, b: Image, c: Image) -> Image:
    return np.asarray(np.maximum(np.minimum(a, b), np.minimum(np.maximum(a, b), c)))
