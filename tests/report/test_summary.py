"""What a terminal shows: colour there, plain whole lines elsewhere."""

from __future__ import annotations

import io

from rich.console import Console

from lidarpose.report.page import Verdict
from lidarpose.report.summary import figures_table, print_verdict

LONG = "the readings in [positions.csv] do not fit " + "and " * 30 + "so on"
VERDICT = Verdict("rejected", "Rejected: do not use", "By its own figures.", (LONG,), ("Mend it.", "Record again."))


def printed(terminal: bool, width: int = 60) -> str:
    text = io.StringIO()
    console = Console(
        file=text, force_terminal=terminal, width=width, highlight=False, color_system="standard" if terminal else None
    )
    print_verdict(console, VERDICT)
    console.print(figures_table("Standard deviations", ("mm", "deg"), [("start", "0.1", "0.02"), ("[b]", "1", "2")]))
    return text.getvalue()


def test_plain_text_where_nobody_watches() -> None:
    text = printed(terminal=False)
    assert "\x1b" not in text
    assert text.splitlines()[0] == "verdict: rejected"
    assert f"  - {LONG}" in text.splitlines()
    assert "  2. Record again." in text.splitlines()
    assert "[b]" in text


def test_colour_and_wrapped_lines_on_a_terminal() -> None:
    text = printed(terminal=True)
    assert "\x1b[1;31mrejected" in text
    assert "[positions.csv]" in text
    assert max(len(line) for line in text.splitlines() if "and and" in line) <= 60
