"""Short documents as frozen dataclasses: checked here, and by pydantic for the words where something is wrong.

Importing pydantic takes a command longer than all else that stands between its start and its first image. So right
documents, which are nearly all, are read without it. What is refused here is refused by pydantic too, which says why.
"""

from __future__ import annotations

import dataclasses
import math
from functools import cache
from pathlib import Path
from types import GenericAlias, NoneType, UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from lidarpose.errors import InputError

if TYPE_CHECKING:
    from lidarpose.storage.schemas import Schema

T = TypeVar("T")


@dataclasses.dataclass(frozen=True)
class Within:
    """Bounds of a number, or of a list's length, for `Annotated`."""

    gt: float | None = None
    ge: float | None = None
    le: float | None = None
    min_length: int | None = None
    max_length: int | None = None

    def holds(self, value: Any) -> bool:
        number = isinstance(value, int | float)
        return (
            (self.gt is None or (number and value > self.gt))
            and (self.ge is None or (number and value >= self.ge))
            and (self.le is None or (number and value <= self.le))
            and (self.min_length is None or len(value) >= self.min_length)
            and (self.max_length is None or len(value) <= self.max_length)
        )


class _RefusedError(Exception):
    """A value is not what its annotation says."""


def read_sections(path: Path, kind: type[T], document: Any) -> T:
    """A document as a frozen dataclass. Its fields may be str, bool, int, float, literals, lists and such dataclasses.

    Unknown keys, NaN and infinity are errors; numbers are numbers, not text. Raises InputError naming the key.
    """
    found = plainly(kind, document)
    if found is None:
        from lidarpose.storage.schemas import parse

        schema: Any = kind
        parse(path, _schema(schema), document)
        raise InputError(path, "is not what it should be")
    return found


def plainly(kind: type[T], document: Any) -> T | None:
    """The same, and None where anything is wrong with it, for those who know what to say then."""
    try:
        found: T = _checked(kind, document)
    except _RefusedError:
        return None
    return found


def _checked(kind: Any, value: Any) -> Any:
    """A value of this kind. Raises _RefusedError where it is another."""
    origin = get_origin(kind)
    if origin is Annotated:
        inner, *bounds = get_args(kind)
        found = _checked(inner, value)
        if not all(bound.holds(found) for bound in bounds):
            raise _RefusedError
        return found
    if origin in (Union, UnionType):
        if value is None:
            return None
        (inner,) = (arm for arm in get_args(kind) if arm is not NoneType)
        return _checked(inner, value)
    if origin is list and isinstance(value, list):
        (inner,) = get_args(kind)
        return [_checked(inner, each) for each in value]
    if origin is Literal and isinstance(value, str) and value in get_args(kind):
        return value
    if dataclasses.is_dataclass(kind) and isinstance(value, dict):
        return _section(kind, value)
    if kind is float and type(value) in (int, float):
        return _finite(value)
    if kind in (str, bool, int) and type(value) is kind:
        return value
    raise _RefusedError


def _finite(value: float) -> float:
    try:
        number = float(value)
    except OverflowError:
        raise _RefusedError from None
    if not math.isfinite(number):
        raise _RefusedError
    return number


def _section(kind: Any, value: dict[str, Any]) -> Any:
    hints = _hints(kind)
    if not _required(kind) <= value.keys() <= hints.keys():
        raise _RefusedError
    return kind(**{key: _checked(hints[key], each) for key, each in value.items()})


@cache
def _hints(kind: Any) -> dict[str, Any]:
    return get_type_hints(kind, include_extras=True)


def _required(kind: Any) -> set[str]:
    without = dataclasses.MISSING
    return {f.name for f in dataclasses.fields(kind) if f.default is without and f.default_factory is without}


@cache
def _schema(kind: Any) -> type[Schema]:
    """The pydantic model of a dataclass."""
    from pydantic import create_model

    from lidarpose.storage.schemas import Schema

    hints = _hints(kind)
    required = _required(kind)
    fields: dict[str, Any] = {
        name: (_pydantic(hint), ... if name in required else None) for name, hint in hints.items()
    }
    return create_model(kind.__name__, __base__=Schema, **fields)


def _pydantic(kind: Any) -> Any:
    """The same annotation for pydantic."""
    from pydantic import Field

    origin = get_origin(kind)
    if origin is Annotated:
        inner, *bounds = get_args(kind)
        stated = [{k: v for k, v in dataclasses.asdict(bound).items() if v is not None} for bound in bounds]
        return Annotated[(_pydantic(inner), *(Field(**each) for each in stated))]
    if origin in (Union, UnionType):
        (inner,) = (arm for arm in get_args(kind) if arm is not NoneType)
        return _pydantic(inner) | None
    if origin is list:
        return GenericAlias(list, (_pydantic(get_args(kind)[0]),))
    section: Any = kind
    return _schema(section) if dataclasses.is_dataclass(kind) else kind
