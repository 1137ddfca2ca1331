# SPDX-License-Identifier: MIT
"""Selection of records of a journal: times and sessions as a person writes them."""

import datetime
import math
from collections.abc import Mapping

from tsfusion.core.errors import InvalidConfig, JournalError
from tsfusion.journal.mcap_layout import Record
from tsfusion.journal.record_scan import scan_records
from tsfusion.journal.state_folder import JournalPlace

_LEAST_DIGITS = 4  # of a session's name


def last_logged_ns(place: JournalPlace) -> int:
    """Wall clock of the last record of a journal; raises JournalError when there is none."""
    for file in reversed(place.files()):
        stamps = [step.logged_ns for step in scan_records(file) if isinstance(step, Record)]
        if stamps:
            return max(stamps)
    raise JournalError(
        f"no keyframes in {place.path}; expected a state folder, a spool folder or an .mcap file"
    )


def moment_ns(text: str, last_ns: int) -> int:
    """The wall clock that a person means.

    Args:
        text: seconds before the last record, such as `90`, or an ISO time such as `2026-05-01 14:30` (this
            machine's zone) or `2026-05-01T12:30:00Z`.
        last_ns: of the last record.

    Raises:
        InvalidConfig: for anything else.
    """
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if 0 <= seconds < math.inf:
        return last_ns - round(seconds * 1e9)
    try:
        moment = datetime.datetime.fromisoformat(text.strip().replace("Z", "+00:00"))
        return round(moment.timestamp() * 1e9)
    except (ValueError, OverflowError, OSError) as error:
        raise InvalidConfig(
            f"a time must be seconds before the last record, such as 90, or ISO such as "
            f"{clock(last_ns)} (when that was), got {text!r}"
        ) from error


def clock(stamp_ns: int) -> str:
    """A wall clock as `moment_ns` reads it, to the second."""
    try:
        moment = datetime.datetime.fromtimestamp(stamp_ns / 1e9, tz=datetime.timezone.utc)
    except (OverflowError, OSError, ValueError):
        return f"{stamp_ns} ns"
    return moment.strftime("%Y-%m-%d %H:%M:%SZ")


def sessions_named(name: str, clients: Mapping[bytes, str]) -> list[bytes]:
    """The sessions of a client, or the one session that begins with these digits.

    Args:
        clients: session → name of its client; empty = no keys.

    Raises:
        JournalError: when there is none, or when several sessions begin so; it lists what there is.
    """
    if found := [key for key, client in clients.items() if name and client == name]:
        return found
    if len(name) >= _LEAST_DIGITS:
        found = [key for key in clients if key.hex().startswith(name.lower())]
    if len(found) == 1:
        return found
    there = ", ".join(f"{key.hex()[:8]} ({client or 'no key'})" for key, client in clients.items())
    problem = "several sessions begin with" if found else "no session or client is named"
    raise JournalError(f"{problem} {name!r}; the journal has {there or 'none'}")
