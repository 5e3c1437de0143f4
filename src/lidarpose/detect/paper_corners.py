"""The corner paper's ways to a frame's corner, and its rival: RANSAC planes with or without the second screening
(section 2.1), and the 3D Harris detector."""

from __future__ import annotations

import numpy as np

from lidarpose.detect.trihedral_corner import FaceMask
from lidarpose.geometry.arrays import FloatArray, perpendicular_pair, unit
from lidarpose.geometry.planes import Plane, fit_plane, intersect_three_planes
from lidarpose.geometry.robust import mad_sigma
from lidarpose.model.corner_result import CornerCandidate

# Section 3.1: "points farther than 0.01 m from the plane do not belong to it".
THRESHOLD_M = 0.01
SAMPLES = 300
CLEARANCE = 2.5
REFITS = 4
GROUND_CLEARANCE_M = 0.04
MIN_POINTS = 12
SCREENING_RAD = np.radians(20.0)
SCREENING_NEIGHBOURS = 24
FACE_TILT_RAD = np.radians(5.0)
# The fit along the beams: first gate in thresholds, Tukey's loss, and the slope at which a face is no longer seen.
WIDE_GATE = 4.0
TUKEY_K = 6.0
ML_STEPS = 6
INNER_SHARE = 0.93
LINED_UP = 0.05
LEAST_SLOPE = 0.05
HARRIS_RADIUS_M = 0.1
HARRIS_K = 0.04


def ransac_corner(points: FloatArray, sighting: CornerCandidate, *, seed: int, screening: bool) -> FloatArray | None:
    """The common point (3,) of three planes that RANSAC finds one after the other around a sighted corner.

    Parameters
    ----------
    points : (N, 3)
        One frame around the target.
    sighting
        Where the target is: the region of interest that the paper filters out first, and which plane is which.
    screening
        Whether to fit again to the points whose local normal agrees with the plane's.
    """
    reach = min(float(np.linalg.norm(o - sighting.corner, axis=1).max()) for o in sighting.outlines)
    region = points[np.linalg.norm(points - sighting.corner, axis=1) < min(reach, 0.6)]
    for ground in sighting.obstacles:
        region = region[ground.distance(region) > GROUND_CLEARANCE_M]
    rng = np.random.default_rng(seed)
    planes: list[Plane] = []
    remaining = region
    for _ in range(3):
        if len(remaining) < MIN_POINTS:
            return None
        inside = _best_sample(remaining, rng)
        if inside.sum() < MIN_POINTS:
            return None
        chosen = _screened(remaining[inside]) if screening else remaining[inside]
        if len(chosen) < MIN_POINTS:
            return None
        try:
            planes.append(fit_plane(chosen))
        except ValueError:
            return None
        # What the noise put just outside the slab is still of this plane, and no second one.
        remaining = remaining[np.abs(planes[-1].distance(remaining)) > CLEARANCE * THRESHOLD_M]
    if screening:
        planes = _apart(region, planes)
        if not _are_the_faces(planes, sighting):
            return None
        fitted = _fitted_along_beams(points, planes, sighting)
        if fitted is None:
            return None
        planes = fitted
    try:
        corner = intersect_three_planes((planes[0], planes[1], planes[2]))
    except ValueError:
        return None
    return corner if np.linalg.norm(corner - sighting.corner) < 0.3 else None


def _apart(points: FloatArray, planes: list[Plane]) -> list[Plane]:
    """The planes fitted again without the points next to an edge, which are within the threshold of two of them."""
    for _ in range(REFITS):
        distance = np.abs(np.stack([plane.distance(points) for plane in planes]))
        fitted = []
        for k, plane in enumerate(planes):
            others = np.delete(distance, k, axis=0).min(axis=0)
            chosen = (distance[k] < THRESHOLD_M) & (others > CLEARANCE * THRESHOLD_M)
            fitted.append(_refitted(points[chosen], plane))
        planes = fitted
    return planes


def _fitted_along_beams(points: FloatArray, planes: list[Plane], sighting: CornerCandidate) -> list[Plane] | None:
    """The planes fitted to all beams that meet their faces, off the edges, told by the beams' directions alone.

    None where a face's beams lie along one scan line: they determine no plane.
    """
    range_m = np.linalg.norm(points, axis=1)
    directions = points / range_m[:, None]
    cosine = np.stack([p.normal for p in planes]) @ sighting.normals.T
    order = [int(np.argmax(np.abs(cosine[:, j]))) for j in range(3)]
    faces = [planes[k] if cosine[k, j] > 0.0 else planes[k].flipped() for j, k in enumerate(order)]
    margin_m = 0.005 + 0.0015 * float(np.linalg.norm(sighting.corner))
    for _ in range(2):
        try:
            corner = intersect_three_planes((faces[0], faces[1], faces[2]))
        except ValueError:
            return None
        a, b, c = (corner + INNER_SHARE * (o - sighting.corner) for o in sighting.outlines)
        normals = np.stack([face.normal for face in faces])
        mask = FaceMask(corner, normals, sighting.convex, (a, b, c), sighting.obstacles, margin_m)
        index, met = mask.select(directions, range_m, WIDE_GATE * THRESHOLD_M)
        beams = [index[met == j] for j in range(3)]
        if not all(_spread_both_ways(directions[b]) for b in beams):
            return None
        faces = [_along_beams(directions[b], range_m[b], f) for b, f in zip(beams, faces, strict=True)]
    return faces


def _spread_both_ways(directions: FloatArray) -> bool:
    if len(directions) < MIN_POINTS:
        return False
    across = directions @ np.column_stack(perpendicular_pair(unit(directions.mean(axis=0))))
    spread = np.linalg.svd(across - across.mean(axis=0), compute_uv=False)
    return bool(spread[1] > LINED_UP * spread[0])


def _along_beams(directions: FloatArray, range_m: FloatArray, plane: Plane) -> Plane:
    """The maximum-likelihood plane for noise along the beam, robust, by Gauss-Newton steps.

    A threshold little wider than the noise keeps a plane where it started: as it moves, points leave on one side and
    come in on the other. A redescending loss at several sigmas does not.
    """
    gate_m = WIDE_GATE * THRESHOLD_M
    for _ in range(ML_STEPS):
        slope = directions @ plane.normal
        if np.abs(slope).min() < LEAST_SLOPE:
            return plane
        expected = plane.offset / slope
        residual = range_m - expected
        gate_m = min(gate_m, max(TUKEY_K * mad_sigma(residual, centred=True), 1e-4))
        moved = _step(plane, directions, expected, slope, residual, gate_m)
        if moved is None:
            return plane
        plane = moved
    return plane


def _step(
    plane: Plane, directions: FloatArray, expected: FloatArray, slope: FloatArray, residual: FloatArray, gate_m: float
) -> Plane | None:
    """The plane after one weighted step of its shift and two tilts about the points' middle; None if undetermined."""
    weight = (1.0 - np.minimum((residual / gate_m) ** 2, 1.0)) ** 2
    middle = (directions * expected[:, None]).mean(axis=0)
    across = np.column_stack(perpendicular_pair(plane.normal))
    rows = np.empty((len(slope), 3))
    rows[:, 0] = 1.0 / slope
    rows[:, 1:] = ((middle @ across) - expected[:, None] * (directions @ across)) / slope[:, None]
    try:
        shift, *tilts = np.linalg.solve((rows * weight[:, None]).T @ rows, rows.T @ (weight * residual))
    except np.linalg.LinAlgError:
        return None
    normal = plane.normal + across @ np.asarray(tilts)
    return Plane(normal, float(normal @ middle) + shift)


def _are_the_faces(planes: list[Plane], sighting: CornerCandidate) -> bool:
    """Whether the planes are the sighted faces, each once: a small face loses to what is left of the large ones."""
    cosine = np.abs(np.stack([p.normal for p in planes]) @ sighting.normals.T)
    best = np.argmax(cosine, axis=1)
    return len(set(best.tolist())) == 3 and bool((cosine.max(axis=1) > np.cos(FACE_TILT_RAD)).all())


def _refitted(points: FloatArray, plane: Plane) -> Plane:
    if len(points) < MIN_POINTS:
        return plane
    try:
        return fit_plane(points)
    except ValueError:
        return plane


def _best_sample(points: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Inliers (N,) of the plane through three points that has most of them."""
    triples = rng.integers(0, len(points), (SAMPLES, 3))
    a, b, c = (points[triples[:, k]] for k in range(3))
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    good = length > 1e-6
    normals = normals[good] / length[good, None]
    distance = points @ normals.T - np.einsum("ij,ij->i", normals, a[good])
    inside = np.abs(distance) < THRESHOLD_M
    return np.asarray(inside[:, int(np.argmax(inside.sum(axis=0)))])


def _screened(points: FloatArray) -> FloatArray:
    """The second screening: points whose neighbourhood's normal is within a threshold of the plane's."""
    from scipy.spatial import cKDTree

    k = min(SCREENING_NEIGHBOURS, len(points))
    _, neighbours = cKDTree(points).query(points, k=k)
    around = points[neighbours]
    d = around - around.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(np.einsum("nki,nkj->nij", d, d))
    agrees = np.abs(vectors[:, :, 0] @ fit_plane(points).normal) > np.cos(SCREENING_RAD)
    # Neighbours on one scan line have no normal to judge by.
    lined_up = values[:, 1] < 0.05 * values[:, 2]
    return np.asarray(points[agrees | lined_up])


def harris_corner(points: FloatArray, near: FloatArray) -> FloatArray | None:
    """The point (3,) with the strongest 3D Harris response within 0.3 m of `near`.

    The response is ``det(M) - k trace(M)^2`` of the scatter M of the normals around a point (corner paper, 3.1).
    """
    from scipy.spatial import cKDTree

    if len(points) < MIN_POINTS:
        return None
    tree = cKDTree(points)
    _, neighbours = tree.query(points, k=min(SCREENING_NEIGHBOURS, len(points)))
    around = points[neighbours]
    d = around - around.mean(axis=1, keepdims=True)
    normals = np.linalg.eigh(np.einsum("nki,nkj->nij", d, d))[1][:, :, 0]
    close = np.flatnonzero(np.linalg.norm(points - near, axis=1) < 0.3)
    best, strongest = None, -np.inf
    for k in close:
        ball = tree.query_ball_point(points[k], HARRIS_RADIUS_M)
        M = normals[ball].T @ normals[ball] / len(ball)
        response = float(np.linalg.det(M) - HARRIS_K * np.trace(M) ** 2)
        if response > strongest and len(ball) >= 8:
            best, strongest = points[k], response
    return best
