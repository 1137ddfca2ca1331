# SPDX-License-Identifier: MIT
"""The output folder of a run: complete, or not there."""

import os
import secrets
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tsfusion.core import folder_lock
from tsfusion.core.errors import OutputError

RECORD = "run.json"


@contextmanager
def building(out: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder whose files move to the folder `out` when the block ends without an error.

    A new `out` appears in one rename. In an existing one each file replaces its namesake and everything else
    stays; its old `run.json` is deleted first and the new one comes last, so that it always describes its
    neighbours. An error leaves nothing, no parent folder either; the next run clears up after a killed one.

    Raises:
        OutputError: at once, when `out` cannot be written.
    """
    out = Path(out).expanduser().absolute()
    if os.path.exists(out) and not out.is_dir():
        raise OutputError(f"cannot write to {out}: it is not a folder")
    with _parents(out), _workplace(out) as work:
        yield work
        _move(work, out)


@contextmanager
def _parents(out: Path) -> Iterator[None]:
    """Make the folders above `out`; when the block fails, those that are still empty are removed."""
    missing = [parent for parent in out.parents if not os.path.exists(parent)]  # innermost first
    try:
        try:
            out.parent.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OutputError(f"cannot write to {out}: {error.strerror}") from error
        yield
    except BaseException:
        for parent in missing:
            with suppress(OSError):
                parent.rmdir()
        raise


@contextmanager
def _workplace(out: Path) -> Iterator[Path]:
    """A folder on the file system of `out`, locked while the block runs: inside `out` if that exists."""
    prefix = f".{out.name}.partial-"
    for place in (out, out.parent):
        _sweep(place, prefix)
    work = (out if out.is_dir() else out.parent) / (prefix + secrets.token_hex(4))
    try:
        work.mkdir()
        lock = folder_lock.hold(work)
    except OSError as error:
        raise OutputError(f"cannot write to {out}: {error.strerror}") from error
    try:
        yield work
    finally:
        shutil.rmtree(work, ignore_errors=True)
        lock.close()


def _sweep(place: Path, prefix: str) -> None:
    """Remove the work folders whose owner is dead."""
    with suppress(OSError):
        for path in [path for path in place.iterdir() if path.name.startswith(prefix)]:
            # another run is at work there, or the folder is not ours to remove
            with suppress(OSError), folder_lock.hold(path):
                shutil.rmtree(path, ignore_errors=True)


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
