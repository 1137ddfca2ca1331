# SPDX-License-Identifier: MIT
"""`tsfusion datasets list`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

from tsfusion.cli import options

_DEPTH = 4  # folders below PATH

app = typer.Typer(help="What can be replayed.")


@app.callback()
def _group() -> None:
    """Keeps `list` a verb of its own while it is the only one."""


@app.command("list")
def list_(
    path: Annotated[
        Path | None, typer.Argument(metavar="[PATH]", help="Look for datasets in and under it.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Name the layouts that `replay` recognises, or the datasets under PATH."""
    from tsfusion.cli import show

    rows = _layouts() if path is None else list(_found(path, _DEPTH))
    if json:
        show.as_json(rows)
        return
    for row in rows:
        typer.echo("  ".join(row.values()))
    if not rows:
        typer.echo(f"no datasets in or under {path}", err=True)


def _layouts() -> list[dict[str, str]]:
    from tsfusion.datasets import LAYOUTS

    return [{"name": f"{name:<16}", "description": description} for name, description in LAYOUTS]


def _found(path: Path, depth: int) -> Iterator[dict[str, str]]:
    """The datasets in and under a folder, not looking inside one that was found."""
    from tsfusion.datasets import open_dataset
    from tsfusion.errors import DatasetError

    try:
        dataset = open_dataset(path)
    except DatasetError:
        below = sorted(child for child in path.iterdir() if child.is_dir()) if path.is_dir() and depth else []
        for child in below:
            yield from _found(child, depth - 1)
        return
    count = f"{len(dataset)} keyframes"
    yield {"path": str(path), "name": dataset.name, "sensor": str(dataset.sensor), "keyframes": count}
