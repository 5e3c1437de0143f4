"""A measured disk or round hole as a reader wants to see it."""

from __future__ import annotations

from dataclasses import dataclass

from lidarpose.geometry.arrays import FloatArray


@dataclass(frozen=True, eq=False)
class RoundView:
    """The answer with the beams behind it.

    Attributes
    ----------
    kind, name
        "disk" or "hole"; where it was measured.
    diameter_m, sigma_m
        The answer.
    sigma_parts_m
        What its standard deviation is made of, by name in words.
    outermost_diameter_m
        The circle through the outermost points: biased, for comparison.
    centre, normal : (3,)
        In the frame `frame`.
    covered
        Share of the edge that beams determine.
    plane_rms_m
        Residuals of the ranges to the plane.
    on, off : (N, 2), (M, 2)
        Where beams met the plane, metres from the centre: those that returned from the material, those that did not.
    points : (K, 3)
        Returns from the material, in the frame `frame`.
    axes : (2, 3)
        Unit axes of `on` and `off` in the frame `frame`.
    remarks
        What a person should know.
    """

    kind: str
    name: str
    frame: str
    diameter_m: float
    sigma_m: float
    sigma_parts_m: dict[str, float]
    outermost_diameter_m: float
    centre: FloatArray
    normal: FloatArray
    covered: float
    plane_rms_m: float
    on: FloatArray
    off: FloatArray
    points: FloatArray
    axes: FloatArray
    remarks: tuple[str, ...] = ()
