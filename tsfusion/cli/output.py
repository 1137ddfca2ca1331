# SPDX-License-Identifier: MIT
"""Results on stdout."""

import json
from typing import Any

import typer

from tsfusion.core.readable_numbers import counted, grouped, size

__all__ = ["as_json", "counted", "grouped", "size"]


def as_json(value: Any, *, indent: int | None = 2) -> None:
    """Print a struct or dict as JSON on stdout; on one line where `indent` is None."""
    from msgspec import to_builtins

    typer.echo(json.dumps(to_builtins(value), indent=indent, ensure_ascii=False))
