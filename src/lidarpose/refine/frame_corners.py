"""The corner of each frame by itself, and what all frames of a place say together, from one pass over its returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from lidarpose.geometry.arrays import BoolArray, FloatArray, IntArray
from lidarpose.model.corner_result import FaceReturns
from lidarpose.refine.face_systems import FaceSums, FaceSystem, face_sums, tangents

# Fewer returns of a face in a frame make no plane.
FEWEST = 6


@dataclass(frozen=True, eq=False)
class FaceFrames:
    """One face at one place, collapsed frame by frame.

    Attributes
    ----------
    frame, count : (S,)
        The frames that have any returns, and how many each has.
    sums
        Their systems.
    """

    frame: IntArray
    count: IntArray
    sums: FaceSums

    def system(self, good: BoolArray) -> FaceSystem:
        """Of those frames (F,) that are good, together."""
        kept = good[self.frame]
        return FaceSystem(self.sums.information[kept].sum(axis=0), self.sums.gradient[kept].sum(axis=0))


@dataclass(frozen=True, eq=False)
class PlaceFrames:
    """The faces at one place, collapsed frame by frame about common planes.

    Attributes
    ----------
    normals, corner : (3, 3), (3,)
        The planes.
    sigma_m
        The ranges' noise.
    frames
        How many there are.
    """

    faces: Mapping[int, FaceFrames]
    normals: FloatArray
    corner: FloatArray
    sigma_m: float
    frames: int

    @staticmethod
    def of(
        faces: Mapping[int, FaceReturns], normals: FloatArray, corner: FloatArray, frames: int, sigma_m: float
    ) -> PlaceFrames:
        """From the faces' returns, which come frame by frame."""
        found = {}
        for j, returns in faces.items():
            first = np.flatnonzero(np.diff(returns.frame, prepend=-1))
            sums = face_sums(returns, normals[j], corner, sigma_m, first)
            found[j] = FaceFrames(returns.frame[first], np.diff(first, append=len(returns)), sums)
        return PlaceFrames(found, normals, corner, sigma_m, frames)

    @property
    def returns(self) -> IntArray:
        """How many returns each frame (F,) has on the faces."""
        total = np.zeros(self.frames, dtype=np.int64)
        for face in self.faces.values():
            total[face.frame] += face.count
        return total

    def corners(self) -> FloatArray:
        """The corner (F, 3) of each frame alone, three free planes each; NaN where a frame's returns determine none.

        One step from the common planes, of which a frame differs by its noise alone.
        """
        moves = np.full((self.frames, 3, 3), np.nan)
        faces = [self.faces[j] for j in range(3)]
        information, gradient, used, frame = (
            np.concatenate(parts)
            for parts in zip(*((f.sums.information, f.sums.gradient, f.sums.used, f.frame) for f in faces), strict=True)
        )
        face = np.repeat(np.arange(3), [len(f.frame) for f in faces])
        size = np.linalg.eigvalsh(information * self.sigma_m**2 + 1e-12 * np.eye(3))
        good = (used >= FEWEST) & (size[:, 2] < 1e9 * size[:, 0])
        moves[frame[good], face[good]] = np.linalg.solve(information[good], gradient[good][..., None])[..., 0]
        tilted = np.stack([n + moves[:, j, 1:] @ tangents(n).T for j, n in enumerate(self.normals)], axis=1)
        corners = np.full((self.frames, 3), np.nan)
        good = np.isfinite(tilted).all(axis=(1, 2))
        good[good] = np.abs(np.linalg.det(tilted[good])) > 1e-3
        shifts = moves[good, :, 0][..., None]
        corners[good] = self.corner + np.linalg.solve(tilted[good], shifts)[..., 0]
        return corners

    def systems(self, good: BoolArray) -> dict[int, FaceSystem]:
        """By face: what those frames (F,) that are good say together."""
        return {j: face.system(good) for j, face in self.faces.items()}
