# SPDX-License-Identifier: MIT
"""Where a journal lies: a path of this machine, or a URL such as `s3://bucket/folder` (extra `s3`).

Of a URL nothing is copied: ranges are read as they are needed. Who may read it is for the environment to say
(of S3 `AWS_ACCESS_KEY_ID`, `AWS_ENDPOINT_URL` and the others that its tools know).
"""

import errno
import re
from pathlib import Path
from typing import Any, BinaryIO, cast

from tsfusion.core.errors import JournalError, MissingDependency

_URL = re.compile(r"[a-z][a-z0-9+.-]+://")
_RANGE_BYTES = 4 << 20  # read ahead


def location(text: str) -> Path:
    """The path that a person names; one of a URL has what is used of a `Path` to list and to read.

    Raises:
        MissingDependency: for a URL without the package that reads it.
        JournalError: for a URL of an unknown kind.
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
    """True for the path of a URL."""
    return not isinstance(path, Path)


def absolute(text: str) -> str:
    """Name of a place for a process that runs in another folder."""
    return text if _URL.match(text) else str(Path(text).absolute())


class RemoteFile:
    """A file of a URL, read by ranges.

    Raises:
        OSError: when it cannot be opened.
    """

    def __init__(self, path: Path) -> None:
        remote: Any = path
        with _Translated():
            self._file: BinaryIO = remote.fs.open(
                remote.path, "rb", block_size=_RANGE_BYTES, cache_type="readahead"
            )
            self.size = int(self._file.seek(0, 2))

    def read_at(self, at: int, count: int) -> bytes:
        """Up to `count` bytes from a place on; raises OSError."""
        with _Translated():
            self._file.seek(at)
            return self._file.read(count)

    def close(self) -> None:
        """Release it."""
        self._file.close()


class _Translated:
    """Errors of whatever library reads a URL, as an OSError that is not one of a bad disk."""

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
