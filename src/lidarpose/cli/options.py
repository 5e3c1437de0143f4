"""Options that several commands share, with their texts and checks."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from lidarpose.errors import InputError

if TYPE_CHECKING:
    from cyclopts import Token


def finite(_: object, value: float | None) -> None:
    """Refuse NaN and infinity, which float() takes gladly."""
    if value is not None and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")


def positive(_: object, value: float | None) -> None:
    """Refuse what is not a finite number above zero."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{value} is not a finite number above zero")


def only_for(what: str, given: Mapping[str, bool], expected: str | None = None) -> None:
    """Refuse the first of the options that are given where there is nothing for them."""
    for option, is_given in given.items():
        if is_given:
            raise InputError(option, f"is for {what}", expected=expected, remedy="Leave it out")


def _whole(_: object, tokens: Sequence[Token]) -> int:
    """A whole number; cyclopts would round 1.5."""
    text = tokens[0].value
    try:
        return int(text)
    except ValueError:
        raise ValueError(f"{text} is not a whole number") from None


WholeNumber = Annotated[int, Parameter(converter=_whole)]
FiniteFloat = Annotated[float, Parameter(validator=finite)]
PositiveFloat = Annotated[float, Parameter(validator=positive)]

Json = Annotated[
    bool, Parameter(name="--json", negative="", show_default=False, help="Print one JSON object and nothing else.")
]
Quiet = Annotated[bool, Parameter(name="--quiet", negative="", show_default=False, help="No progress and no remarks.")]
