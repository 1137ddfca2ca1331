# SPDX-License-Identifier: MIT
"""Unpack archives of recordings to a folder beside them, safely."""

import lzma
import shutil
import stat
import tarfile
import tempfile
import zipfile
import zlib
from pathlib import Path, PurePosixPath, PureWindowsPath

from tsfusion.core import durable_files
from tsfusion.core.errors import DatasetError, refusals_as

_CHUNK_BYTES = 1 << 20
_SUFFIXES = (".tar.gz", ".tar.bz2", ".tar.xz", ".tgz", ".tbz2", ".txz", ".tar", ".zip")


def is_archive(path: Path) -> bool:
    """Return True for the name of an archive: `.zip`, `.tar` and its compressed kinds."""
    return path.name.lower().endswith(_SUFFIXES)


def destination(path: Path) -> Path:
    """Return the folder that an archive is unpacked to: beside the archive, with its name."""
    suffix = next(suffix for suffix in _SUFFIXES if path.name.lower().endswith(suffix))
    return path.with_name(path.name[: -len(suffix)])


def command(path: Path) -> str:
    """Return the shell command that unpacks an archive to `destination`."""
    into = destination(path)
    if path.suffix.lower() == ".zip":
        return f"unzip -q '{path}' -d '{into}'"
    return f"mkdir '{into}' && tar -xf '{path}' -C '{into}'"


def unpack(path: Path) -> Path:
    """Unpack beside the archive, completely or not at all; return the folder. Windows paths become folders.

    Raises:
        DatasetError: the archive is broken or leads out of its folder, the folder exists, or the disk is
            full.
    """
    into = destination(path)
    if into.exists():
        raise DatasetError(f"{into} exists already; remove it to unpack {path.name} there again")
    with (
        refusals_as(DatasetError, f"cannot unpack {path}"),
        tempfile.TemporaryDirectory(prefix=".unpacking-", dir=path.parent) as place,
    ):
        partial = Path(place) / into.name
        partial.mkdir()
        extract(path, partial)
        partial.rename(into)
    return into


def extract(path: Path, into: Path, *, nested: bool = False) -> None:
    """Unpack into an empty folder. If it fails, files unpacked so far stay there.

    Args:
        nested: True also unpacks zip files inside, and removes them.

    Raises:
        DatasetError: the archive is broken, or a member is a link or leads out of the folder.
        OSError: a file cannot be written.
    """
    into.mkdir(parents=True, exist_ok=True)
    try:
        if path.suffix.lower() == ".zip":
            _extract_zip(path, into)
        else:
            _extract_tar(path, into)
    except (ValueError, tarfile.TarError, zipfile.BadZipFile, zlib.error, lzma.LZMAError, EOFError,
            NotImplementedError, RuntimeError) as error:  # fmt: skip
        reason = " ".join(str(error).split())  # tarfile's goes over many lines
        raise DatasetError(f"cannot unpack {path}: {reason}; is it broken? get it again") from error
    for inner in sorted(into.rglob("*.zip")) if nested else ():
        extract(inner, inner.parent)
        inner.unlink()


def _extract_tar(path: Path, into: Path) -> None:
    with tarfile.open(path) as tar:  # `tar.extract(filter="data")` is too new for Debian 12's Python
        for member in tar:
            _require_inside(member.name, is_link=not (member.isfile() or member.isdir()))
            target = into / member.name
            if member.isdir():
                target.mkdir(parents=True, exist_ok=True)
                continue
            durable_files.require_room(into, member.size)
            content = tar.extractfile(member)
            assert content is not None
            target.parent.mkdir(parents=True, exist_ok=True)
            with target.open("wb") as file:
                shutil.copyfileobj(content, file, _CHUNK_BYTES)


def _extract_zip(path: Path, into: Path) -> None:
    with zipfile.ZipFile(path) as archive:
        durable_files.require_room(into, sum(member.file_size for member in archive.infolist()))
        for member in archive.infolist():
            member.filename = member.filename.replace("\\", "/")
            _require_inside(member.filename, is_link=stat.S_ISLNK(member.external_attr >> 16))
            archive.extract(member, into)


def _require_inside(name: str, *, is_link: bool) -> None:
    """Raise ValueError for an archive's member that is a link or leads out of the folder."""
    inside = PurePosixPath(name)
    if is_link or inside.is_absolute() or ".." in inside.parts or PureWindowsPath(name).drive:
        what = "is no plain file" if is_link else "leads out of the archive's folder"
        raise ValueError(f"its member {name!r} {what}; nothing of it is kept")
