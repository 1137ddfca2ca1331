# SPDX-License-Identifier: MIT
"""`tsfusion download`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.datasets.download.catalogue import PublicRecording
    from tsfusion.datasets.download.download import CheckedFile


def download(
    name: Annotated[
        str | None, typer.Argument(metavar="NAME", help="The recording to fetch; default: list all.")
    ] = None,
    *,
    to: Annotated[Path, typer.Option("--to", metavar="DIR", help="Folder where recordings are kept.")] = Path(
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
