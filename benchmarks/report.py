"""What a suite hands back: figures of the list, tables with every contestant, curves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

Cell = object
"""Text or a number; None reads "not installed"."""


@dataclass(frozen=True)
class Table:
    """A table of the page: every contestant with its raw values."""

    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    text: str = ""


@dataclass(frozen=True)
class Curve:
    """Values of several contestants over one quantity: drawn, and printed as a table.

    `series`: by name, one value for each of `x`; NaN where there is none.
    """

    name: str
    title: str
    x_label: str
    y_label: str
    x: Sequence[float]
    series: Mapping[str, Sequence[float]]
    text: str = ""


@dataclass(frozen=True)
class Report:
    """One suite's outcome.

    `figures`: by the metric's key, what was measured; a figure may be missing. `pace_s`: median seconds of
    `timing.pace` during the suite, where it has figures in seconds.
    """

    figures: Mapping[str, float]
    tables: Sequence[Table] = ()
    curves: Sequence[Curve] = ()
    notes: Sequence[str] = field(default=())
    pace_s: float | None = None

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


@dataclass(frozen=True)
class Effort:
    """How much is measured: `quick` takes small sizes and few repeats, to see that all works."""

    quick: bool

    def pick(self, whole: int, quick: int) -> int:
        return quick if self.quick else whole
