"""The pose from corners known in both frames: the corner paper's closed forms (sections 2.2 and 2.3).

The paper's slips are set right: all three rows of eq. (7) for every pair of places, in least squares, in place of three
rows of two pairs; and half a turn, where Cayley's form is singular, goes through a helping turn.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike

from lidarpose.geometry.arrays import FloatArray
from lidarpose.geometry.se3 import Pose, exp_so3, nearest_rotation


def cayley_rotation(a: float, b: float, c: float) -> FloatArray:
    """R_0 = (I + S)(I - S)^-1 with S of the paper's three numbers, eqs. (3) and (4)."""
    S = np.array([[0.0, -c, -b], [c, 0.0, -a], [b, a, 0.0]])
    return np.asarray(np.linalg.solve((np.eye(3) - S).T, (np.eye(3) + S).T).T)


def pair_scale(world: ArrayLike, lidar: ArrayLike) -> float:
    """The factor of eq. (2), the ratio of the corners' distances in both frames, over all pairs of places (P, 3)."""
    pairs = list(combinations(range(len(np.asarray(world))), 2))
    a = np.array([np.linalg.norm(np.asarray(world)[i] - np.asarray(world)[j]) for i, j in pairs])
    b = np.array([np.linalg.norm(np.asarray(lidar)[i] - np.asarray(lidar)[j]) for i, j in pairs])
    return float(a @ b / (b @ b))


def _cayley_parameters(world: FloatArray, lidar: FloatArray) -> FloatArray:
    """Least squares of eq. (7) over all pairs: the three numbers (a, b, c), and how well they are determined."""
    rows, right = [], []
    for i, j in combinations(range(len(world)), 2):
        X, Y, Z = (world[i] - world[j]) + (lidar[i] - lidar[j])
        rows.append([[0.0, -Z, -Y], [-Z, 0.0, X], [Y, X, 0.0]])
        right.append((world[i] - world[j]) - (lidar[i] - lidar[j]))
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return np.asarray(solution)


# Turns that bring any rotation away from half a turn: none, and half a turn about each axis. Of a rotation and its
# products with these, at least one is a turn of at most 120 degrees.
_HELPING_TURNS = (np.eye(3), *(exp_so3(np.pi * axis) for axis in np.eye(3)))


def cayley_pose(world: ArrayLike, lidar: ArrayLike, *, iterations: int = 0, scale: float = 1.0) -> Pose:
    """T_world_lidar by Cayley's form: the paper's approximate solution (section 2.2).

    Parameters
    ----------
    world, lidar : (P, 3)
        The corners in both frames, P >= 3, metres.
    iterations
        How often to apply it again to the corners already turned (section 2.3).
    scale
        The factor lambda of eq. (1).

    The solution for each helping turn is formed, and the one that fits best is kept.
    """
    w, p = np.asarray(world, dtype=np.float64), scale * np.asarray(lidar, dtype=np.float64)
    centred_w, centred_p = w - w.mean(axis=0), p - p.mean(axis=0)
    best: FloatArray = np.eye(3)
    best_cost = np.inf
    for turn in _HELPING_TURNS:
        R: FloatArray = np.asarray(turn)
        for _ in range(iterations + 1):
            a, b, c = _cayley_parameters(w, p @ R.T)
            R = nearest_rotation(cayley_rotation(a, b, c) @ R)
        cost = float(((centred_w - centred_p @ R.T) ** 2).sum())
        if cost < best_cost:
            best, best_cost = R, cost
    return Pose(best, w.mean(axis=0) - best @ p.mean(axis=0))


def svd_pose(world: ArrayLike, lidar: ArrayLike, *, weights: ArrayLike | None = None, scale: float = 1.0) -> Pose:
    """T_world_lidar by singular values, eqs. (9) to (14), guarded against a reflection.

    Parameters
    ----------
    world, lidar : (P, 3)
        The corners in both frames, P >= 3, metres.
    weights : (P,)
        Of the places; equal by default.
    """
    w, p = np.asarray(world, dtype=np.float64), scale * np.asarray(lidar, dtype=np.float64)
    share = np.ones(len(w)) if weights is None else np.asarray(weights, dtype=np.float64)
    share = share / share.sum()
    mean_w, mean_p = share @ w, share @ p
    R = nearest_rotation(((w - mean_w) * share[:, None]).T @ (p - mean_p))
    return Pose(R, mean_w - R @ mean_p)
