"""The laser's plane and its two stripes in the camera frame (turntable paper, section 1.3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray, angle_between, cross3
from lidarpose.geometry.planes import Plane, fit_plane, intersect_three_planes
from lidarpose.geometry.robust import MAD_TO_SIGMA, median, row_medians, tukey_weights
from lidarpose.geometry.se3 import Pose
from lidarpose.model.camera import Camera
from lidarpose.model.observation import StripePoints

HYPOTHESES = 80
# Points at which hypotheses are scored; the fit itself uses all of them.
SCORED_POINTS = 200
# A light plane that turns by less than this from one step to the next has been found.
SETTLED_RAD = 1e-7
# Planes whose normals span this much are surely not parallel.
_SURELY_APART = 0.02


@dataclass(frozen=True, eq=False)
class StripeOnPanel:
    """A stripe's points where the panel's plane holds them.

    Attributes
    ----------
    points_camera : (N, 3)
    spread_camera : (N, 3)
        How far each point moves for one standard deviation of its pixel.
    rays_camera : (N, 3)
        Directions through the pixels, z = 1.
    """

    points_camera: FloatArray
    spread_camera: FloatArray
    rays_camera: FloatArray


@dataclass(frozen=True, eq=False)
class LightPlane:
    """The light plane, and how well it is known.

    Attributes
    ----------
    plane
        In the camera frame; the sign of its normal is arbitrary.
    covariance : (3, 3)
        Of (turn about `u`, turn about `v`, offset), see `basis`; about `pivot`.
    basis : (2, 3)
        Unit vectors u, v in the plane: a small change turns the normal by ``a * u + b * v``.
    pivot : (3,)
        The weighted middle of the points: the offset's change is that of the distance there.
    weights
        By stripe, the weight (N,) of each point, 1/m^2; zero for those that do not support the plane.
    rms_m
        Root mean square distance of the inliers.
    """

    plane: Plane
    covariance: FloatArray
    basis: FloatArray
    pivot: FloatArray
    weights: tuple[FloatArray, ...]
    rms_m: float


@dataclass(frozen=True, eq=False)
class StripePair:
    """The two stripes as lines that leave their common point E.

    Attributes
    ----------
    light_plane
    E_camera : (3,)
        Common point of both panels' planes and the light plane; may lie beyond both stripes.
    directions_camera : (2, 3)
        Unit directions from E towards each stripe.
    alpha_rad
        The angle between them, in (0, pi).
    extents_m : (2, 2)
        Nearest and farthest inlier of each stripe, as distances from E.
    """

    light_plane: LightPlane
    E_camera: FloatArray
    directions_camera: FloatArray
    alpha_rad: float
    extents_m: FloatArray


def stripe_on_panel(camera: Camera, T_camera_panel: Pose, stripe: StripePoints) -> StripeOnPanel:
    """Points of the panel's plane under the stripe's pixels (eqs. (1) to (3)).

    Pixels that have no ray, or whose ray meets the plane behind the camera, are dropped.
    """
    return stripes_on_panel(camera, T_camera_panel, [stripe])[0]


def stripes_on_panel(camera: Camera, T_camera_panel: Pose, stripes: Sequence[StripePoints]) -> list[StripeOnPanel]:
    """The same for several stripes, one or more, on one panel: as fast as for one."""
    plane = Plane.from_pose(T_camera_panel)
    rays = camera.rays(np.concatenate([s.pixels for s in stripes]))
    points = plane.intersect_rays(rays)
    # How far the point must move on the panel for its pixel to move by one sigma across the stripe.
    on_panel = T_camera_panel.rotation[:, :2]
    J = camera.project_with_jacobian(points)[1] @ on_panel
    det = J[:, 0, 0] * J[:, 1, 1] - J[:, 0, 1] * J[:, 1, 0]
    sigma_px = np.concatenate([s.sigma_px for s in stripes])
    n = np.concatenate([s.normals for s in stripes]) * (sigma_px / np.where(det == 0.0, np.nan, det))[:, None]
    x = J[:, 1, 1] * n[:, 0] - J[:, 0, 1] * n[:, 1]
    y = J[:, 0, 0] * n[:, 1] - J[:, 1, 0] * n[:, 0]
    spread = np.column_stack([x, y]) @ on_panel.T
    usable = np.isfinite(points).all(axis=1) & np.isfinite(spread).all(axis=1) & (points[:, 2] > 0.0)
    found = []
    last = 0
    for stripe in stripes:
        first, last = last, last + len(stripe)
        use = first + np.flatnonzero(usable[first:last])
        found.append(StripeOnPanel(points[use], spread[use], rays[use]))
    return found


def fit_light_plane(stripes: Sequence[StripeOnPanel], *, seed: int = 0) -> LightPlane:
    """Robust, weighted plane through stripes on two or more differently placed panels; (4) without its singularity.

    Each point weighs by how far a standard deviation of its pixel moves it across the plane. A least median over
    random samples starts Tukey's biweight, so that up to a third of the points may be wrong.

    Raises
    ------
    ValueError
        If there are too few points, or they determine no plane (all on one line).
    """
    found = fit_light_planes([stripes], seed=seed)[0]
    if isinstance(found, ValueError):
        raise found
    return found


def fit_light_planes(places: Sequence[Sequence[StripeOnPanel]], *, seed: int = 0) -> list[LightPlane | ValueError]:
    """The same for the stripes of many places at once, in a fraction of the time; or why a place has none."""
    if not places:
        return []
    table = _Table.of(places)
    normal, offset, problems = _starts(places, table, seed)
    found: dict[int, LightPlane | ValueError] = dict(problems)
    start = np.array([k for k in range(len(places)) if k not in problems], dtype=np.intp)
    if len(start):
        settled = _settled(table.take(start), normal[start], offset[start], [places[k] for k in start])
        found.update(zip(start.tolist(), settled, strict=True))
    return [found[k] for k in range(len(places))]


@dataclass(frozen=True, eq=False)
class _Table:
    """Points (P, N, 3) of all stripes of each place, one after the other, how far they move for a standard deviation
    of their pixel (P, N, 3), the least that counts of that (P, N), and where there are any (P, N)."""

    points: FloatArray
    spread: FloatArray
    floor: FloatArray
    there: BoolArray

    @staticmethod
    def of(places: Sequence[Sequence[StripeOnPanel]]) -> _Table:
        points, there = _padded([[s.points_camera for s in stripes] for stripes in places])
        spread, _ = _padded([[s.spread_camera for s in stripes] for stripes in places])
        # A point whose pixel moves it along the plane would weigh without bound.
        return _Table(points, spread, np.maximum(0.05 * np.linalg.norm(spread, axis=2), 1e-12), there)

    def take(self, which: IntArray) -> _Table:
        if len(which) == len(self.points):
            return self
        return _Table(self.points[which], self.spread[which], self.floor[which], self.there[which])

    def sigma(self, normal: FloatArray) -> FloatArray:
        """Standard deviations (P, N) of the points across planes with these normals (P, 3)."""
        return np.asarray(np.maximum(np.abs(_along(self.spread, normal)), self.floor))


def _starts(
    places: Sequence[Sequence[StripeOnPanel]], table: _Table, seed: int
) -> tuple[FloatArray, FloatArray, dict[int, ValueError]]:
    """Normals (P, 3) and offsets (P,): the plain fit where nothing contradicts it, else the plane of least median; and
    by place why there is none."""
    normal, offset = _weighted_planes(table.points, table.there.astype(np.float64))
    with np.errstate(invalid="ignore"):
        near = np.abs(_along(table.points, normal) - offset[:, None]) < 4.0 * table.sigma(normal)
    few = np.count_nonzero(table.there, axis=1) < 4
    problems = {
        k: ValueError("a light plane needs at least four points of its stripes") for k in np.flatnonzero(few).tolist()
    }
    for k in np.flatnonzero(~few & ~(near | ~table.there).all(axis=1)).tolist():
        groups: IntArray = np.repeat(np.arange(len(places[k])), [len(s.points_camera) for s in places[k]])
        there = table.there[k]
        try:
            plane = _least_median_plane(table.points[k, there], table.spread[k, there], groups, seed)
        except ValueError as reason:
            problems[k] = reason
        else:
            normal[k], offset[k] = plane.normal, plane.offset
    return normal, offset, problems


def _settled(
    table: _Table, normal: FloatArray, offset: FloatArray, places: Sequence[Sequence[StripeOnPanel]]
) -> list[LightPlane | ValueError]:
    """Light planes from their starts, by steps that each takes until it has settled: twenty at most."""
    points = table.points
    weight = table.there.astype(np.float64)
    active = np.arange(len(places))
    for _ in range(20):
        part, n = table.take(active), normal[active]
        x = part.points
        sigma = part.sigma(n)
        standardised = (_along(x, n) - offset[active, None]) / sigma
        scale = MAD_TO_SIGMA * row_medians(np.abs(standardised), part.there)
        weight[active] = tukey_weights(standardised / np.maximum(scale, 1.0)[:, None]) * part.there
        normal[active], offset[active] = _weighted_planes(x, weight[active] / sigma**2)
        turned = np.cross(normal[active], n)
        # A hundredth of what the best stripes can tell. (A plane that is lost, NaN, has nothing to settle.)
        active = active[(turned * turned).sum(axis=1) >= SETTLED_RAD**2]
        if len(active) == 0:
            break
    return _with_covariance(normal, offset, points, weight, weight / table.sigma(normal) ** 2, places)


def _padded(places: Sequence[Sequence[FloatArray]]) -> tuple[FloatArray, BoolArray]:
    """Points (P, N, 3) of all stripes of each place, one after the other, and where there are any (P, N)."""
    count = np.array([sum(len(points) for points in stripes) for stripes in places])
    there: BoolArray = np.arange(count.max()) < count[:, None]
    out = np.zeros((*there.shape, 3))
    out[there] = np.concatenate([points for stripes in places for points in stripes])
    return out, there


def _along(points: FloatArray, direction: FloatArray) -> FloatArray:
    """Components (P, N) of points (P, N, 3) along one direction (P, 3) a place."""
    return np.asarray((points @ direction[..., None])[..., 0])


def _weighted_planes(points: FloatArray, weight: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Normals (P, 3) and offsets (P,) of total least squares planes through points (P, N, 3); NaN where on one line."""
    total = weight.sum(axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = (weight[:, None, :] @ points)[:, 0] / total[:, None]
    usable = np.count_nonzero(weight > 0.0, axis=1) >= 3
    mean = np.where(usable[:, None], mean, 0.0)
    d = (points - mean[:, None]) * np.sqrt(weight)[..., None]
    values, vectors = np.linalg.eigh(np.swapaxes(d, 1, 2) @ d)
    usable &= values[:, 1] > 1e-14 * values[:, 2]
    normal = np.where(usable[:, None], vectors[:, :, 0], np.nan)
    return normal, (normal * mean).sum(axis=1)


def stripe_pair(
    panel_planes: tuple[Plane, Plane], stripes: tuple[StripeOnPanel, StripeOnPanel], light: LightPlane
) -> StripePair:
    """E, the two directions and alpha (end of section 1.3), from a stripe on each of two panels and the light plane.

    Raises
    ------
    ValueError
        If the panels are parallel (to a degree), or too few points of a stripe support the light plane.
    """
    if np.linalg.norm(cross3(panel_planes[0].normal, panel_planes[1].normal)) < np.sin(np.deg2rad(1.0)):
        raise ValueError("the two panels are parallel")
    E = intersect_three_planes((*panel_planes, light.plane))
    directions, extents = [], []
    for plane, stripe, weights in zip(panel_planes, stripes, light.weights, strict=True):
        inliers = weights > 0.0
        if np.count_nonzero(inliers) < 2:
            raise ValueError("a stripe has fewer than two good points")
        direction = light.plane.intersect_plane(plane).direction
        along = (stripe.points_camera[inliers] - E) @ direction
        sign = 1.0 if median(along) > 0.0 else -1.0
        directions.append(sign * direction)
        extents.append([(sign * along).min(), (sign * along).max()])
    return StripePair(
        light, E, np.array(directions), float(angle_between(directions[0], directions[1])), np.array(extents)
    )


def stripe_pairs(
    panel_planes: Sequence[tuple[Plane, Plane]],
    stripes: Sequence[tuple[StripeOnPanel, StripeOnPanel]],
    lights: Sequence[LightPlane],
) -> list[StripePair | ValueError]:
    """The same for many places at once, in a fraction of the time; or why a place has none."""
    found: list[StripePair | ValueError] = []
    if not lights:
        return found
    normals = np.array(
        [[p.normal, q.normal, light.plane.normal] for (p, q), light in zip(panel_planes, lights, strict=True)]
    )
    offsets = np.array(
        [[p.offset, q.offset, light.plane.offset] for (p, q), light in zip(panel_planes, lights, strict=True)]
    )
    there = [_padded([[s[key].points_camera] for s in stripes]) for key in (0, 1)]
    inliers = [np.zeros(mask.shape, dtype=bool) for _, mask in there]
    for key in (0, 1):
        inliers[key][there[key][1]] = np.concatenate([light.weights[key] for light in lights]) > 0.0
    # What is singular or lacks points is left to the way for single places, which says why.
    plain = np.linalg.svd(normals, compute_uv=False)[:, -1] > _SURELY_APART
    plain &= np.linalg.norm(np.cross(normals[:, 0], normals[:, 1]), axis=1) > _SURELY_APART
    for mask in inliers:
        plain &= np.count_nonzero(mask, axis=1) >= 2
    E = np.linalg.solve(np.where(plain[:, None, None], normals, np.eye(3)), offsets[..., None])[..., 0]
    directions = np.cross(normals[:, None, 2], normals[:, :2])
    directions /= np.maximum(np.linalg.norm(directions, axis=2), 1e-300)[..., None]
    extents = np.empty((len(lights), 2, 2))
    for key in (0, 1):
        along = _along(there[key][0] - E[:, None], directions[:, key])
        sign = np.where(row_medians(along, inliers[key]) > 0.0, 1.0, -1.0)
        directions[:, key] *= sign[:, None]
        along *= sign[:, None]
        extents[:, key, 0] = np.where(inliers[key], along, np.inf).min(axis=1)
        extents[:, key, 1] = np.where(inliers[key], along, -np.inf).max(axis=1)
    alpha = 2.0 * np.arctan2(*(np.linalg.norm(directions[:, 0] + s * directions[:, 1], axis=1) for s in (-1.0, 1.0)))
    for k, light in enumerate(lights):
        if plain[k]:
            found.append(StripePair(light, E[k], directions[k], float(alpha[k]), extents[k]))
            continue
        try:
            found.append(stripe_pair(panel_planes[k], stripes[k], light))
        except ValueError as reason:
            found.append(reason)
    return found


def _least_median_plane(points: FloatArray, spread: FloatArray, groups: IntArray, seed: int) -> Plane:
    rng = np.random.default_rng(seed)
    samples = _samples(rng, groups)
    a, b, c = points[samples[:, 0]], points[samples[:, 1]], points[samples[:, 2]]
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    reach = np.linalg.norm(b - a, axis=1) * np.linalg.norm(c - a, axis=1)
    good = length > 1e-3 * reach
    if not good.any():
        return fit_plane(points)
    normals, a = normals[good] / length[good, None], a[good]
    some = np.linspace(0, len(points) - 1, min(SCORED_POINTS, len(points))).astype(int)
    distance = np.abs(points[some] @ normals.T - (a * normals).sum(axis=1))
    sigma = np.maximum(np.abs(spread[some] @ normals.T), 0.05 * np.linalg.norm(spread[some], axis=1)[:, None])
    best = int(np.argmin(np.median(distance / np.maximum(sigma, 1e-12), axis=0)))
    return Plane(normals[best], float(normals[best] @ a[best]))


def _samples(rng: np.random.Generator, groups: IntArray) -> IntArray:
    """Samples (HYPOTHESES, 3): two points of one stripe and one of another, since one stripe determines no plane."""
    first = rng.integers(len(groups), size=HYPOTHESES)
    samples = np.column_stack([first, first, first])
    for group in np.unique(groups):
        of_group = groups[first] == group
        own, others = np.flatnonzero(groups == group), np.flatnonzero(groups != group)
        samples[of_group, 1] = rng.choice(own, of_group.sum())
        samples[of_group, 2] = rng.choice(others if len(others) else own, of_group.sum())
    return samples


def _with_covariance(
    normal: FloatArray,
    offset: FloatArray,
    points: FloatArray,
    weight: FloatArray,
    information: FloatArray,
    places: Sequence[Sequence[StripeOnPanel]],
) -> list[LightPlane | ValueError]:
    """Light planes with what is known of them; `information` (P, N) is the weight of each point, 1/m^2."""
    lost: BoolArray = np.asarray(~np.isfinite(normal).all(axis=1))
    normal, offset = np.where(lost[:, None], [0.0, 0.0, 1.0], normal), np.where(lost, 0.0, offset)
    pivot = (information[:, None, :] @ points)[:, 0] / np.maximum(information.sum(axis=1), 1e-300)[:, None]
    centred = points - pivot[:, None]
    # In the plane, along and across the points' own extent.
    axes = np.linalg.eigh(np.swapaxes(centred, 1, 2) @ (centred * information[..., None]))[1]
    longest = axes[:, :, 2]
    u = longest - (longest * normal).sum(axis=1)[:, None] * normal
    u = u / np.maximum(np.linalg.norm(u, axis=1), 1e-300)[:, None]
    basis = np.stack([u, np.cross(normal, u)], axis=1)
    rows = np.concatenate([centred @ np.swapaxes(basis, 1, 2), -np.ones((*weight.shape, 1))], axis=2)
    squares = (_along(points, normal) - offset[:, None]) ** 2
    chi2 = (information * squares).sum(axis=1)
    excess = np.maximum(1.0, chi2 / np.maximum(1.0, weight.sum(axis=1) - 3.0))
    covariance = np.linalg.pinv(np.swapaxes(rows, 1, 2) @ (rows * information[..., None])) * excess[:, None, None]
    inliers = weight > 0.0
    rms = np.sqrt((squares * inliers).sum(axis=1) / np.maximum(np.count_nonzero(inliers, axis=1), 1))
    found: list[LightPlane | ValueError] = []
    for p, stripes in enumerate(places):
        if lost[p]:
            found.append(ValueError("points on one line determine no plane"))
            continue
        ends = np.cumsum([len(s.points_camera) for s in stripes]).tolist()
        weights = tuple(information[p, a:b] for a, b in zip([0, *ends[:-1]], ends, strict=True))
        plane = Plane(normal[p], float(offset[p]))
        found.append(LightPlane(plane, covariance[p], basis[p], pivot[p], weights, float(rms[p])))
    return found
