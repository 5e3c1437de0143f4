"""The corner paper's methods: a corner for each frame, a mean for each place, a closed form for the pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from lidarpose.detect.paper_corners import harris_corner, ransac_corner
from lidarpose.errors import UndeterminedError
from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.robust import box_plot_inliers
from lidarpose.geometry.se3 import Pose
from lidarpose.model.calibration import WorldCalibration
from lidarpose.model.corner_result import CornerCandidate
from lidarpose.model.corner_session import CornerSession
from lidarpose.model.observation import LeftOut
from lidarpose.model.world_run import WorldRun
from lidarpose.refine.corner_verdict import CornerEvidence, PrecisionLimits, cornerwise_covariance, judge_corners
from lidarpose.solve.corner_alignment import cayley_pose, pair_scale, svd_pose
from lidarpose.workflows.corner_target import FoundTarget, PlaceCrop
from lidarpose.workflows.world_evidence import corners_run, provenance

MIN_FRAMES_FOR_BOX_PLOT = 5


@dataclass(frozen=True, eq=False)
class _PlaceMean:
    position: str
    corner: FloatArray
    scatter: FloatArray
    frames: int


def cornerwise(
    session: CornerSession,
    found: FoundTarget,
    crops: Sequence[PlaceCrop],
    method: str,
    scale_too: bool,
    limits: PrecisionLimits,
    seed: int,
) -> WorldRun:
    means: list[_PlaceMean] = []
    world = []
    left_out = []
    for place, sighting, crop, w in zip(session.places, found.sightings, crops, found.world, strict=True):
        mean = None if sighting is None else _mean_corner(place.position, sighting, crop, method, seed)
        if mean is None:
            left_out.append(LeftOut(place.position, "no frame gave a corner"))
            continue
        means.append(mean)
        world.append(w)
    if len(means) < 3:
        raise UndeterminedError(
            f"the method {method} finds the corner at {len(means)} places; at least three are needed",
            remedy="Use the method joint, or bring the target nearer.",
        )
    w, p = np.stack(world), np.stack([m.corner for m in means])
    scale = pair_scale(w, p) if scale_too else 1.0
    pose = _closed_form(method, w, p, scale)
    covariance = cornerwise_covariance(pose, w, scale * p, np.stack([m.scatter / np.sqrt(m.frames) for m in means]))
    evidence = CornerEvidence(
        tuple(m.position for m in means),
        tuple(left_out),
        found.oddity,
        session.world_sigma_m,
        session.lidar.range_sigma_m,
        session.cloud_frame,
        {m.position: m.scatter for m in means},
        doubt=found.doubt,
    )
    quality = judge_corners(pose, w, scale * p, covariance, evidence, limits)
    calibration = WorldCalibration(
        pose, session.cloud_frame, scale, covariance, quality=quality, provenance=provenance(session, method)
    )
    corners = {m.position: (place, m.corner) for m, place in zip(means, w, strict=True)}
    return corners_run(session, calibration, method, corners)


def _closed_form(method: str, world: FloatArray, lidar: FloatArray, scale: float) -> Pose:
    if method == "paper":
        approximate = cayley_pose(world, lidar, iterations=3, scale=scale)
        turned = approximate @ (scale * lidar)
        return svd_pose(world, turned) @ approximate
    return cayley_pose(world, lidar, scale=scale)


def _mean_corner(
    position: str, sighting: CornerCandidate, crop: PlaceCrop, method: str, seed: int
) -> _PlaceMean | None:
    """The corner of each frame, those outside the box plot left out, and the mean (section 3.1)."""
    by_frame = []
    for k in range(crop.frames):
        points = crop.points[crop.frame == k]
        if method == "harris":
            corner = harris_corner(points, sighting.corner)
        else:
            corner = ransac_corner(points, sighting, seed=seed + k, screening=method != "ransac")
        if corner is not None:
            by_frame.append(corner)
        if method in ("ransac", "harris") and corner is not None:
            break
    if not by_frame:
        return None
    corners = np.stack(by_frame)
    if len(corners) >= MIN_FRAMES_FOR_BOX_PLOT:
        corners = corners[np.all([box_plot_inliers(corners[:, k]) for k in range(3)], axis=0)]
    scatter = corners.std(axis=0, ddof=1) if len(corners) > 2 else np.full(3, 0.005)
    return _PlaceMean(position, corners.mean(axis=0), scatter, len(corners))
