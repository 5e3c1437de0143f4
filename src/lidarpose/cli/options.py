"""Options that several commands share, with their texts and checks."""

from __future__ import annotations

import math
from typing import Annotated

from cyclopts import Parameter


def finite(_: object, value: float | None) -> None:
    """Refuse NaN and infinity, which float() takes gladly."""
    if value is not None and not math.isfinite(value):
        raise ValueError(f"{value} is not a finite number")


def positive(_: object, value: float | None) -> None:
    """Refuse what is not a finite number above zero."""
    if value is not None and not (math.isfinite(value) and value > 0.0):
        raise ValueError(f"{value} is not a finite number above zero")


FiniteFloat = Annotated[float, Parameter(validator=finite)]
PositiveFloat = Annotated[float, Parameter(validator=positive)]

Json = Annotated[
    bool, Parameter(name="--json", negative="", show_default=False, help="Print one JSON object and nothing else.")
]
Quiet = Annotated[bool, Parameter(name="--quiet", negative="", show_default=False, help="No progress and no remarks.")]
