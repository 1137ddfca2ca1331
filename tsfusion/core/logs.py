# SPDX-License-Identifier: MIT
"""Write log lines to stderr, as text or as one JSON object a line; a flood of one message is shortened."""

import json
import logging
import sys
import time
from collections.abc import Callable, Iterator
from datetime import datetime, timezone
from types import TracebackType
from typing import TYPE_CHECKING, Any

from tsfusion.core.config import LogFormat, LogLevel
from tsfusion.core.readable_numbers import fitted

if TYPE_CHECKING:
    _Handler = logging.StreamHandler[Any]
else:
    _Handler = logging.StreamHandler  # takes no type before Python 3.11


ABOUT = ("map", "session", "seq", "client", "reason")  # the subjects that a line may name
MESSAGE_CHARACTERS = 2000  # messages quote what peers sent
TRACE_CHARACTERS = 20_000
MOST, PERIOD = 20, 60.0  # lines from one place in the code, in so many seconds

log = logging.getLogger(__name__)


def configure(format: LogFormat, level: LogLevel, process: str = "server", *, map: str | None = None) -> None:
    """Log to stderr from now on; every line contains `process` (server or fuser).

    `map`: the map in every line that names no other map. Only tsfusion's own loggers are set to `level`;
    other packages log warnings and errors.
    """
    formatter = (JsonFormatter if format == "json" else TextFormatter)(process, map)
    for handler in logging.root.handlers[:]:
        if isinstance(handler, Stderr):
            logging.root.removeHandler(handler)
            handler.close()
    made = Stderr(Limiter())
    made.setFormatter(formatter)
    logging.root.addHandler(made)
    logging.getLogger("tsfusion").setLevel(level.upper())
    sys.excepthook = _log_unexpected if format == "json" else sys.__excepthook__


def name_map(map: str) -> None:
    """Set the map of this process: later log lines contain it unless they name another map."""
    for handler in logging.root.handlers:
        if isinstance(handler.formatter, TextFormatter | JsonFormatter):
            handler.formatter.map = map


def about(
    *,
    map: str | None = None,
    session: bytes | str | None = None,
    seq: int | None = None,
    client: str | None = None,
    reason: str | None = None,
) -> dict[str, Any]:
    """Return the subject of a line: `log.warning("…", extra=logs.about(session=key, seq=7))`.

    A session is shown by its first 8 hexadecimal digits; None and empty values are left out.
    """
    shown = session.hex() if isinstance(session, bytes) else session
    given = {"map": map, "session": shown and shown[:8], "seq": seq, "client": client, "reason": reason}
    return {"about": {key: value for key, value in given.items() if value not in (None, "")}}


def log_left_out() -> None:
    """Log the number of suppressed lines, once their period is over. Call this about once a second."""
    for handler in logging.root.handlers:
        if isinstance(handler, Stderr):
            handler.log_left_out()


def printable(text: str, most: int = MESSAGE_CHARACTERS) -> str:
    """Return text on one line without terminal commands: unprintable characters escaped, `…` if shortened."""
    cut = text if len(text) <= most else text[:most] + "…"
    if cut.isprintable():
        return cut
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in cut)


class TextFormatter(logging.Formatter):
    """Formats lines such as `tsfusion: WARNING: a message is refused (map yard, session 1a2b3c4d, seq 7)`."""

    def __init__(self, process: str, map: str | None = None) -> None:
        super().__init__()
        self.map = map
        self._name = "tsfusion" if process == "server" else f"tsfusion {process}"

    def format(self, record: logging.LogRecord) -> str:
        """Return one line; a traceback follows on further lines."""
        subject = ", ".join(f"{key} {value}" for key, value in _about(record, self.map).items())
        line = f"{self._name}: {record.levelname}: {printable(record.getMessage())}"
        trace = _trace(record)
        return line + (f" ({subject})" if subject else "") + (f"\n{trace}" if trace else "")


class JsonFormatter(logging.Formatter):
    """Formats one JSON object a line: time (UTC), level, process, logger, message, subject, exception."""

    def __init__(self, process: str, map: str | None = None) -> None:
        super().__init__()
        self.map = map
        self._process = process

    def format(self, record: logging.LogRecord) -> str:
        """Return one line of ASCII: none of its characters breaks a line or a terminal."""
        at = datetime.fromtimestamp(record.created, timezone.utc).isoformat(timespec="milliseconds")
        fields = {
            "time": at.replace("+00:00", "Z"),
            "level": record.levelname.lower(),
            "process": self._process,
            "logger": record.name,
            "message": printable(record.getMessage()),
            **_about(record, self.map),
        }
        if trace := _trace(record):
            fields["exception"] = trace
        return json.dumps(fields)


def _about(record: logging.LogRecord, map: str | None) -> dict[str, Any]:
    given = about(map=map)["about"] | getattr(record, "about", {})
    shown = {key: given[key] for key in ABOUT if key in given}
    return {key: value if isinstance(value, int) else printable(str(value)) for key, value in shown.items()}


def _trace(record: logging.LogRecord) -> str:
    text = logging.Formatter().formatException(record.exc_info) if record.exc_info else ""
    return text if len(text) <= TRACE_CHARACTERS else "…" + text[-TRACE_CHARACTERS:]


class Stderr(_Handler):
    """Handler that writes to standard error, within the limits of its `Limiter`."""

    def __init__(self, limiter: "Limiter") -> None:
        super().__init__(sys.stderr)
        self._limiter = limiter

    def emit(self, record: logging.LogRecord) -> None:
        """Write a log record unless there were too many like it; the caller holds the handler's lock."""
        self._write(self._limiter.finished_periods())
        if self._limiter.allows(record):
            super().emit(record)

    def format(self, record: logging.LogRecord) -> str:
        """Return the record's line; text is broken between words for a narrower terminal."""
        line: str = super().format(record)
        return fitted(line, self.stream) if isinstance(self.formatter, TextFormatter) else line

    def log_left_out(self) -> None:
        """Write how many lines were suppressed at each place in the code whose period is over."""
        with self.lock:  # type: ignore[union-attr]
            self._write(self._limiter.finished_periods())

    def close(self) -> None:
        """Log the number of suppressed lines, even of a period that is not over."""
        self._write(self._limiter.finished_periods(everything=True))
        super().close()

    def _write(self, records: Iterator[logging.LogRecord]) -> None:
        for record in records:
            super().emit(record)


class Limiter:
    """Allows `most` lines in each period from each place in the code, and counts further lines.

    Errors are limited, too, because a peer or a disk can cause them. Critical lines always pass.
    """

    def __init__(
        self, most: int = MOST, period: float = PERIOD, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._most, self._period, self._clock = most, period, clock
        # The key is the place and not the message: places are few, whatever peers send.
        self._places: dict[tuple[str, int], _LogPlace] = {}

    def allows(self, record: logging.LogRecord) -> bool:
        """Let a record pass, or count it and return False."""
        if record.levelno >= logging.CRITICAL:
            return True
        place = self._places.setdefault((record.pathname, record.lineno), _LogPlace(self._clock()))
        place.count += 1
        if place.count <= self._most:
            return True
        place.last = record
        return False

    def finished_periods(self, *, everything: bool = False) -> Iterator[logging.LogRecord]:
        """End the periods that are over; yield a summary for each place in the code with suppressed lines."""
        before = self._clock() - self._period
        for key, place in list(self._places.items()):
            if everything or place.began <= before:
                del self._places[key]
                if place.last is not None:
                    yield _summary(place.last, place.count - self._most, self._period)


class _LogPlace:
    def __init__(self, began: float) -> None:
        self.began = began
        self.count = 0
        self.last: logging.LogRecord | None = None


def _summary(last: logging.LogRecord, count: int, period: float) -> logging.LogRecord:
    message = f"{count} more like this were left out in {period:.0f} s: {last.getMessage()}"
    return logging.makeLogRecord(
        {**last.__dict__, "msg": message, "args": None, "exc_info": None, "created": time.time(), "about": {}}
    )


def _log_unexpected(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    """Log an unhandled error as one JSON object, like every other line."""
    log.critical("unexpected: %s", error or kind.__name__, exc_info=(kind, error, trace))
