# SPDX-License-Identifier: MIT
"""Download a recording of the catalogue: checked, resumable, and unpacked completely or not at all.

Pooch compares checksums. `http` downloads, and continues after an interruption.
"""

import logging
import shutil
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

from tsfusion.core.errors import DatasetError, OutputError, needing, refusals_as
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.datasets.download import archives, http
from tsfusion.datasets.download.catalogue import File, PublicRecording

_INSTALL = "downloads need pooch; install it with: pip install '.[download]' in your clone of tsfusion"
ENDING = ".sha256"


class CheckedFile(NamedTuple):
    """Downloaded file of a recording, with the SHA-256 of its content."""

    path: Path
    sha256: str  # of the file on disk
    # True if a checksum was known for comparison; otherwise this one was written beside the file
    known: bool
    fetched: bool  # True if this call downloaded it


class FetchedRecording(NamedTuple):
    """Recording on disk. `path` is the path to open; `files` lacks archives that the user has removed."""

    path: Path
    files: list[CheckedFile]


def fetch(
    recording: PublicRecording, to: Path, watch: OnProgress, *, base: str | None = None
) -> FetchedRecording:
    """Download a recording into `to`: its archives, and the folder `to/NAME` with their contents.

    Args:
        base: address of a mirror that has the files under their names.

    Raises:
        MissingDependency: pooch is not installed.
        DatasetError: the recording must be fetched by hand, cannot be fetched, or has another checksum.
        OutputError: a file cannot be written.
    """
    if not recording.files:
        raise DatasetError(f"{recording.title}: {recording.note}: {recording.page}")
    folder = to / recording.name
    files = []
    for file in recording.files:
        path = to / file.name
        if path.exists() or not folder.exists():
            files.append(_fetched_or_there(file, path, watch, base))
    if not folder.exists():
        _unpack(recording, to, folder)
    return FetchedRecording(folder / recording.opens if recording.opens else folder, files)


def check(recording: PublicRecording, to: Path) -> list[CheckedFile]:
    """Compare the files of a recording in `to` with their checksums.

    Raises:
        DatasetError: a file has another checksum.
    """
    paths = [(file, to / file.name) for file in recording.files]
    return [_verified(file, path) for file, path in paths if path.exists()]


def _fetched_or_there(file: File, path: Path, watch: OnProgress, base: str | None) -> CheckedFile:
    if path.exists():
        return _verified(file, path)
    url = f"{base.rstrip('/')}/{file.name}" if base else file.url
    known = _known_checksum(file, path)
    _download(url, path, known, watch)
    return _with_checksum_file(path, known=known is not None, fetched=True)


def _download(url: str, path: Path, known: str | None, watch: OnProgress) -> None:
    pooch = _pooch()
    part = path.with_name(f"{path.name}.part")

    def downloader(url: str, output: str, _pooch: object) -> None:
        http.download(url, part, watch)
        part.replace(output)

    try:
        pooch.retrieve(url, known_hash=known, fname=path.name, path=path.parent, downloader=downloader)
    except ValueError as error:
        raise DatasetError(
            f"{url} has another checksum than {known}, and was not kept: the file is broken, was changed, "
            "or is another one"
        ) from error
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror or error}") from error


def _pooch() -> Any:
    with needing(_INSTALL):
        import pooch
    pooch.get_logger().setLevel(logging.ERROR)
    return pooch


def _known_checksum(file: File, path: Path) -> str | None:
    """Return the checksum in the catalogue, or the one written at the first download, or None."""
    if file.checksum is not None:
        return file.checksum
    try:
        words = path.with_name(path.name + ENDING).read_text(encoding="ascii").split()
    except (OSError, UnicodeDecodeError):
        return None
    return f"sha256:{words[0]}" if words else None


def _verified(file: File, path: Path) -> CheckedFile:
    known = _known_checksum(file, path)
    if known is not None:
        kind, _, expected = known.partition(":")
        found = _file_hash(path, kind)
        if found != expected.lower():
            raise DatasetError(
                f"{path} has another checksum: {kind} {found}, expected {expected}; remove it (and "
                f"{path.name}{ENDING} if it was meant to change) to fetch it again"
            )
    return _with_checksum_file(path, known=known is not None, fetched=False)


def _with_checksum_file(path: Path, *, known: bool, fetched: bool) -> CheckedFile:
    """Write a file's checksum beside it, in the format of `sha256sum --check`; return both."""
    sha256 = _file_hash(path, "sha256")
    beside = path.with_name(path.name + ENDING)
    with refusals_as(OutputError, f"cannot write {beside}"):
        if not beside.exists():
            beside.write_text(f"{sha256}  {path.name}\n", encoding="ascii")
    return CheckedFile(path, sha256, known, fetched)


def _file_hash(path: Path, kind: str) -> str:
    with refusals_as(DatasetError, f"cannot read {path}"):
        return str(_pooch().file_hash(str(path), alg=kind)).lower()


def _extract(archive: Path, into: Path) -> None:
    try:
        archives.extract(archive, into, nested=True)
    except DatasetError as error:
        raise DatasetError(f"{error}; remove {archive} to fetch it again") from error


def _unpack(recording: PublicRecording, to: Path, folder: Path) -> None:
    with (
        refusals_as(OutputError, f"cannot unpack to {folder}"),
        tempfile.TemporaryDirectory(prefix=".unpacking-", dir=to) as place,
    ):
        partial = Path(place) / folder.name
        partial.mkdir()
        for file in recording.files:
            if archives.is_archive(Path(file.name)):
                _extract(to / file.name, partial / file.into)
            else:
                shutil.copyfile(to / file.name, partial / file.name)
        partial.rename(folder)
