# SPDX-License-Identifier: MIT
"""Format numbers and counts for people, and fit lines to the width of a terminal."""

import os
import textwrap
from collections.abc import Callable
from decimal import Decimal
from typing import TextIO

OnProgress = Callable[[int, int], None]  # done and total (0 = unknown): bytes, records or steps


def grouped(number: float) -> str:
    """Format a number with narrow spaces between the thousands: 1234567 → 1 234 567."""
    return f"{number:,.0f}".replace(",", "\u202f")


def figure(number: float, digits: int = 2) -> str:
    """Round to `digits` significant digits, without an exponent: 148.3 → 150, 0.0513 → 0.051."""
    return f"{Decimal(f'{number:.{digits}g}'):f}"


def size(count: float) -> str:
    """Format a number of bytes with three digits: 12.3 MB."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def counted(counts: dict[str, int]) -> str:
    """Format the counts that are not 0: {"spool": 2, "quota": 1} → 2 × spool; 1 × quota."""
    return "; ".join(f"{count} × {reason}" for reason, count in counts.items() if count)


def span(seconds: float) -> str:
    """Format seconds: 7 s, 12 min, 5 h, 3 days."""
    for name, size in (("days", 86_400), ("h", 3600), ("min", 60)):
        if seconds >= 2 * size:
            return f"{seconds / size:.0f} {name}"
    return f"{seconds:.0f} s"


def count_of(number: int, one: str, many: str = "") -> str:
    """Return `1 keyframe` or `3 keyframes`; give both forms before a verb: `keyframe is`, `keyframes are`."""
    return f"{number} {one if number == 1 else many or f'{one}s'}"


def fitted(text: str, stream: TextIO, *, indent: int = 2) -> str:
    """Break lines between words if they are too long for the terminal at `stream`; leave them for a file.

    `indent`: columns before each continuation line.
    """
    try:
        columns = os.get_terminal_size(stream.fileno()).columns if stream.isatty() else 0
    except (OSError, ValueError):  # it has no file, or is closed
        columns = 0
    if columns <= 2 * indent:
        return text
    wrapper = textwrap.TextWrapper(
        columns, subsequent_indent=" " * indent, break_long_words=False, break_on_hyphens=False,
        drop_whitespace=True, replace_whitespace=False,
    )  # fmt: skip
    lines = text.split("\n")
    return "\n".join(line if len(line) <= columns else wrapper.fill(line) for line in lines)
