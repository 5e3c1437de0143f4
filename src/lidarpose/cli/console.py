"""What commands share when they talk to a person: tables, progress, JSON, and options' types.

Standard output carries results; progress and remarks go to standard error, so that ``--json`` prints one object and
nothing else.
"""

from __future__ import annotations

import json
import os
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from rich.console import Console

_REDRAWN_EVERY_S = 0.1
# Tables are laid out for so many columns at least, and where nobody looks for as many as they need: a narrower terminal
# breaks their lines, but no number is cut short.
_LEAST_COLUMNS, _ALL_COLUMNS = 80, 400


class Advance(Protocol):
    """Tells that work went on: ``advance()`` after each step."""

    def __call__(self, steps: int = 1) -> None: ...


def out() -> Console:
    """Standard output for people: colour on a terminal, plain text in whole lines elsewhere."""
    from rich.console import Console

    class Standard(Console):
        def on_broken_pipe(self) -> None:
            """Go on: the exit status is for what the command found, whether anybody reads it or not."""
            hang_up()

    watched = sys.stdout.isatty()
    width = max(shutil.get_terminal_size().columns, _LEAST_COLUMNS) if watched else _ALL_COLUMNS
    return Standard(highlight=False, soft_wrap=not watched, width=width)


def err() -> Console:
    """Standard error, for progress and remarks."""
    from rich.console import Console

    return Console(stderr=True, highlight=False, soft_wrap=not sys.stderr.isatty())


def hang_up() -> None:
    """Send what is still to be printed nowhere: the reader of our output went away, or it cannot be written."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_json(value: Mapping[str, Any]) -> None:
    """One JSON object on standard output. NaN and infinity are refused, as JSON has neither."""
    print(json.dumps(value, allow_nan=False, indent=2))


@contextmanager
def progress(text: str, total: int | None, *, quiet: bool = False) -> Iterator[Advance]:
    """A progress bar with the time left on standard error while the block runs; none where nobody watches."""
    if quiet or not sys.stderr.isatty():
        yield lambda steps=1: None
        return
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    # Drawn as work goes on, not by a thread of its own: a process with threads cannot be forked (workflows/forked.py).
    with Progress(*columns, console=err(), transient=True, auto_refresh=False) as bar:
        task = bar.add_task(text, total=total)
        drawn = time.monotonic()

        def advance(steps: int = 1) -> None:
            nonlocal drawn
            bar.advance(task, steps)
            if time.monotonic() - drawn > _REDRAWN_EVERY_S:
                bar.refresh()
                drawn = time.monotonic()

        yield advance
