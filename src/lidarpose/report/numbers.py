"""Numbers as people read them: few digits, a true minus sign, never more precision than there is."""

from __future__ import annotations

import math


def short(value: float, digits: int = 2) -> str:
    """`digits` significant digits without an exponent where that is readable."""
    if not math.isfinite(value):
        return "not finite"
    if value == 0.0:
        return "0"
    magnitude = math.floor(math.log10(abs(value)))
    rounded = round(value, digits - 1 - magnitude)
    if not -5 < magnitude < 7:
        return f"{rounded:.{digits - 1}e}".replace("-", "\u2212")
    # Rounding may have carried into the next digit (0.0996 becomes 0.10).
    magnitude = math.floor(math.log10(abs(rounded)))
    return f"{rounded:.{max(0, digits - 1 - magnitude)}f}".replace("-", "\u2212")


def fixed(value: float, decimals: int) -> str:
    """A fixed number of decimals, with a true minus sign and no negative zero."""
    text = f"{value:.{decimals}f}"
    if float(text) == 0.0:
        text = text.lstrip("-")
    return text.replace("-", "\u2212")


def plural(count: int, one: str, many: str | None = None) -> str:
    """'1 place', '3 places'."""
    return f"{count} {one if count == 1 else many or one + 's'}"
