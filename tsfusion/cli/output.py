# SPDX-License-Identifier: MIT
"""Print results on stdout."""

import json
import sys
from typing import Any

import typer

from tsfusion.core.readable_numbers import counted, fitted, grouped, size

__all__ = ["as_json", "counted", "first_of", "grouped", "result", "size", "text"]


def text(text: str, *, err: bool = False, indent: int = 2) -> None:
    """Print text on stdout or stderr, with long lines broken between words on a narrow terminal.

    Args:
        indent: columns before the broken-off parts of a line.
    """
    typer.echo(fitted(text, sys.stderr if err else sys.stdout, indent=indent), err=err)


def result(value: Any, words: str, *, json: bool) -> None:
    """Print the result of a verb on stdout: as JSON, or in words."""
    if json:
        as_json(value)
    else:
        typer.echo(words)


def first_of(lines: list[str], most: int = 20) -> list[str]:
    """Return lines of one kind, of many only the first, and a line that says so."""
    if len(lines) <= most:
        return lines
    return [*lines[:most], f"  … and {len(lines) - most} more: --json lists all"]


def as_json(value: Any, *, indent: int | None = 2) -> None:
    """Print a struct or dict as JSON on stdout, on one line if `indent` is None."""
    from msgspec import to_builtins

    typer.echo(json.dumps(to_builtins(value), indent=indent, ensure_ascii=False))
