"""What calibration files may hold, as pydantic models: imported where one is read."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

_Row3 = Annotated[list[float], Field(min_length=3, max_length=3)]
_Row4 = Annotated[list[float], Field(min_length=4, max_length=4)]
_Row6 = Annotated[list[float], Field(min_length=6, max_length=6)]


class _Lenient(BaseModel):
    # Other programs may add keys of their own; what we know must be right.
    model_config = ConfigDict(extra="ignore", allow_inf_nan=False, frozen=True)


class TransformEntry(_Lenient):
    parent: str
    child: str
    translation_m: _Row3 | None = None
    quaternion_xyzw: _Row4 | None = None
    matrix: Annotated[list[_Row4], Field(min_length=4, max_length=4)] | None = None
    covariance: Annotated[list[_Row6], Field(min_length=6, max_length=6)] | None = None


class _ParametersEntry(_Lenient):
    names: list[str]
    covariance: list[list[float]]


class _ReadingsEntry(_Lenient):
    scale: Annotated[float, Field(ge=0.01, le=100.0)]
    origin_rad: Annotated[float, Field(ge=-1e4, le=1e4)]


class _BeamsEntry(_Lenient):
    angle_scale: Annotated[float, Field(ge=0.5, le=2.0)] = 1.0
    range_scale: Annotated[float, Field(ge=0.5, le=2.0)] = 1.0
    range_offset_m: Annotated[float, Field(ge=-10.0, le=10.0)] = 0.0


class _QualityEntry(_Lenient):
    model_config = ConfigDict(extra="allow", frozen=True)
    verdict: Literal["good", "doubtful", "rejected"]
    reasons: list[str] = []


class CalibrationFile(_Lenient):
    format: Literal["lidarpose/calibration@1"]
    kind: Literal["turntable", "world"]
    transforms: Annotated[list[TransformEntry], Field(min_length=1)]
    scale: Annotated[float, Field(gt=0.0)] = 1.0
    readings: _ReadingsEntry | None = None
    beams: _BeamsEntry | None = None
    parameters: _ParametersEntry | None = None
    quality: _QualityEntry | None = None
    provenance: dict[str, Any] = {}
