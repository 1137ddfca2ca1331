# SPDX-License-Identifier: MIT
"""`tsfusion datasets` and `tsfusion download`: list datasets, and fetch public recordings."""

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, verbs

if TYPE_CHECKING:
    from tsfusion.datasets.download.catalogue import PublicRecording
    from tsfusion.datasets.download.download import CheckedFile

_DEPTH = 4  # levels of folders below PATH that are searched


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
        Path | None, typer.Argument(metavar="PATH", help="Folder to search, with its subfolders.")
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
    from tsfusion.datasets.layout_registry import SYNTHETIC

    rows = [(layout.name, layout.description) for layout in layouts()]
    return [{"name": name, "description": description} for name, description in [*rows, SYNTHETIC]]


def _is_one(path: Path) -> bool:
    """True if a path has a known layout, or contains a folder with one."""
    from tsfusion.core.errors import DatasetError
    from tsfusion.datasets.layout_registry import find

    try:
        find(path)
    except DatasetError:
        return False
    return True


def _found(path: Path, depth: int) -> Iterator[dict[str, Any]]:
    """Yield the datasets in and under a folder. Other datasets inside a dataset are not searched.

    Raises:
        DatasetError: there is no folder, or it is a dataset that cannot be opened.
    """
    from tsfusion.core.errors import DatasetError, MissingDependency
    from tsfusion.datasets import open_dataset
    from tsfusion.datasets.cameras import UnknownCamera, camera_line
    from tsfusion.datasets.dataset import SeveralRecordings
    from tsfusion.datasets.layout_registry import LONE

    for posed in (True, False):
        try:
            dataset = open_dataset(path, posed=posed)
            camera = camera_line(dataset)
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
            "keyframes": len(dataset), "posed": posed, "camera": camera,
            "uncolored": getattr(dataset, "uncolored", 0),
        }  # fmt: skip
        return
    has_more = path.is_dir() and (isinstance(failure, SeveralRecordings) or not _is_one(path))
    if depth == _DEPTH and not has_more:
        raise failure
    if not has_more:
        typer.echo(str(failure), err=True)
    for child in _places_in(path, LONE) if depth and has_more else []:
        yield from _found(child, depth - 1)


def _places_in(path: Path, endings: tuple[str, ...]) -> list[Path]:
    """Return the folders in a folder, and the files with one of the endings."""
    try:
        return sorted(child for child in path.iterdir() if child.is_dir() or child.suffix.lower() in endings)
    except OSError as error:
        typer.echo(f"cannot read the folder {path}: {error.strerror}", err=True)
        return []


def download(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="The recording to fetch; default: list all.")
    ] = None,
    *,
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="Folder to download into.")] = Path(
        "datasets"
    ),
    base: Annotated[
        str | None,
        typer.Option(
            "--from", metavar="URL", envvar="TSFUSION_DOWNLOAD_FROM",
            help="URL of a mirror: a folder with the archives under their own names.",
        ),
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Do not fetch; compare the archives in DIR with their checksums.")
    ] = False,
    json: options.Json = False,
) -> None:  # fmt: skip
    """Fetch a public recording, or list the known ones.

    To go on with an interrupted download, give the same command again. Mind each recording's licence.
    """
    from tsfusion.datasets.download import catalogue

    if check:
        _check([catalogue.entry(name)] if name else list(catalogue.CATALOGUE), to, json=json)
    elif name is None:
        _list(list(catalogue.CATALOGUE), json=json)
    else:
        _fetch(catalogue.entry(name), to, base, json=json)


def _list(recordings: "list[PublicRecording]", *, json: bool) -> None:
    from tsfusion.cli import output

    if json:
        output.as_json([recording._asdict() for recording in recordings])
        return
    for one in recordings:
        size = (
            "by hand" if not one.files else "size unknown" if one.nbytes is None else output.size(one.nbytes)
        )
        typer.echo(f"{one.name:<24}  {size:>12}  {one.title}\n{'':<24}  {'':>12}  {one.licence}; {one.page}")


def _fetch(recording: "PublicRecording", to: Path, base: str | None, *, json: bool) -> None:
    from tsfusion.cli import output, progress
    from tsfusion.datasets.download import download

    if not json:
        typer.echo(f"{recording.title}\nlicence: {recording.licence}; {recording.page}", err=True)
    with progress.reading(f"fetching {recording.name}", quiet=json) as watch:
        done = download.fetch(recording, to, watch, base=base)
    if json:
        output.as_json({"path": str(done.path), "files": [_row(one) for one in done.files]})
        return
    for one in done.files:
        _print_archive(one)
    typer.echo(f"{done.path}\nnext: tsfusion replay {done.path}")


def _check(recordings: "list[PublicRecording]", to: Path, *, json: bool) -> None:
    from tsfusion.cli import output
    from tsfusion.datasets.download import download

    found = [one for recording in recordings for one in download.check(recording, to)]
    if not found:
        from tsfusion.core.errors import DatasetError

        raise DatasetError(f"no archives of these recordings in {to}; give their folder with --to")
    if json:
        output.as_json([_row(one) for one in found])
        return
    for one in found:
        _print_archive(one)


def _row(one: "CheckedFile") -> dict[str, object]:
    return {**one._asdict(), "path": str(one.path)}


def _print_archive(one: "CheckedFile") -> None:
    verdict = "as expected" if one.known else "unverified: no checksum is published; recorded for later"
    typer.echo(f"{one.path}  sha256 {one.sha256}  {verdict}", err=True)
