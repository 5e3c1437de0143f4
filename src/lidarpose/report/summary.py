"""The same answers for a terminal: the verdict with its reasons, and small tables. Colour only on a terminal."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

from lidarpose.report.page import Tone, Verdict

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

_STYLES: dict[Tone, str] = {
    "good": "bold green",
    "doubtful": "bold yellow",
    "rejected": "bold red",
    "unknown": "bold",
}


def print_verdict(console: Console, verdict: Verdict) -> None:
    """One line with the verdict, what it rests on, then reasons and steps, each on its own line."""
    from rich.text import Text

    word = "none" if verdict.tone == "unknown" else verdict.tone
    console.print(Text.assemble("verdict: ", (word, _STYLES[verdict.tone])))
    console.print(Text(verdict.say), soft_wrap=not console.is_terminal)
    _print_list(console, verdict.heading, verdict.reasons, numbered=False)
    _print_list(console, "What to do", verdict.todo, numbered=True)


def figures_table(title: str, columns: Sequence[str], rows: Iterable[Sequence[str]]) -> Table:
    """A table headed by its title, with names in its first column and figures, flush right, in the others."""
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    table = Table(box=SIMPLE_HEAD, pad_edge=False, padding=(0, 2, 0, 0))
    table.add_column(title)
    for column in columns:
        table.add_column(column, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(*(Text(cell) for cell in row))
    return table


def _print_list(console: Console, title: str, items: Sequence[str], *, numbered: bool) -> None:
    if not items:
        return
    from rich.text import Text

    console.print(Text(title, style="bold"))
    if not console.is_terminal:
        # Lines stay whole for those who search them.
        for k, item in enumerate(items):
            console.print(Text(f"  {k + 1}. {item}" if numbered else f"  - {item}"), soft_wrap=True)
        return
    from rich.padding import Padding
    from rich.table import Table

    listed = Table.grid(padding=(0, 1, 0, 0))
    for k, item in enumerate(items):
        listed.add_row(f"{k + 1}." if numbered else "-", Text(item))
    console.print(Padding(listed, (0, 0, 0, 2)))
