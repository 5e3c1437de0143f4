"""Turntable rigs drawn from a seed: camera, V board, LiDAR, axis, readings.

A rig is built around the board. The board's frame has its origin at the middle of the fold, x across the fold, y along
it, z out of the V towards camera and LiDAR. Whatever is drawn is checked against what a person would check before
recording: both panels wholly in the image, the scan plane across both panels, the LiDAR in front of both panels and
out of the camera's way. Draws that fail are drawn again.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray, angle_between, as_float_array, unit
from lidarpose.geometry.se3 import Pose, exp_so3
from lidarpose.model.camera import Camera, DistortionModel
from lidarpose.model.rig_family import FAMILIES, Family
from lidarpose.model.scan import LidarSpec
from lidarpose.model.session import DEFAULT_PLACEMENT
from lidarpose.model.targets import Panel
from lidarpose.model.turntable import TurntableMotion
from lidarpose.simulate.board_pattern import Plate
from lidarpose.simulate.light_sheet import beam_on_panel, chord_on_plate

PAPER_PLACES = 87
PAPER_ARC_DEG = 21.5
PAPER_MARGIN_M = 0.015

# A stripe is of use if it crosses this share of a panel's shorter side within the squares.
_LEAST_CHORD_SHARE = 0.5
_LEAST_SHARE_OF_GOOD_PLACES = 0.97
_LARGEST_INCIDENCE_RAD = float(np.deg2rad(66.0))
_ATTEMPTS = 600
# No scan plane stays on a V board over more than this.
_LARGEST_ARC_DEG = 90.0


@dataclass(frozen=True, eq=False)
class TurntableRig:
    """Where everything truly is.

    Attributes
    ----------
    T_camera_panel
        By placement of the board: the pose of each panel, in the order of `panels`. z points into the board.
    margin_m
        Width of the white margin around the squares.
    motion
        The LiDAR's pose as a function of the reading.
    turntable_angle_rad : (P,)
        The reading at each place.
    placement : P names
        Which of the board's placements is in view at each place.
    beam_angle_rad : (B,)
        The beams of one sweep, ascending.
    range_sigma_m
        Standard deviation of a range.
    """

    camera: Camera
    panels: tuple[Panel, ...]
    T_camera_panel: Mapping[str, tuple[Pose, ...]]
    margin_m: float
    motion: TurntableMotion
    turntable_angle_rad: FloatArray
    placement: tuple[str, ...]
    beam_angle_rad: FloatArray
    range_sigma_m: float
    family: str = "paper"
    seed: int = 0

    def __post_init__(self) -> None:
        angles = as_float_array(self.turntable_angle_rad, (len(self.placement),), "turntable_angle_rad")
        object.__setattr__(self, "turntable_angle_rad", angles)
        object.__setattr__(self, "beam_angle_rad", as_float_array(self.beam_angle_rad, (None,), "beam_angle_rad"))

    def __len__(self) -> int:
        """How many places there are."""
        return len(self.placement)

    @property
    def plates(self) -> tuple[Plate, ...]:
        """The outlines of the panels."""
        return tuple(Plate.of(panel, self.margin_m) for panel in self.panels)

    @property
    def lidar(self) -> LidarSpec:
        """What the user would say of this LiDAR."""
        return LidarSpec("simulated", self.range_sigma_m if self.range_sigma_m > 0.0 else None)

    def T_camera_lidar(self, place: int) -> Pose:
        """The LiDAR's pose at a place."""
        return self.motion.pose(float(self.turntable_angle_rad[place]))

    def T_panel_lidar(self, place: int, panel: int) -> Pose:
        """The LiDAR's pose at a place in a panel's frame."""
        return self.T_camera_panel[self.placement[place]][panel].inverse() @ self.T_camera_lidar(place)

    def chord(self, place: int, panel: int) -> FloatArray | None:
        """The ends (2, 3), in the panel's frame, of the light sheet's line on a panel; None where it misses."""
        return chord_on_plate(self.T_panel_lidar(place, panel), self.plates[panel])


@dataclass(frozen=True)
class _Ranges:
    """Between which bounds a family draws; angles in degrees, lengths in metres. None: the paper's, nothing drawn."""

    arc: tuple[float, float] = (PAPER_ARC_DEG, PAPER_ARC_DEG)
    places: tuple[int, int] = (PAPER_PLACES, PAPER_PLACES)
    start: tuple[float, float] = (0.0, 0.0)
    fold: Literal["vertical", "horizontal", "any"] = "vertical"
    side: Literal["left", "right", "any"] = "any"
    upside_down: bool | None = False
    axis_sign: int | None = None
    dihedral: tuple[float, float] = (118.0, 122.0)
    distance: tuple[float, float] = (1.25, 1.5)
    radius: tuple[float, float] = (0.04, 0.06)
    scan_plane_to_axis: tuple[float, float] = (35.0, 55.0)
    axis_swing: tuple[float, float] = (-15.0, 15.0)
    roll: tuple[float, float] = (-4.0, 4.0)
    stripe_tilt: tuple[float, float] = (-3.0, 3.0)
    fields_of_view: tuple[float, ...] = (70.0,)
    beam_steps: tuple[float, ...] = (1.0 / 12.0,)
    forward: tuple[float, float] = (88.0, 92.0)
    boards: tuple[tuple[Panel, Panel], ...] | None = None
    margin: tuple[float, float] | None = None
    lenses: tuple[_Lens, ...] | None = None
    nearest_camera: float = 0.4


@dataclass(frozen=True)
class _Lens:
    """A lens before a sensor as wide as the paper's: focal length in pixels, and its distortion."""

    focal_px: float
    model: DistortionModel
    distortion: tuple[float, ...]

    def camera(self, width: int, height: int) -> Camera:
        focal = self.focal_px * width / 1624.0
        K = np.array([[focal, 0.0, 0.51 * width], [0.0, 1.001 * focal, 0.485 * height], [0.0, 0.0, 1.0]])
        return Camera(width, height, K, self.model, np.array(self.distortion))


_LENSES = (
    _Lens(1500.0, "plumb_bob", (-0.28, 0.11, 0.0008, -0.0012, -0.02)),
    _Lens(1900.0, "rational_polynomial", (0.35, -0.2, -0.0006, 0.0004, 0.01, 0.6, -0.1, 0.02)),
    _Lens(1000.0, "equidistant", (-0.02, 0.006, -0.003, 0.0004)),
    _Lens(3600.0, "plumb_bob", (0.05, -0.3, 0.0, 0.0)),
)
_BOARDS = (
    (Panel(12, 9, 0.030), Panel(9, 6, 0.040)),
    (Panel(8, 6, 0.040), Panel(8, 6, 0.040)),
    (Panel(14, 20, 0.020), Panel(14, 20, 0.020)),
    (Panel(25, 18, 0.015), Panel(25, 18, 0.015)),
    (Panel(11, 8, 0.030), Panel(20, 14, 0.020)),
    (Panel(9, 7, 0.035), Panel(7, 9, 0.035)),
)

_PAPER = _Ranges()
_MIXED = _Ranges(
    arc=(14.0, 30.0),
    places=(20, 120),
    start=(-180.0, 400.0),
    fold="any",
    upside_down=None,
    dihedral=(105.0, 135.0),
    distance=(1.1, 1.8),
    radius=(0.005, 0.3),
    scan_plane_to_axis=(0.0, 60.0),
    axis_swing=(-90.0, 90.0),
    roll=(-12.0, 12.0),
    stripe_tilt=(-8.0, 8.0),
    fields_of_view=(70.0, 190.0, 270.0),
    beam_steps=(1.0 / 12.0, 1.0 / 6.0, 0.25),
    forward=(-20.0, 110.0),
)
_FAMILY_RANGES: dict[Family, _Ranges] = {
    "paper": _PAPER,
    "upside-down": replace(_PAPER, upside_down=True),
    "left": replace(_PAPER, side="left"),
    "right": replace(_PAPER, side="right"),
    # An axis points up or down in the picture only if it stands upright there, as with a horizontal fold.
    "axis-up": replace(_PAPER, fold="horizontal", axis_sign=1),
    "axis-down": replace(_PAPER, fold="horizontal", axis_sign=-1),
    "far-axis": replace(_PAPER, radius=(0.35, 0.9)),
    "offset-readings": replace(_PAPER, start=(-180.0, 400.0)),
    "tilted-scan-plane": replace(_PAPER, scan_plane_to_axis=(50.0, 75.0), axis_swing=(-60.0, 60.0)),
    "flat-scan-plane": replace(_PAPER, scan_plane_to_axis=(86.0, 89.5), axis_swing=(-180.0, 180.0)),
    "few-places": replace(_PAPER, places=(3, 5)),
    "many-places": replace(_PAPER, places=(200, 200)),
    "fold-horizontal": replace(_PAPER, fold="horizontal"),
    "fold-vertical": replace(_PAPER, fold="vertical"),
    "mixed": _MIXED,
    "other-boards": replace(
        _PAPER,
        fold="any",
        arc=(8.0, 14.0),
        places=(20, 87),
        boards=_BOARDS,
        margin=(0.0, 0.03),
        dihedral=(100.0, 140.0),
    ),
    "other-lenses": replace(_PAPER, fold="any", lenses=_LENSES, nearest_camera=0.9),
    "axis-in-scan-plane": replace(_PAPER, scan_plane_to_axis=(0.0, 2.0), distance=(1.0, 1.15)),
}


def paper_camera(width: int = 1624, height: int = 1234) -> Camera:
    """The turntable paper's camera (section 3.1), or the same lens before a sensor of other pixels."""
    scale = width / 1624.0
    K = np.diag([2757.4 * scale, 2758.6 * scale, 1.0])
    K[0, 2] = (831.6 + 0.5) * scale - 0.5
    K[1, 2] = (638.9 + 0.5) * (height / 1234.0) - 0.5
    return Camera(width, height, K, "plumb_bob", np.array([-0.076, 0.371, 0.0, 0.0]))


def paper_panels() -> tuple[Panel, Panel]:
    """The paper's two chessboards: 20 x 14 corners, 20 mm apart."""
    return Panel(20, 14, 0.020), Panel(20, 14, 0.020)


def draw_rig(
    seed: int,
    *,
    family: Family = "paper",
    places: int | None = None,
    step_deg: float | None = None,
    start_deg: float | None = None,
    range_sigma_m: float = 0.001,
    placements: int = 1,
    size: tuple[int, int] = (1624, 1234),
    camera: Camera | None = None,
    panels: tuple[Panel, Panel] | None = None,
    margin_m: float | None = None,
    dihedral_deg: float | None = None,
) -> TurntableRig:
    """A rig of a family, by a seed: the same seed gives the same rig.

    Parameters
    ----------
    family
        What is out of the ordinary; "paper" is the turntable paper's set-up, "mixed" draws everything freely.
    places, step_deg, start_deg
        Number of places (for each placement of the board), degrees between them, first reading. Unless given, the
        arc is that of the paper, 21.5 degrees, whatever the number of places.
    range_sigma_m
        Standard deviation of the ranges.
    placements
        How often the board is put up; every placement is seen from all readings.
    size
        Width and height of the images.
    camera, panels, margin_m
        Instead of the family's own: the paper's lens, the paper's boards, and a white margin of 15 mm around the
        squares, unless the family draws them.
    dihedral_deg
        Angle between the panels' faces; about 120 degrees unless given. 180 makes them one plane.

    Raises
    ------
    InputError
        If what was asked for is impossible, such as an arc over which no scan plane stays on both panels.
    """
    if family not in _FAMILY_RANGES:
        raise InputError("--family", f"{family!r} is no family", expected=" or ".join(FAMILIES))
    ranges = _FAMILY_RANGES[family]
    if dihedral_deg is not None:
        ranges = replace(ranges, dihedral=(dihedral_deg, dihedral_deg))
    rng = np.random.default_rng([seed, FAMILIES.index(family)])
    angles = np.deg2rad(_draw_readings_deg(rng, ranges, places, step_deg, start_deg))
    if placements < 1:
        raise InputError("placements", f"found {placements}", expected="at least 1")
    the_camera = camera or _draw_lens(rng, ranges, size)
    the_panels = panels or _draw_boards(rng, ranges)
    the_margin = margin_m
    if the_margin is None:
        the_margin = PAPER_MARGIN_M if ranges.margin is None else float(rng.uniform(*ranges.margin))
    if not (np.isfinite(range_sigma_m) and range_sigma_m >= 0.0):
        raise InputError("--range-sigma-mm", f"found {1e3 * range_sigma_m:g}", expected="a number of 0 or more")
    arc_deg = float(np.rad2deg(np.ptp(angles)))
    for _ in range(_ATTEMPTS if arc_deg <= _LARGEST_ARC_DEG else 0):
        rig = _draw_once(rng, ranges, the_camera, the_panels, the_margin, angles, placements)
        if rig is not None and _is_good(rig):
            return replace(rig, range_sigma_m=range_sigma_m, family=family, seed=seed)
    raise InputError(
        "simulated rig",
        f"found no rig of the family {family!r} whose scan plane stays on both panels over {arc_deg:.1f} degrees",
        expected="a smaller arc (places times step)",
    )


def _draw_lens(rng: np.random.Generator, ranges: _Ranges, size: tuple[int, int]) -> Camera:
    if ranges.lenses is None:
        return paper_camera(*size)
    return ranges.lenses[int(rng.integers(len(ranges.lenses)))].camera(*size)


def _draw_boards(rng: np.random.Generator, ranges: _Ranges) -> tuple[Panel, Panel]:
    if ranges.boards is None:
        return paper_panels()
    first, second = ranges.boards[int(rng.integers(len(ranges.boards)))]
    return (first, second) if rng.integers(2) else (second, first)


def _draw_readings_deg(
    rng: np.random.Generator,
    ranges: _Ranges,
    places: int | None,
    step_deg: float | None,
    start_deg: float | None,
) -> FloatArray:
    count = int(rng.integers(ranges.places[0], ranges.places[1] + 1))
    arc = rng.uniform(*ranges.arc)
    start = np.round(rng.uniform(*ranges.start), 2)
    if places is not None:
        count = places
    if count < 1:
        raise InputError("--places", f"found {count}", expected="at least 1")
    if step_deg is not None and not (np.isfinite(step_deg) and step_deg > 0.0):
        raise InputError("--step-deg", f"found {step_deg:g}", expected="a positive number")
    if start_deg is not None and not np.isfinite(start_deg):
        raise InputError("--start-deg", f"found {start_deg:g}", expected="a finite number")
    step = step_deg if step_deg is not None else arc / max(count - 1, 1)
    return np.asarray((start if start_deg is None else start_deg) + step * np.arange(count))


def _draw_once(
    rng: np.random.Generator,
    ranges: _Ranges,
    camera: Camera,
    panels: tuple[Panel, Panel],
    margin_m: float,
    angles: FloatArray,
    placements: int,
) -> TurntableRig | None:
    """One rig, not yet checked; None if the camera cannot see the whole board from anywhere near."""
    horizontal = {"vertical": False, "horizontal": True, "any": bool(rng.integers(2))}[ranges.fold]
    side = {"left": -1, "right": 1, "any": int(rng.choice([-1, 1]))}[ranges.side]
    T_board_panel = _panels_on_board(panels, margin_m, np.deg2rad(rng.uniform(*ranges.dihedral)))
    T_camera_board = _draw_camera(rng, ranges, camera, T_board_panel, panels, margin_m, horizontal, side)
    if T_camera_board is None:
        return None
    T_board_lidar = _draw_lidar(rng, ranges, T_camera_board, side)
    middle = float(0.5 * (angles[0] + angles[-1]))
    motion = _draw_motion(rng, ranges, T_camera_board, T_board_lidar, middle)
    boards = [T_camera_board] + [T_camera_board @ _shift(rng) for _ in range(placements - 1)]
    names = [DEFAULT_PLACEMENT] if placements == 1 else [f"placement-{k + 1}" for k in range(placements)]
    forward = np.deg2rad(rng.uniform(*ranges.forward))
    return TurntableRig(
        camera=camera,
        panels=panels,
        T_camera_panel={n: tuple(b @ p for p in T_board_panel) for n, b in zip(names, boards, strict=True)},
        margin_m=margin_m,
        motion=_turn_beams(motion, forward),
        turntable_angle_rad=np.tile(angles, placements),
        placement=tuple(n for n in names for _ in angles),
        beam_angle_rad=_draw_beams(rng, ranges, forward),
        range_sigma_m=0.0,
    )


def _panels_on_board(panels: tuple[Panel, Panel], margin_m: float, dihedral_rad: float) -> tuple[Pose, Pose]:
    """T_board_panel: each panel's columns run along the fold, the plates' edges meet in it, z points into the board."""
    poses = []
    for side, panel in zip((-1.0, 1.0), panels, strict=True):
        plate = Plate.of(panel, margin_m)
        outwards = np.array([side * np.sin(dihedral_rad / 2), 0.0, np.cos(dihedral_rad / 2)])
        along = np.array([0.0, side, 0.0])
        rotation = np.column_stack([along, outwards, np.cross(along, outwards)])
        middle = 0.5 * (plate.x_min + plate.x_max)
        poses.append(Pose(rotation, rotation @ np.array([-middle, -plate.y_min, 0.0])))
    return poses[0], poses[1]


def _looking_at(position: FloatArray, target: FloatArray, right: FloatArray, roll_rad: float) -> Pose:
    """The pose of a camera at `position` that looks at `target`, its x as near to `right` as can be, then rolled."""
    z = unit(target - position)
    x = unit(right - (right @ z) * z)
    return Pose(np.column_stack([x, np.cross(z, x), z]) @ exp_so3([0.0, 0.0, roll_rad]), position)


def _draw_camera(
    rng: np.random.Generator,
    ranges: _Ranges,
    camera: Camera,
    T_board_panel: tuple[Pose, Pose],
    panels: tuple[Panel, Panel],
    margin_m: float,
    horizontal: bool,
    side: int,
) -> Pose | None:
    """T_camera_board: opposite the LiDAR's side, as near as the whole board stays in the picture, and a bit further."""
    right = np.array([0.0, 1.0, 0.0]) if horizontal else np.array([1.0, 0.0, 0.0])
    up = np.array([-1.0, 0.0, 0.0]) if horizontal else np.array([0.0, 1.0, 0.0])
    sideways, upwards = np.tan(np.deg2rad([-side * rng.uniform(4.0, 14.0), rng.uniform(-10.0, 10.0)]))
    direction = unit(np.array([0.0, 0.0, 1.0]) + sideways * right + upwards * up)
    target = np.array([0.0, 0.0, 0.08]) + rng.uniform(-0.01, 0.01, 3)
    roll = np.deg2rad(rng.uniform(*ranges.roll))
    outlines = [T @ Plate.of(p, margin_m).outline() for T, p in zip(T_board_panel, panels, strict=True)]
    corners = np.concatenate(outlines)

    def sees_all(distance: float) -> bool:
        T_camera_board = _looking_at(target + distance * direction, target, right, roll).inverse()
        return bool(np.all(camera.contains(camera.project(T_camera_board @ corners))))

    near, far = ranges.nearest_camera, 8.0
    if not sees_all(far):
        return None
    while far / near > 1.002:
        middle = float(np.sqrt(near * far))
        near, far = (near, middle) if sees_all(middle) else (middle, far)
    distance = far * rng.uniform(1.03, 1.1)
    return _looking_at(target + distance * direction, target, right, roll).inverse()


def _draw_lidar(rng: np.random.Generator, ranges: _Ranges, T_camera_board: Pose, side: int) -> Pose:
    """T_board_lidar half-way through the arc, with x (for now) at the middle of the board and z up or down."""
    T_board_camera = T_camera_board.inverse()
    right, down = T_board_camera.rotation[:, 0], T_board_camera.rotation[:, 1]
    sideways, downwards = np.tan(np.deg2rad([side * rng.uniform(12.0, 26.0), rng.uniform(-10.0, 10.0)]))
    direction = unit(np.array([0.0, 0.0, 1.0]) + sideways * right + downwards * down)
    target = np.array([rng.uniform(-0.01, 0.01), rng.uniform(-0.02, 0.02), 0.05])
    centre = target + rng.uniform(*ranges.distance) * direction
    forward = unit(target - centre)
    across = exp_so3([0.0, 0.0, np.deg2rad(rng.uniform(*ranges.stripe_tilt))]) @ [1.0, 0.0, 0.0]
    z = unit(np.cross(forward, across))
    # Right way up, z is nearer to the picture's up (or its right, where the scan plane stands upright).
    upright = z @ (right - 1.5 * down) > 0.0
    flip = bool(rng.integers(2)) if ranges.upside_down is None else ranges.upside_down
    z = z if upright != flip else -z
    return Pose(np.column_stack([forward, np.cross(z, forward), z]), centre)


def _draw_motion(
    rng: np.random.Generator, ranges: _Ranges, T_camera_board: Pose, T_board_lidar: Pose, middle_rad: float
) -> TurntableMotion:
    """The axis: its angle to the scan plane, its swing about the plane's normal, its distance from the LiDAR."""
    T_camera_lidar = T_camera_board @ T_board_lidar
    forward, across, normal = T_camera_lidar.rotation.T
    swing = np.deg2rad(rng.uniform(*ranges.axis_swing))
    in_plane = np.cos(swing) * across + np.sin(swing) * forward
    lift = np.deg2rad(rng.uniform(*ranges.scan_plane_to_axis))
    axis = np.cos(lift) * in_plane + rng.choice([-1.0, 1.0]) * np.sin(lift) * normal
    sign = rng.choice([-1, 1])
    if ranges.axis_sign is not None:
        sign = ranges.axis_sign if -axis[1] > 0.0 else -ranges.axis_sign
    axis = sign * axis
    aside = np.cross(axis, rng.normal(size=3))
    radius = np.exp(rng.uniform(*np.log(ranges.radius)))
    x = unit(aside)
    T_camera_table = Pose(np.column_stack([x, np.cross(axis, x), axis]), T_camera_lidar.translation - radius * x)
    T_table_lidar = (T_camera_table @ Pose.rot_z(middle_rad)).inverse() @ T_camera_lidar
    return TurntableMotion.from_any_frame(T_camera_table, T_table_lidar)


def _turn_beams(motion: TurntableMotion, forward_rad: float) -> TurntableMotion:
    """The same LiDAR with its beams counted so that the one towards the board has the angle `forward_rad`."""
    return TurntableMotion(motion.T_camera_turntable, motion.T_turntable_lidar @ Pose.rot_z(-forward_rad))


def _draw_beams(rng: np.random.Generator, ranges: _Ranges, forward_rad: float) -> FloatArray:
    """The beams, ascending; a LiDAR's own table is a whole number of steps about a round middle."""
    step = float(rng.choice(ranges.beam_steps))
    count = round(float(rng.choice(ranges.fields_of_view)) / step) + 1
    middle = round(np.rad2deg(forward_rad) / 5.0) * 5.0
    return np.asarray(np.deg2rad(middle + step * (np.arange(count) - (count - 1) / 2)))


def _shift(rng: np.random.Generator) -> Pose:
    """A board that was put up again a little differently."""
    turn = np.deg2rad(rng.uniform(-8.0, 8.0, 3))
    return Pose(exp_so3(turn), rng.uniform([-0.02, -0.02, 0.0], [0.02, 0.02, 0.15], 3))


def _is_good(rig: TurntableRig) -> bool:
    """Would a person who looks at this rig start recording?"""
    return _board_is_in_view(rig) and _lidar_is_placed_well(rig) and _stripes_cross_both_panels(rig)


def _board_is_in_view(rig: TurntableRig) -> bool:
    for poses in rig.T_camera_panel.values():
        for T_camera_panel, plate in zip(poses, rig.plates, strict=True):
            outline = T_camera_panel @ plate.outline()
            pixels = rig.camera.project(outline)
            if not np.all(rig.camera.contains(pixels)):
                return False
            towards = angle_between(-T_camera_panel.rotation[:, 2], -outline.mean(axis=0))
            if towards > _LARGEST_INCIDENCE_RAD:
                return False
    return True


def _lidar_is_placed_well(rig: TurntableRig) -> bool:
    """The LiDAR lights both panels' faces, and does not stand between the camera and the board (nor the reverse)."""
    for place in {0, len(rig) // 2, len(rig) - 1}:
        centre = rig.T_camera_lidar(place).translation
        if np.linalg.norm(centre) < 0.25:
            return False
        for T_camera_panel, plate in zip(rig.T_camera_panel[rig.placement[place]], rig.plates, strict=True):
            outline = T_camera_panel @ plate.outline()
            if angle_between(-T_camera_panel.rotation[:, 2], centre - outline.mean(axis=0)) > _LARGEST_INCIDENCE_RAD:
                return False
            if _distance_to_bundle(centre, np.zeros(3), outline) < 0.15:
                return False
            if _distance_to_bundle(np.zeros(3), centre, outline) < 0.08:
                return False
    return True


def _distance_to_bundle(point: FloatArray, apex: FloatArray, outline: FloatArray) -> float:
    """How near `point` (3,) comes to the lines of sight from `apex` to a plate (its outline, edges and middle)."""
    weights = np.linspace(0.0, 1.0, 5)
    edges = [(1 - w) * outline + w * np.roll(outline, 1, axis=0) for w in weights]
    targets = np.concatenate([*edges, outline.mean(axis=0, keepdims=True)])
    along = targets - apex
    share = np.clip((along @ (point - apex)) / (along**2).sum(axis=1), 0.0, 1.0)
    return float(np.linalg.norm(apex + share[:, None] * along - point, axis=1).min())


def _stripes_cross_both_panels(rig: TurntableRig) -> bool:
    """Look at the ends of the arc first: most draws fail there."""
    order = np.argsort(-np.abs(np.linspace(-1.0, 1.0, len(rig))), kind="stable")
    missed = 0
    for place in order:
        if not _is_useful(rig, int(place)):
            missed += 1
            if missed > (1.0 - _LEAST_SHARE_OF_GOOD_PLACES) * len(rig):
                return False
    return True


def _is_useful(rig: TurntableRig, place: int) -> bool:
    for k, panel in enumerate(rig.panels):
        T_panel_lidar = rig.T_panel_lidar(place, k)
        ends = chord_on_plate(T_panel_lidar, Plate.of(panel, 0.0))
        least = _LEAST_CHORD_SHARE * panel.square_m * (min(panel.columns, panel.rows) + 1)
        if ends is None or np.linalg.norm(ends[1] - ends[0]) < least:
            return False
        if not beam_on_panel(T_panel_lidar, ends, rig.beam_angle_rad):
            return False
    return True
