# SPDX-License-Identifier: MIT
"""Open a journal on this machine, or at a URL such as `s3://bucket/folder` (needs the extra `s3`).

A journal at a URL is not copied: byte ranges are read on demand. Credentials come from the environment (for
S3 `AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL` and the other variables that its tools know).
"""

import errno
import re
from pathlib import Path
from typing import Any, BinaryIO, cast

from tsfusion.core.errors import JournalError, MissingDependency

_URL = re.compile(r"[a-z][a-z0-9+.-]+://")
_RANGE_BYTES = 4 << 20  # read ahead


def location(text: str) -> Path:
    """Return the path for a text; the path of a URL has the methods of `Path` that list and read.

    Raises:
        MissingDependency: a URL needs a package that is not installed.
        JournalError: the URL is of an unknown kind.
    """
    if not _URL.match(text):
        return Path(text)
    try:
        from upath import UPath

        path: Any = UPath(text)
        assert path.fs is not None  # the package is loaded here
        return cast(Path, path)
    except ImportError as error:
        raise MissingDependency(
            f"reading {text} needs another package ({error}): run `pip install '.[s3]'` in a clone"
        ) from error
    except ValueError as error:
        raise JournalError(f"{text} cannot be read: {error}; give s3:// or the path of a folder") from error


def is_url(path: Path) -> bool:
    """Return True if a path is the path of a URL."""
    return not isinstance(path, Path)


def absolute(text: str) -> str:
    """Return a URL unchanged, or a local path made absolute, to give it to a process in another folder."""
    return text if _URL.match(text) else str(Path(text).absolute())


class RemoteFile:
    """A file at a URL, read by byte ranges.

    Raises:
        OSError: the file cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        remote: Any = path
        with _Translated():
            self._file: BinaryIO = remote.fs.open(
                remote.path, "rb", block_size=_RANGE_BYTES, cache_type="readahead"
            )
            self.size = int(self._file.seek(0, 2))

    def read_at(self, at: int, count: int) -> bytes:
        """Return up to `count` bytes from offset `at`; raises OSError."""
        with _Translated():
            self._file.seek(at)
            return self._file.read(count)

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class _Translated:
    """Context that turns errors of URL libraries into OSError, but never EIO, which means a bad disk."""

    def __enter__(self) -> None:
        pass

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, where: object) -> None:
        if not isinstance(error, Exception):
            return
        if isinstance(error, OSError) and error.errno not in (None, errno.EIO):
            return
        missing = isinstance(error, FileNotFoundError)
        number = errno.ENOENT if missing else errno.EREMOTEIO if hasattr(errno, "EREMOTEIO") else errno.EPROTO
        raise OSError(number, f"{type(error).__name__}: {error}") from error
