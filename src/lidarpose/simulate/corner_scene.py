"""Corner sessions made up: a target of three faces, moved about a scene with ground, walls and clutter."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.errors import InputError
from lidarpose.geometry.arrays import FloatArray, unit
from lidarpose.geometry.se3 import Pose, exp_so3, rotation_z
from lidarpose.model.cloud import Cloud
from lidarpose.model.corner_session import CornerPlace, CornerSession, MemoryCloud
from lidarpose.model.scan import LidarSpec
from lidarpose.simulate.multibeam import INSTRUMENTS, BeamTable, CastScene, ConvexSolid, Defects, cast_scene

TargetKind = Literal["cube", "arrow", "oblique", "concave"]


def paper_rotation(yaw_deg: float, roll_deg: float, pitch_deg: float) -> FloatArray:
    """R_world_lidar (3, 3) from the corner paper's angles: yaw about z, roll about y, pitch about x."""
    yaw, roll, pitch = np.radians([yaw_deg, roll_deg, pitch_deg])
    about_y, about_x = exp_so3([0.0, roll, 0.0]), exp_so3([pitch, 0.0, 0.0])
    return np.asarray(rotation_z(yaw) @ about_y @ about_x)


PAPER_POSES: dict[str, tuple[Pose, TargetKind, float]] = {
    "1": (Pose(paper_rotation(0.0, 28.6479, 0.0), np.array([0.0, 0.0, 1.5])), "cube", 0.0),
    "2": (Pose(paper_rotation(0.0, 22.9183, 0.0), np.array([0.0, 0.0, 1.5])), "cube", 0.0),
    "arrow": (Pose(paper_rotation(5.7296, 0.0, 5.7296), np.array([0.0, 2.0, 0.0])), "arrow", -1.2),
}
"""The corner paper's simulated cases: T_world_lidar, the target, and the height of the ground."""


@dataclass(frozen=True, eq=False)
class Target:
    """A target about its corner at the origin.

    Attributes
    ----------
    solids
        What it is made of.
    face_normals : (3, 3)
        Unit normals of the three faces that meet in the corner, one a row, pointing to free space.
    bottom_m
        How far its lowest point is below the corner.
    """

    kind: TargetKind
    solids: tuple[ConvexSolid, ...]
    face_normals: FloatArray
    bottom_m: float


@dataclass(frozen=True, eq=False)
class CornerTruth:
    """What was true: the pose, the corners (P, 3) and the target's face normals (3, 3) in the clouds' frame."""

    T_world_lidar: Pose
    corners_lidar: FloatArray
    corners_world: FloatArray
    face_normals_lidar: FloatArray


@dataclass(frozen=True)
class CornerSceneSpec:
    """What to simulate: `pose` is one of `PAPER_POSES`, or T_world_lidar itself.

    `beam_crossing_m` is how far before the LiDAR's axis its beams cross, which the clouds leave out.
    """

    pose: str | Pose = "1"
    target: TargetKind | None = None
    ground_m: float | None = None
    lidar: str = "hdl32"
    places: int = 6
    frames: int = 20
    seed: int = 0
    size_m: float = 0.5
    room: bool = False
    clutter: int = 0
    world_sigma_m: float = 0.0
    hints: bool = False
    turned_place: int | None = None
    turned_deg: float = 5.0
    beam_crossing_m: float = 0.0
    defects: Defects = field(default_factory=Defects)


def parallelepiped(corner: ArrayLike, normals: ArrayLike, depths: ArrayLike) -> ConvexSolid:
    """The solid behind three planes through `corner` with outward `normals` (3, 3), cut off at `depths` (3,)."""
    n = unit(normals)
    inner = n @ np.asarray(corner, dtype=np.float64)
    return ConvexSolid(np.vstack([n, -n]), np.concatenate([inner, np.asarray(depths) - inner]))


def upright_box(centre: ArrayLike, size: ArrayLike, yaw_rad: float) -> ConvexSolid:
    """A box with vertical sides: `centre` (3,), `size` (3,) along its own axes."""
    axes = rotation_z(yaw_rad).T
    middle, half = axes @ np.asarray(centre, dtype=np.float64), np.asarray(size, dtype=np.float64) / 2.0
    return ConvexSolid(np.vstack([axes, -axes]), np.concatenate([middle + half, half - middle]))


def make_target(kind: TargetKind, size_m: float, towards_rad: float, rng: np.random.Generator) -> Target:
    """A target whose corner shows itself to a LiDAR above it in the horizontal direction `towards_rad`."""
    turn = rotation_z(towards_rad)
    half = np.sqrt(0.5)
    if kind == "cube":
        normals = np.array([[0.0, 0.0, 1.0], [half, half, 0.0], [half, -half, 0.0]])
        normals = normals @ rotation_z(rng.uniform(-0.2, 0.2)).T
        return _solid_target(kind, normals @ turn.T, size_m)
    if kind == "arrow":
        # The head of a block arrow pointing at the LiDAR: sides 80 degrees apart, the top sloping towards the tip.
        a = np.radians(50.0)
        normals = np.array([[0.42, 0.05, 0.906], [np.cos(a), np.sin(a), 0.0], [np.cos(a), -np.sin(a), -0.1]])
        return _solid_target(kind, unit(normals) @ turn.T, size_m)
    if kind == "oblique":
        normals = np.array([[0.2, 0.0, 1.0], [half, half, 0.1], [half, -half, 0.1]]) + rng.uniform(-0.15, 0.15, (3, 3))
        return _solid_target(kind, unit(normals) @ turn.T, size_m)
    return _concave_target(size_m, turn @ rotation_z(rng.uniform(-0.2, 0.2)))


def _solid_target(kind: TargetKind, normals: FloatArray, size_m: float) -> Target:
    solid = parallelepiped(np.zeros(3), normals, np.full(3, size_m))
    # The vertices of a parallelepiped follow from its six planes.
    inverse = np.linalg.inv(normals)
    shifts = np.stack(np.meshgrid(*[[0.0, -size_m]] * 3, indexing="ij"), -1).reshape(-1, 3)
    return Target(kind, (solid,), normals, float(-(shifts @ inverse.T)[:, 2].min()))


def _concave_target(size_m: float, turn: FloatArray) -> Target:
    """Three boards, 2 cm thick, that meet like the walls and floor of a room."""
    half = np.sqrt(0.5)
    inward = np.array([[0.0, 0.0, 1.0], [half, half, 0.0], [half, -half, 0.0]]) @ turn.T
    boards = []
    for i in range(3):
        others = [inward[j] for j in range(3) if j != i]
        normals = np.stack([inward[i], -inward[i], *(-o for o in others), *others])
        offsets = np.array([0.0, 0.02, 0.02, 0.02, size_m, size_m])
        boards.append(ConvexSolid(normals, offsets))
    return Target("concave", tuple(boards), inward, 0.02)


def _moved(solid: ConvexSolid, shift: FloatArray) -> ConvexSolid:
    return ConvexSolid(solid.normals, solid.offsets + solid.normals @ shift)


def _turned(target: Target, angle_rad: float) -> Target:
    R = rotation_z(angle_rad)
    solids = tuple(ConvexSolid(s.normals @ R.T, s.offsets) for s in target.solids)
    return Target(target.kind, solids, target.face_normals @ R.T, target.bottom_m)


def corner_places(
    count: int, T_world_lidar: Pose, ground_m: float, target: Target, table: BeamTable, rng: np.random.Generator
) -> FloatArray:
    """Corners (count, 3) in the world, well spread in front of the LiDAR at about 2 m, some of them raised.

    Places whose corner the instrument would see only at the edge of its field of view, or not at all, are drawn again.
    """
    ahead = T_world_lidar.rotation[:, 0]
    heading = np.arctan2(ahead[1], ahead[0])
    slots = np.linspace(-0.55, 0.55, count)[rng.permutation(count)]
    return np.stack([_draw_place(heading, slot, T_world_lidar, ground_m, target, table, rng) for slot in slots])


def _draw_place(
    heading: float,
    slot: float,
    T_world_lidar: Pose,
    ground_m: float,
    target: Target,
    table: BeamTable,
    rng: np.random.Generator,
) -> FloatArray:
    sine = table.directions[:, 2]
    lowest, highest = np.arcsin(sine.min()) + 0.03, np.arcsin(sine.max()) - 0.03
    centre = T_world_lidar.translation
    # The faces' middles, half a face away from the corner, have to be seen as well.
    outward = 1.0 if target.kind == "concave" else -1.0
    edges = outward * np.linalg.inv(unit(target.face_normals)).T * 0.25
    around = np.vstack([np.zeros(3), edges])
    for attempt in range(2000):
        turn, distance = heading + slot * rng.uniform(0.4, 1.1), rng.uniform(1.4, 2.6 + attempt / 1000.0)
        height = ground_m + target.bottom_m + float(rng.choice([0.0, 0.0, 0.15, 0.3]))
        corner = np.array([centre[0] + distance * np.cos(turn), centre[1] + distance * np.sin(turn), height])
        seen = T_world_lidar.inverse() @ (corner + around)
        elevation = np.arcsin(seen[:, 2] / np.linalg.norm(seen, axis=1))
        looks = ((centre - corner) @ target.face_normals.T) / np.linalg.norm(centre - corner)
        if elevation.min() > lowest and elevation.max() < highest and looks.min() > 0.15:
            return corner
    raise InputError(
        "--lidar",
        "the instrument sees the whole target from no place near 2 m",
        expected="a field of view that holds the target",
        remedy="Choose another instrument, pose or target.",
    )


def _surroundings(
    spec: CornerSceneSpec, centre: FloatArray, ground_m: float, corners: FloatArray, rng: np.random.Generator
) -> list[ConvexSolid]:
    solids = [upright_box([centre[0], centre[1], ground_m - 0.5], [60.0, 60.0, 1.0], 0.0)]
    if spec.room:
        yaw = rng.uniform(0.0, np.pi / 2.0)
        axes = rotation_z(yaw)[:, :2]
        reach = rng.uniform(4.0, 6.0, 4)
        for k, (sign, axis) in enumerate([(1, 0), (-1, 0), (1, 1), (-1, 1)]):
            middle = centre + sign * (reach[k] + 0.1) * axes[:, axis]
            wall = [0.2, 14.0, 8.0] if axis == 0 else [14.0, 0.2, 8.0]
            solids.append(upright_box([middle[0], middle[1], ground_m + 1.2], wall, yaw))
        solids.append(upright_box([centre[0], centre[1], ground_m + 3.1], [16.0, 16.0, 0.2], yaw))
    while len(solids) < 1 + 5 * spec.room + spec.clutter:
        size = rng.uniform(0.2, 0.9, 3)
        azimuth, distance = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(1.6, 4.5)
        spot = centre[:2] + distance * np.array([np.cos(azimuth), np.sin(azimuth)])
        if _hides_target(spot, float(np.hypot(size[0], size[1])) / 2.0, centre[:2], corners[:, :2]):
            continue
        solids.append(upright_box([spot[0], spot[1], ground_m + size[2] / 2.0], size, rng.uniform(0.0, np.pi / 2.0)))
    return solids


def _hides_target(spot: FloatArray, radius: float, centre: FloatArray, corners: FloatArray) -> bool:
    for corner in corners:
        if np.linalg.norm(spot - corner) < radius + 0.75:
            return True
        ray = corner - centre
        along = np.clip((spot - centre) @ ray / (ray @ ray), 0.0, 1.0)
        if np.linalg.norm(centre + along * ray - spot) < radius + 0.45:
            return True
    return False


def _stand(corner: FloatArray, target: Target, ground_m: float) -> list[ConvexSolid]:
    height = corner[2] - target.bottom_m - ground_m
    if height < 0.02:
        return []
    away = -np.mean(target.face_normals, axis=0)[:2] * (1.0 if target.kind != "concave" else -1.0)
    foot = corner[:2] + 0.25 * away / np.linalg.norm(away)
    return [upright_box([foot[0], foot[1], ground_m + height / 2.0 - 0.005], [0.12, 0.12, height - 0.01], 0.3)]


def simulate_corner_session(spec: CornerSceneSpec) -> tuple[CornerSession, CornerTruth]:
    """A corner session in memory, with the truth. Equal specifications give equal sessions.

    Raises
    ------
    ValueError
        If the pose or the instrument is not known by that name.
    """
    rng = np.random.default_rng(spec.seed)
    T_world_lidar, kind, ground_m = _resolve(spec)
    ahead = T_world_lidar.rotation[:, 0]
    target = make_target(kind, spec.size_m, float(np.arctan2(ahead[1], ahead[0])) + np.pi, rng)
    table = replace(INSTRUMENTS[spec.lidar](), crossing_m=spec.beam_crossing_m)
    corners = corner_places(spec.places, T_world_lidar, ground_m, target, table, rng)
    surroundings = _surroundings(spec, T_world_lidar.translation, ground_m, corners, rng)
    to_source = _to_source(spec) @ T_world_lidar.inverse()
    places = []
    for i, corner in enumerate(corners):
        here = _turned(target, np.radians(spec.turned_deg)) if i == spec.turned_place else target
        solids = [_moved(s, corner) for s in here.solids] + _stand(corner, here, ground_m) + surroundings
        cast = cast_scene(table, solids, T_world_lidar, rng)
        clouds = tuple(_cloud(cast, spec, f"clouds/p{i:02d}/{k:03d}.pcd", rng) for k in range(spec.frames))
        measured = corner + rng.normal(0.0, 1.0, 3) * spec.world_sigma_m
        near = to_source @ corner + rng.uniform(-0.1, 0.1, 3) if spec.hints else None
        places.append(CornerPlace(f"p{i:02d}", measured, clouds, near))
    session = CornerSession(
        "simulated",
        tuple(places),
        world_sigma_m=spec.world_sigma_m or None,
        cloud_frame="camera" if spec.lidar == "turntable" else "lidar",
        lidar=LidarSpec(spec.lidar, spec.defects.range_sigma_m),
    )
    normals = to_source.rotate(target.face_normals)
    return session, CornerTruth(to_source.inverse(), np.asarray(to_source @ corners), corners, normals)


def _resolve(spec: CornerSceneSpec) -> tuple[Pose, TargetKind, float]:
    if spec.lidar not in INSTRUMENTS:
        raise ValueError(f"no instrument {spec.lidar!r}; known are {', '.join(INSTRUMENTS)}")
    kind: TargetKind = "cube"
    if isinstance(spec.pose, Pose):
        pose, ground_m = spec.pose, 0.0
    elif spec.pose in PAPER_POSES:
        pose, kind, ground_m = PAPER_POSES[spec.pose]
    else:
        raise ValueError(f"no pose {spec.pose!r}; known are {', '.join(PAPER_POSES)}")
    return pose, spec.target or kind, ground_m if spec.ground_m is None else spec.ground_m


def _cloud(cast: CastScene, spec: CornerSceneSpec, name: str, rng: np.random.Generator) -> MemoryCloud:
    points = _to_source(spec).rotate(cast.frame(spec.defects, rng))
    frame = "camera" if spec.lidar == "turntable" else "lidar"
    return MemoryCloud(name, Cloud(points.astype(np.float32), frame=frame))


def _to_source(spec: CornerSceneSpec) -> Pose:
    """From the instrument's frame (x forward, z up) to that of the clouds: a camera's is optical."""
    if spec.lidar != "turntable":
        return Pose.identity()
    return Pose(np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.zeros(3))
