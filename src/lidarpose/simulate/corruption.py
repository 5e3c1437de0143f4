"""Sessions with a mistake in them, as people make them: for tests that a wrong session is told, not calibrated.

Each takes a simulated session and gives the session that the careless person would have recorded; images and scans
are still made when they are asked for.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Literal, get_args

import numpy as np

from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.image import GrayImage, ImageSource
from lidarpose.model.scan import Scan
from lidarpose.model.session import ScanSource, TurntablePlace, TurntableSession
from lidarpose.model.targets import Panel
from lidarpose.simulate.session import SimulatedImage, SimulatedSession, simulate_session

Mistake = Literal[
    "millimetre-scans",
    "empty-scans",
    "reversed-scan",
    "reversed-turntable",
    "turntable-stands-still",
    "turntable-steps-twice-as-far",
    "equal-angles",
    "angles-out-of-order",
    "two-places",
    "wrong-square",
    "wrong-board-size",
    "swapped-panels",
    "other-camera",
    "board-moved-between-shots",
    "board-moved-halfway",
    "board-moved-before-the-stripes",
    "images-one-place-late",
    "no-stripe",
    "stripe-on-one-panel",
    "dark-board-images",
    "overexposed-board-images",
]
MISTAKES: tuple[Mistake, ...] = get_args(Mistake)

BOARD_SHIFT = Pose(exp_so3([0.004, -0.006, 0.003]), np.array([0.004, -0.003, 0.005]))
"""How a bumped board moves in the camera's frame: about half a degree and several millimetres."""


@dataclass(frozen=True)
class MappedScan:
    """A scan that is changed as it is loaded."""

    source: ScanSource
    change: Callable[[Scan], Scan]

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> Scan:
        return self.change(self.source.load())


@dataclass(frozen=True)
class MappedImage:
    """An image that is changed as it is loaded."""

    source: ImageSource
    change: Callable[[GrayImage], GrayImage]

    @property
    def name(self) -> str:
        return self.source.name

    def load(self) -> GrayImage:
        return self.change(self.source.load())


def corrupt(simulated: SimulatedSession, mistake: Mistake) -> TurntableSession:
    """The session with one mistake. Deterministic."""
    return _MISTAKES[mistake](simulated)


def _with_scans(change: Callable[[Scan], Scan]) -> Callable[[SimulatedSession], TurntableSession]:
    def apply(simulated: SimulatedSession) -> TurntableSession:
        session = simulated.session
        return replace(session, places=tuple(replace(p, scan=MappedScan(p.scan, change)) for p in session.places))

    return apply


def _with_board_images(change: Callable[[GrayImage], GrayImage]) -> Callable[[SimulatedSession], TurntableSession]:
    def apply(simulated: SimulatedSession) -> TurntableSession:
        images = simulated.session.board_images.items()
        changed = {name: tuple(MappedImage(source, change) for source in shots) for name, shots in images}
        return replace(simulated.session, board_images=changed)

    return apply


def _with_angles(
    change: Callable[[np.ndarray[tuple[int], np.dtype[np.float64]]], object],
) -> Callable[[SimulatedSession], TurntableSession]:
    """`change` works on the readings (P,), in place or by returning new ones."""

    def apply(simulated: SimulatedSession) -> TurntableSession:
        places = simulated.session.places
        angles = np.array([p.turntable_angle_rad for p in places])
        result = change(angles)
        new = angles if result is None else np.asarray(result)
        moved = tuple(replace(p, turntable_angle_rad=float(a)) for p, a in zip(places, new, strict=True))
        return replace(simulated.session, places=moved)

    return apply


def _with_panels(change: Callable[[tuple[Panel, ...]], tuple[Panel, ...]]) -> Callable[..., TurntableSession]:
    def apply(simulated: SimulatedSession) -> TurntableSession:
        return replace(simulated.session, panels=change(simulated.session.panels))

    return apply


def _equal(angles: np.ndarray[tuple[int], np.dtype[np.float64]]) -> None:
    angles[1] = angles[0]


def _disorder(angles: np.ndarray[tuple[int], np.dtype[np.float64]]) -> None:
    angles[[1, 2]] = angles[[2, 1]]


def _reversed_beams(scan: Scan) -> Scan:
    """The same ranges counted from the other end of the field of view: a LiDAR taken for its mirror image."""
    intensity = None if scan.intensity is None else scan.intensity[::-1]
    return Scan(scan.angle_rad, scan.range_m[::-1], intensity, scan.sweep)


def _standing_still(simulated: SimulatedSession) -> TurntableSession:
    places = simulated.session.places
    still = tuple(replace(p, stripe_image=places[0].stripe_image, scan=places[0].scan) for p in places)
    return replace(simulated.session, places=still)


def _two_places(simulated: SimulatedSession) -> TurntableSession:
    places = simulated.session.places
    return replace(simulated.session, places=(places[0], places[-1]))


def _one_late(simulated: SimulatedSession) -> TurntableSession:
    """Each stripe image belongs to the next place's scan."""
    places = simulated.session.places
    pairs = zip(places[1:], places[:-1], strict=True)
    return replace(simulated.session, places=tuple(replace(p, stripe_image=q.stripe_image) for p, q in pairs))


def _other_camera(simulated: SimulatedSession) -> TurntableSession:
    K = simulated.session.camera.K.copy()
    K[0, 0], K[1, 1] = 1.15 * K[0, 0], 1.15 * K[1, 1]
    return replace(simulated.session, camera=replace(simulated.session.camera, K=K))


def _bumped(simulated: SimulatedSession) -> TurntableSession:
    """The same session with the board a little aside, all through."""
    poses = {name: tuple(BOARD_SHIFT @ T for T in panels) for name, panels in simulated.rig.T_camera_panel.items()}
    rig = replace(simulated.rig, T_camera_panel=poses)
    return simulate_session(rig, int(simulated.truth["seed"]), simulated.options).session


def _bumped_between_shots(simulated: SimulatedSession) -> TurntableSession:
    after = _bumped(simulated).board_images
    images = {name: (*shots[:-1], after[name][-1]) for name, shots in simulated.session.board_images.items()}
    return replace(simulated.session, board_images=images)


def _bumped_from(simulated: SimulatedSession, first: int) -> TurntableSession:
    after = _bumped(simulated).places
    return replace(simulated.session, places=(*simulated.session.places[:first], *after[first:]))


def _dark(simulated: SimulatedSession) -> TurntableSession:
    options = replace(simulated.options, photography=replace(simulated.photography, stripe_level=0.0))
    return simulate_session(simulated.rig, int(simulated.truth["seed"]), options).session


def _stripe_on_first_panel(simulated: SimulatedSession) -> TurntableSession:
    """Something keeps the laser from the second panel: there the image shows what a dark one does."""
    dark = _dark(simulated).places
    places = tuple(_covered(p, q) for p, q in zip(simulated.session.places, dark, strict=True))
    return replace(simulated.session, places=places)


def _covered(place: TurntablePlace, dark: TurntablePlace) -> TurntablePlace:
    image, other = place.stripe_image, dark.stripe_image
    if not isinstance(image, SimulatedImage) or other is None:
        return place
    pixels = image.studio.view.layers[1].pixel

    def cover(levels: GrayImage) -> GrayImage:
        result = levels.copy()
        result.ravel()[pixels] = other.load().ravel()[pixels]
        return result

    return replace(place, stripe_image=MappedImage(image, cover))


_MISTAKES: dict[Mistake, Callable[[SimulatedSession], TurntableSession]] = {
    "millimetre-scans": _with_scans(lambda scan: replace(scan, range_m=1000.0 * scan.range_m)),
    "empty-scans": _with_scans(lambda scan: replace(scan, range_m=np.full(len(scan), np.nan))),
    "reversed-scan": _with_scans(_reversed_beams),
    "reversed-turntable": _with_angles(lambda angles: -angles),
    "turntable-stands-still": _standing_still,
    "turntable-steps-twice-as-far": _with_angles(lambda angles: 0.5 * angles),
    "equal-angles": _with_angles(_equal),
    "angles-out-of-order": _with_angles(_disorder),
    "two-places": _two_places,
    "wrong-square": _with_panels(lambda panels: tuple(replace(p, square_m=1.25 * p.square_m) for p in panels)),
    "wrong-board-size": _with_panels(lambda panels: tuple(replace(p, columns=p.columns - 1) for p in panels)),
    "swapped-panels": _with_panels(lambda panels: panels[::-1]),
    "other-camera": _other_camera,
    "board-moved-between-shots": _bumped_between_shots,
    "board-moved-halfway": lambda s: _bumped_from(s, len(s.session.places) // 2),
    "board-moved-before-the-stripes": lambda s: _bumped_from(s, 0),
    "images-one-place-late": _one_late,
    "no-stripe": _dark,
    "stripe-on-one-panel": _stripe_on_first_panel,
    "dark-board-images": _with_board_images(lambda image: np.asarray(image // 64, dtype=np.uint8)),
    "overexposed-board-images": _with_board_images(lambda image: np.full_like(image, 255)),
}
