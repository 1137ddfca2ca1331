# SPDX-License-Identifier: MIT
"""Download one file over HTTP in as many requests as needed. Received bytes stay in a `.part` file.

A `.part` file is continued only if the server still has the same file (RFC 9110: Range and If-Range).
"""

import errno
import http.client
import re
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from tsfusion.core import durable_files, folder_lock
from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import DatasetError, OutputError
from tsfusion.core.process import version_of
from tsfusion.core.readable_numbers import OnProgress

_CHUNK_BYTES = 1 << 20
_TIMEOUT_S = 30.0
_GIVE_UP_AFTER = 4  # requests in a row without a new byte
_PAUSE_S = 1.0


def download(url: str, part: Path, watch: OnProgress) -> None:
    """Complete `part` from where an earlier call stopped; start again if the server supports no ranges.

    Raises:
        DatasetError: the server refuses, sends a web page, or cannot be reached.
        OutputError: the file cannot be written.
    """
    if not url.startswith(("https://", "http://")):
        raise DatasetError(f"cannot download {url}: only https and http are fetched")
    fruitless, cause, most = 0, "the connection was cut", size_of(part)
    while fruitless < _GIVE_UP_AFTER:
        try:
            if _request(url, part, watch):
                _validator_file(part).unlink(missing_ok=True)
                return
            cause = "the connection was cut"
        except urllib.error.HTTPError as error:
            error.close()
            cause = f"HTTP {error.code} {error.reason}"
            if error.code < 500 and error.code != http.client.TOO_MANY_REQUESTS:
                raise DatasetError(f"cannot download {url}: {cause}") from error
        except UnicodeError as error:
            raise DatasetError(f"cannot download {url}: no host can have that name") from error
        except (OSError, http.client.HTTPException) as error:
            cause = str(getattr(error, "reason", error)) or type(error).__name__
        fruitless = 0 if size_of(part) > most else fruitless + 1  # a file that starts again is no progress
        most = max(most, size_of(part))
        if fruitless < _GIVE_UP_AFTER:
            time.sleep(_PAUSE_S * fruitless)
    raise DatasetError(
        f"cannot download {url}: {cause} ({size_of(part)} bytes stay in {part}; the same command goes on)"
    )


def _request(url: str, part: Path, watch: OnProgress) -> bool:
    """Send one request for the missing bytes. Return True if the file is then complete."""
    start, validator = size_of(part), _validator(part)
    headers = {"User-Agent": f"tsfusion/{version_of('tsfusion')}", "Accept-Encoding": "identity"}
    if start and validator:
        headers |= {"Range": f"bytes={start}-", "If-Range": validator}
    try:
        response = _opener().open(urllib.request.Request(url, headers=headers), timeout=_TIMEOUT_S)
    except urllib.error.HTTPError as error:
        if error.code != http.client.REQUESTED_RANGE_NOT_SATISFIABLE:
            raise
        error.close()
        if error.headers.get("Content-Range") == f"bytes */{start}":
            return True
        _remove_part(part)
        return False
    with response:
        if response.headers.get_content_type() == "text/html":
            raise DatasetError(f"cannot download {url}: it answers with a web page; open it in a browser")
        at = _first_byte(response)
        if at and (at != start or _validator_of(response) != validator):
            _remove_part(part)
            return False
        length = response.headers.get("Content-Length", "")
        total = at + int(length) if length.isdigit() else 0
        _require_room(part, total - at)
        _copy(response, part, at, total, watch)
    return not total or size_of(part) == total


def _copy(response: Any, part: Path, at: int, total: int, watch: OnProgress) -> None:
    with _locked(part) as file:
        if not at:
            _write_validator(part, _validator_of(response))
        file.seek(at)
        file.truncate()
        while chunk := response.read(_CHUNK_BYTES):
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
    try:
        with folder_lock.hold(part.parent, part.name), part.open("r+b") as file:
            yield file
    except BlockingIOError as error:
        raise OutputError(f"cannot write {part}: another download of it is under way") from error
    except PermissionError as error:
        raise _not_written(part, error) from error


def _first_byte(response: Any) -> int:
    """Return the position in the file of the first byte that a response sends."""
    if response.status != http.client.PARTIAL_CONTENT:
        return 0
    found = re.match(r"bytes (\d+)-", response.headers.get("Content-Range", ""))
    return int(found[1]) if found else 0


def _validator_of(response: Any) -> str:
    """Return what names the server's version of the file: a strong ETag, or a date; empty without either."""
    tag = str(response.headers.get("ETag") or "")
    return tag if tag.startswith('"') else str(response.headers.get("Last-Modified") or "")


def _validator_file(part: Path) -> Path:
    return part.with_name(f"{part.name}.version")


def _validator(part: Path) -> str:
    try:
        return _validator_file(part).read_text(encoding="latin-1")
    except OSError:
        return ""


def _write_validator(part: Path, validator: str) -> None:
    try:
        _validator_file(part).write_text(validator, encoding="latin-1")
    except OSError as error:
        raise _not_written(part, error) from error


def _remove_part(part: Path) -> None:
    for path in (part, _validator_file(part)):
        with suppress(OSError):
            path.unlink(missing_ok=True)


def _require_room(part: Path, more: int) -> None:
    try:
        durable_files.require_room(part.parent, more)
    except OSError as error:
        raise _not_written(part, error) from error


def _not_written(part: Path, error: OSError) -> OutputError:
    kept = "; what has come stays, and the same command goes on" if error.errno == errno.ENOSPC else ""
    return OutputError(f"cannot write {part}: {error.strerror}{kept}")


class _NoDowngrade(urllib.request.HTTPRedirectHandler):
    """Follow redirects to http and https, but never from https to http."""

    def redirect_request(self, req: Any, *response: Any) -> Any:
        newurl = str(response[-1])
        if not newurl.startswith("https://" if req.full_url.startswith("https://") else "http"):
            raise DatasetError(f"cannot download {req.full_url}: it redirects to {newurl}")
        return super().redirect_request(req, *response)


def _opener() -> urllib.request.OpenerDirector:
    """Return an opener for http and https only."""
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
