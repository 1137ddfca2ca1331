# SPDX-License-Identifier: MIT
"""The folder a run leaves behind: whole, or not there."""

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tsfusion.errors import OutputError

RECORD = "run.json"


@contextmanager
def building(out: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder whose files move to the folder `out` when the block ends without an error.

    A new `out` appears in one rename. In an existing one each file replaces its namesake and everything else
    stays; its old `run.json` goes first and the new one comes last, so a `run.json` always describes its
    neighbours.

    Raises:
        OutputError: at once, when `out` cannot be written.
    """
    out = Path(out).expanduser().absolute()
    work = _workplace(out)
    try:
        yield work
        _move(work, out)
    finally:
        shutil.rmtree(work, ignore_errors=True)


def _workplace(out: Path) -> Path:
    """A new folder on the file system of `out`: inside it where it exists, beside it where not."""
    try:
        if out.exists() and not out.is_dir():
            raise OutputError(f"cannot write to {out}: it is not a folder")
        place = out if out.is_dir() else out.parent
        place.mkdir(parents=True, exist_ok=True)
        work = place / f".{out.name}.partial-{secrets.token_hex(4)}"
        work.mkdir()
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from error
    return work


def _move(work: Path, out: Path) -> None:
    try:
        if not out.exists():
            work.rename(out)
            return
        (out / RECORD).unlink(missing_ok=True)
        for path in sorted(work.iterdir(), key=lambda path: path.name == RECORD):
            path.replace(out / path.name)
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from error


def check_writable(path: str | os.PathLike[str], endings: tuple[str, ...]) -> None:
    """Raise OutputError unless a file could be made at `path` and it ends so; leaves nothing there."""
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise OutputError(f"cannot write {path}: expected a name ending in {', '.join(endings)}")
    try:
        with tempfile.NamedTemporaryFile(prefix=f".{path.name}.", dir=path.parent):
            pass
    except OSError as error:
        raise OutputError(f"cannot write {path}: {error.strerror}") from error
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder")
