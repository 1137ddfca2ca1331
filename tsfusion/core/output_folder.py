# SPDX-License-Identifier: MIT
"""Write the output folder of a run completely, or not at all."""

import itertools
import os
import secrets
import shutil
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tsfusion.core import folder_lock
from tsfusion.core.errors import DISK_FULL, OutputError, TsfusionError, reason_of, refusals_as

RECORD = "run.json"
DEFAULT = "out"
LATEST = "latest"  # link to the newest folder in `DEFAULT`

_PARTIAL = ".partial-"
_IDLE_S = 60.0  # another run may have made a work folder but not locked it yet


@contextmanager
def building(out: str | os.PathLike[str]) -> Iterator[Path]:
    """Yield a temporary folder; its files move to the folder `out` when the block ends without an error.

    A new `out` appears in one rename. In an existing `out` each file replaces the file of the same name, and
    all else stays. Its old `run.json` is deleted first and the new one comes last, so that it always
    describes the other files. An error leaves nothing, not even parent folders. The next run clears up after
    a killed one.

    Raises OutputError at once if `out` cannot be written.
    """
    out = Path(out).expanduser().absolute()
    _check_folder(out)
    prefix = f".{out.name}.partial-"
    with _parents(out):
        for place in (out, out.parent):
            _sweep(place, prefix)
        work = (out if out.is_dir() else out.parent) / (prefix + secrets.token_hex(4))
        with _workplace(work, out):
            yield work
            _move(work, out)


@contextmanager
def results(out: str | os.PathLike[str] | None, *, overwrite: bool = False) -> Iterator[tuple[Path, Path]]:
    """Yield the temporary folder of `building`, and the folder that it becomes.

    Args:
        out: None = a new folder `out/DATE_TIME`; the link `out/latest` then points to it.
        overwrite: `out` may hold files; files of the same name are replaced.

    Raises OutputError at once if `out` cannot be written, or holds files that may not be replaced.
    """
    if out is None:
        root = Path(DEFAULT).absolute()
        _check_folder(root)
        with _parents(root / LATEST):
            _sweep(root, _PARTIAL, idle_s=_IDLE_S)
            work, folder = _claim(root, time.strftime("%Y-%m-%d_%H-%M-%S"))
            with _workplace(work, folder):
                yield work, Path(DEFAULT, folder.name)
                _move(work, folder)
        _point(root / LATEST, folder.name)
        return
    if not overwrite and (held := _visible(Path(out).expanduser())):
        raise OutputError(
            f"{out} holds files already ({', '.join(held[:3])}): name a new folder, or add --overwrite to "
            "replace those of the same name"
        )
    with building(out) as work:
        yield work, Path(out)


def _check_folder(out: Path) -> None:
    if os.path.exists(out) and not out.is_dir():
        raise OutputError(f"cannot write to {out}: it is not a folder; choose another name")


def _visible(folder: Path) -> list[str]:
    """Return the names in a folder, without hidden ones such as the remains of a killed run."""
    with suppress(OSError):
        return sorted(path.name for path in folder.iterdir() if not path.name.startswith("."))
    return []


@contextmanager
def _parents(out: Path) -> Iterator[None]:
    """Make the folders above `out`; if the block fails, remove those that are still empty."""
    missing = [parent for parent in out.parents if not os.path.exists(parent)]  # innermost first
    try:
        with refusals_as(OutputError, f"cannot write to {out}", "choose another folder"):
            out.parent.mkdir(parents=True, exist_ok=True)
        yield
    except BaseException:
        for parent in missing:
            with suppress(OSError):
                parent.rmdir()
        raise


@contextmanager
def _workplace(work: Path, out: Path) -> Iterator[Path]:
    with refusals_as(OutputError, f"cannot write to {out}", "choose another folder"):
        work.mkdir(exist_ok=True)
        lock = folder_lock.hold(work)
    pid = os.getpid()
    try:
        yield work
    except TsfusionError as error:  # the user knows the folder by its final name
        error.args = tuple(str(one).replace(str(work), str(out)) for one in error.args)
        raise
    except OSError as error:
        if error.errno in DISK_FULL and Path(error.filename or work).is_relative_to(work):
            raise OutputError(f"cannot write to {out}: {reason_of(error)}") from error
        raise
    finally:
        if os.getpid() == pid:  # a forked process that ends in the block leaves it to its parent
            shutil.rmtree(work, ignore_errors=True)
        lock.close()


def _sweep(place: Path, prefix: str, *, idle_s: float = 0.0) -> None:
    """Remove a killed run's temporary folders, by prefix, that have not changed for `idle_s` seconds."""
    with suppress(OSError):
        for path in [path for path in place.iterdir() if path.name.startswith(prefix)]:
            # Another run is at work there, or the folder is not ours to remove
            with suppress(OSError), folder_lock.hold(path):
                if time.time() - path.stat().st_mtime >= idle_s:
                    shutil.rmtree(path, ignore_errors=True)


def _claim(root: Path, stamp: str) -> tuple[Path, Path]:
    """Make the temporary folder of a new `root/stamp`, numbered if taken; return it and the final folder."""
    for count in itertools.count(1):
        out = root / (stamp if count == 1 else f"{stamp}-{count}")
        work = root / f"{_PARTIAL}{out.name}"
        refused = refusals_as(OutputError, f"cannot write to {out}", "choose another folder")
        with refused, suppress(FileExistsError):  # of a run that started in the same second
            if not out.exists():
                work.mkdir()
                return work, out
    raise AssertionError("the count has no end")


def _point(link: Path, name: str) -> None:
    """Point the link `out/latest` at the newest folder; do nothing on a system without links."""
    new = link.with_name(f".{link.name}-{secrets.token_hex(4)}")
    try:
        new.symlink_to(name)
        new.replace(link)
    except OSError:
        with suppress(OSError):
            new.unlink(missing_ok=True)


def _move(work: Path, out: Path) -> None:
    with refusals_as(OutputError, f"cannot write to {out}", "choose another folder"):
        if not out.exists():
            work.rename(out)
            return
        (out / RECORD).unlink(missing_ok=True)
        for path in sorted(work.iterdir(), key=lambda path: path.name == RECORD):
            path.replace(out / path.name)


# First bytes of files by the ending of their names; those of other endings are unknown
_BEGINNINGS = {
    ".tsf": b"TSFMAP1\n", ".ply": b"ply", ".glb": b"glTF", ".png": b"\x89PNG", ".npz": b"PK", ".pdf": b"%PDF",
    ".las": b"LASF", ".laz": b"LASF", ".pcd": b"# .PCD", ".pgm": b"P5", ".mcap": b"\x89MCAP", ".vdb": b" BDV",
    ".html": b"<!doctype html>",
}  # fmt: skip


def check_writable(
    path: str | os.PathLike[str], endings: tuple[str, ...], *, overwrite: bool = False
) -> None:
    """Raise OutputError unless `path` has one of the endings and a file can be made there; leaves no file.

    With `overwrite` an existing map may be replaced. A file that can be made again, such as a mesh, is always
    replaced. A file whose content does not fit its name is never replaced.
    """
    path = Path(path)
    if path.suffix.lower() not in endings:
        raise OutputError(f"cannot write {path}: expected a name ending in {', '.join(endings)}")
    with refusals_as(OutputError, f"cannot write {path}", "choose another place"):
        tempfile.NamedTemporaryFile(prefix=f".{path.name}.", dir=path.parent).close()
    if path.is_dir():
        raise OutputError(f"cannot write {path}: it is a folder; choose another name")
    begins = _BEGINNINGS.get(path.suffix.lower(), b"")
    with suppress(OSError), path.open("rb") as file:
        there = file.read(len(begins) or 1).lower()
        if there and begins and there != begins.lower():
            raise OutputError(
                f"cannot write {path}: a file is there that is no {path.suffix}; choose another name"
            )
        if there and begins == _BEGINNINGS[".tsf"] and not overwrite:
            raise OutputError(f"cannot write {path}: a map is there; choose another name, or add --overwrite")
