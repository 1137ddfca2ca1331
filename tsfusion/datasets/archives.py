# SPDX-License-Identifier: MIT
"""Recordings as they are downloaded: archives, unpacked beside themselves."""

import tarfile
import tempfile
import zipfile
from pathlib import Path

from tsfusion.errors import DatasetError

_SUFFIXES = (".tar.gz", ".tar.bz2", ".tar.xz", ".tgz", ".tbz2", ".txz", ".tar", ".zip")


def is_archive(path: Path) -> bool:
    """Whether the name is an archive's: `.zip`, `.tar` and its compressed kinds."""
    return path.name.lower().endswith(_SUFFIXES)


def destination(path: Path) -> Path:
    """The folder that an archive is unpacked to: beside it, with its name."""
    suffix = next(suffix for suffix in _SUFFIXES if path.name.lower().endswith(suffix))
    return path.with_name(path.name[: -len(suffix)])


def command(path: Path) -> str:
    """What to type to unpack it there."""
    into = destination(path)
    if path.suffix.lower() == ".zip":
        return f"unzip -q '{path}' -d '{into}'"
    return f"mkdir '{into}' && tar -xf '{path}' -C '{into}'"


def unpack(path: Path) -> Path:
    """Unpack beside the archive, all or nothing; returns the folder. Windows paths inside become folders.

    Raises:
        DatasetError: when it is broken or leads out of its folder, the folder exists, or the disk is full.
    """
    into = destination(path)
    if into.exists():
        raise DatasetError(f"{into} exists already; remove it to unpack {path.name} there again")
    try:
        with tempfile.TemporaryDirectory(prefix=".unpacking-", dir=path.parent) as place:
            partial = Path(place) / into.name
            partial.mkdir()
            _extract(path, partial)
            partial.rename(into)
    except (OSError, ValueError, tarfile.TarError, zipfile.BadZipFile, EOFError) as error:
        raise DatasetError(f"cannot unpack {path}: {error}") from error
    return into


def _extract(path: Path, into: Path) -> None:
    if path.suffix.lower() != ".zip":
        with tarfile.open(path) as tar:
            tar.extractall(into, filter="data")
        return
    with zipfile.ZipFile(path) as archive:
        for member in archive.infolist():
            member.filename = member.filename.replace("\\", "/")
            archive.extract(member, into)  # leaves out drive letters, leading slashes and `..`
