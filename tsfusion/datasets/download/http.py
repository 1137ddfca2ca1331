# SPDX-License-Identifier: MIT
"""One file over HTTP, in as many goes as it takes: what has come stays in a `.part`.

A part goes on only where the server says that it still has the same file (RFC 9110: Range and If-Range).
"""

import errno
import http.client
import re
import time
import urllib.error
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from importlib.metadata import version
from pathlib import Path
from typing import IO, Any

from tsfusion.core import durable_files, folder_lock
from tsfusion.core.errors import DatasetError, OutputError

Watcher = Callable[[int, int], None]  # bytes there, bytes of all (0 = unknown)

_CHUNK_BYTES = 1 << 20
_TIMEOUT_S = 30.0
_GIVE_UP_AFTER = 4  # attempts in a row that brought nothing
_PAUSE_S = 1.0


def download(url: str, part: Path, watch: Watcher) -> None:
    """Complete `part`; another call goes on where one was interrupted, a server without ranges starts again.

    Raises:
        DatasetError: the server refuses, sends a web page, or cannot be reached.
        OutputError: it cannot be written.
    """
    if not url.startswith(("https://", "http://")):
        raise DatasetError(f"cannot download {url}: only https and http are fetched")
    in_vain, said, most = 0, "the connection was cut", _nbytes(part)
    while in_vain < _GIVE_UP_AFTER:
        try:
            if _attempt(url, part, watch):
                _validator_file(part).unlink(missing_ok=True)
                return
            said = "the connection was cut"
        except urllib.error.HTTPError as error:
            error.close()
            said = f"HTTP {error.code} {error.reason}"
            if error.code < 500 and error.code != http.client.TOO_MANY_REQUESTS:
                raise DatasetError(f"cannot download {url}: {said}") from error
        except UnicodeError as error:
            raise DatasetError(f"cannot download {url}: no host can have that name") from error
        except (OSError, http.client.HTTPException) as error:
            said = str(getattr(error, "reason", error)) or type(error).__name__
        in_vain = 0 if _nbytes(part) > most else in_vain + 1  # a part that was begun again is no progress
        most = max(most, _nbytes(part))
        if in_vain < _GIVE_UP_AFTER:
            time.sleep(_PAUSE_S * in_vain)
    raise DatasetError(
        f"cannot download {url}: {said} ({_nbytes(part)} bytes stay in {part}; the same command goes on)"
    )


def _attempt(url: str, part: Path, watch: Watcher) -> bool:
    """One request; whether the file is whole then."""
    start, validator = _nbytes(part), _validator(part)
    headers = {"User-Agent": f"tsfusion/{version('tsfusion')}", "Accept-Encoding": "identity"}
    if start and validator:
        headers |= {"Range": f"bytes={start}-", "If-Range": validator}
    try:
        answer = _opener().open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code != http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        error.close()
        if error.headers.get("Content-Range") == f"bytes */{start}":
            return True
        _forget(part)
        return False
    with answer:
        if answer.headers.get_content_type() == "text/html":
            raise DatasetError(f"cannot download {url}: it answers with a web page; open it in a browser")
        at = _first_byte(answer)
        if at and (at != start or _validator_of(answer) != validator):
            _forget(part)
            return False
        length = answer.headers.get("Content-Length", "")
        total = at + int(length) if length.isdigit() else 0
        _require_room(part, total - at)
        _copy(answer, part, at, total, watch)
    return not total or _nbytes(part) == total


def _copy(answer: Any, part: Path, at: int, total: int, watch: Watcher) -> None:
    with _locked(part) as file:
        if not at:
            _remember(part, _validator_of(answer))
        file.seek(at)
        file.truncate()
        while chunk := answer.read(_CHUNK_BYTES):
            _require_room(part, max(len(chunk), total - at))
            try:
                file.write(chunk)
                file.flush()
            except OSError as error:
                raise _not_written(part, error) from error
            at += len(chunk)
            watch(at, total or at)


@contextmanager
def _locked(part: Path) -> Iterator[IO[bytes]]:
    """The part, open for nobody else."""
    try:
        with folder_lock.hold(part.parent, part.name), part.open("r+b") as file:
            yield file
    except BlockingIOError as error:
        raise OutputError(f"cannot write {part}: another download of it is under way") from error
    except PermissionError as error:
        raise _not_written(part, error) from error


def _first_byte(answer: Any) -> int:
    """Where in the file the answer begins."""
    if answer.status != http.client.PARTIAL_CONTENT:
        return 0
    found = re.match(r"bytes (\d+)-", answer.headers.get("Content-Range", ""))
    return int(found[1]) if found else 0


def _validator_of(answer: Any) -> str:
    """What tells this version of the file from another: a strong ETag, or its date."""
    tag = str(answer.headers.get("ETag") or "")
    return tag if tag.startswith('"') else str(answer.headers.get("Last-Modified") or "")


def _validator_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.version")


def _validator(part: Path) -> str:
    try:
        return _validator_file(part).read_text(encoding="latin-1")
    except OSError:
        return ""


def _remember(part: Path, validator: str) -> None:
    try:
        _validator_file(part).write_text(validator, encoding="latin-1")
    except OSError as error:
        raise _not_written(part, error) from error


def _forget(part: Path) -> None:
    for path in (part, _validator_file(part)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _nbytes(part: Path) -> int:
    try:
        return part.stat().st_size
    except OSError:
        return 0


def _require_room(part: Path, more: int) -> None:
    try:
        durable_files.require_room(part.parent, more)
    except OSError as error:
        raise _not_written(part, error) from error


def _not_written(part: Path, error: OSError) -> OutputError:
    kept = "; what has come stays, and the same command goes on" if error.errno == errno.ENOSPC else ""
    return OutputError(f"cannot write {part}: {error.strerror}{kept}")


class _NoDowngrade(urllib.request.HTTPRedirectHandler):
    """Follows redirects to http and https, but never from https to http."""

    def redirect_request(self, req: Any, *answer: Any) -> Any:
        newurl = str(answer[-1])
        if not newurl.startswith("https://" if req.full_url.startswith("https://") else "http"):
            raise DatasetError(f"cannot download {req.full_url}: it redirects to {newurl}")
        return super().redirect_request(req, *answer)


def _opener() -> urllib.request.OpenerDirector:
    """One for http and https alone."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler,
        urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler,
        urllib.request.HTTPDefaultErrorHandler,
        urllib.request.HTTPErrorProcessor,
        _NoDowngrade,
    ):
        opener.add_handler(handler())
    return opener
