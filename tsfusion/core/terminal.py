# SPDX-License-Identifier: MIT
"""Text for a terminal of any width."""

import os
import textwrap
from typing import TextIO


def fitted(text: str, stream: TextIO, *, indent: int = 2) -> str:
    """Break lines between words where they are too long for the terminal at `stream`; elsewhere never.

    Args:
        indent: columns before what follows the first part of a line.
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
