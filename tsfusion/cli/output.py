# SPDX-License-Identifier: MIT
"""Print results on stdout."""

import json
import sys
from typing import Any

import typer

from tsfusion.core.readable_numbers import counted, fitted, grouped, size

__all__ = ["as_json", "counted", "grouped", "size", "text"]


def text(text: str, *, err: bool = False, indent: int = 2) -> None:
    """Print text on stdout or stderr, with long lines broken between words on a narrow terminal.

    Args:
        indent: columns before the broken-off parts of a line.
    """
    typer.echo(fitted(text, sys.stderr if err else sys.stdout, indent=indent), err=err)


def as_json(value: Any, *, indent: int | None = 2) -> None:
    """Print a struct or dict as JSON on stdout, on one line if `indent` is None."""
    from msgspec import to_builtins

    typer.echo(json.dumps(to_builtins(value), indent=indent, ensure_ascii=False))
