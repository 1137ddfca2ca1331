# SPDX-License-Identifier: MIT
"""Results on stdout: JSON, and numbers as a person reads them."""

import json
from typing import Any

import typer


def as_json(value: Any, *, indent: int | None = 2) -> None:
    """Print a struct or dict as JSON on stdout; on one line where `indent` is None."""
    from msgspec import to_builtins

    typer.echo(json.dumps(to_builtins(value), indent=indent, ensure_ascii=False))


def grouped(number: float) -> str:
    """1234567 → 1 234 567."""
    return f"{number:,.0f}".replace(",", "\u202f")


def size(count: float) -> str:
    """Bytes as a person reads them."""
    for unit in ("B", "kB", "MB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.3g} GB"


def counted(counts: dict[str, int]) -> str:
    """{"spool": 2, "quota": 1} → 2 × spool; 1 × quota. Zeros are left out."""
    return "; ".join(f"{count} × {reason}" for reason, count in counts.items() if count)
