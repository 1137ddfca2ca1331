# SPDX-License-Identifier: MIT
"""`tsfusion datasets`."""

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from tsfusion.cli import options, verbs

_DEPTH = 4  # folders below PATH


class _ListByDefault(verbs.Group):
    """`tsfusion datasets [PATH]` is `tsfusion datasets list [PATH]`."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        if not args or args[0] not in {*self.commands, *ctx.help_option_names}:
            args = ["list", *args]
        return super().parse_args(ctx, args)


app = typer.Typer(cls=_ListByDefault, help="The datasets that can be replayed.")


@app.callback()
def _group() -> None:
    """Keep `list` a verb of its own while it is the only one."""


@verbs.verb(app, "tsfusion datasets", "tsfusion datasets ~/recordings", name="list")
def list_(
    path: Annotated[
        Path | None, typer.Argument(metavar="PATH", help="Look for datasets in and under it.")
    ] = None,
    json: options.Json = False,
) -> None:
    """List the layouts that `replay` recognises, or the datasets in and under PATH."""
    from tsfusion.cli import output

    rows = _layouts() if path is None else list(_found(path, _DEPTH))
    if not rows:
        from tsfusion.core.errors import DatasetError

        raise DatasetError(
            f"no datasets in or under {path}; `tsfusion datasets` says what each layout expects"
        )
    if json:
        output.as_json(rows)
        return
    for row in rows:
        typer.echo(_line(**row))


def _line(
    name: str,
    *,
    description: str = "",
    path: str = "",
    sensor: str = "",
    keyframes: int = 0,
    posed: bool = True,
    uncolored: int = 0,
    camera: str = "",
) -> str:
    if not path:
        return f"{name:<16}  {description}"
    what = "keyframes" if posed else "frames without poses, for `tsfusion scan`"
    grey = f" ({uncolored} without colour in time)" if uncolored else ""
    seen = f"  camera {camera}" if camera else ""
    return f"{path}  {name}  {sensor}  {keyframes} {what}{grey}{seen}"


def _layouts() -> list[dict[str, Any]]:
    from tsfusion.datasets import layouts
    from tsfusion.datasets.layouts import SYNTHETIC

    rows = [(layout.name, layout.description) for layout in layouts()]
    return [{"name": name, "description": description} for name, description in [*rows, SYNTHETIC]]


def _is_one(path: Path) -> bool:
    """True if a path has a known layout, or holds a folder with one."""
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets.layouts import find

    try:
        find(path)
    except DatasetError:
        return False
    return True


def _found(path: Path, depth: int) -> Iterator[dict[str, Any]]:
    """The datasets in and under a folder; a dataset is not searched for others.

    Raises:
        DatasetError: there is no folder, or it is a dataset that cannot be opened.
    """
    from tsfusion.core.errors import DatasetError, MissingDependency
    from tsfusion.datasets import open_dataset
    from tsfusion.datasets.cameras import UnknownCamera, camera_line
    from tsfusion.datasets.dataset import SeveralRecordings

    for posed in (True, False):
        try:
            dataset = open_dataset(path, posed=posed)
        except (MissingDependency, UnknownCamera) as error:
            if depth == _DEPTH:
                raise
            typer.echo(f"{path}: {error}" if isinstance(error, MissingDependency) else str(error), err=True)
            return
        except DatasetError as error:
            failure = error
            continue
        yield {
            "path": str(path), "name": dataset.name, "sensor": dataset.sensor,
            "keyframes": len(dataset), "posed": posed, "uncolored": getattr(dataset, "uncolored", 0),
            "camera": camera_line(dataset),
        }  # fmt: skip
        return
    has_more = path.is_dir() and (isinstance(failure, SeveralRecordings) or not _is_one(path))
    if depth == _DEPTH and not has_more:
        raise failure
    for child in _folders_in(path) if depth else []:
        yield from _found(child, depth - 1)


def _folders_in(path: Path) -> list[Path]:
    try:
        return sorted(child for child in path.iterdir() if child.is_dir())
    except OSError as error:
        typer.echo(f"cannot read the folder {path}: {error.strerror}", err=True)
        return []
