# SPDX-License-Identifier: MIT
"""`tsfusion map forget`: remove keyframes from a map for good."""

import re
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options, verbs
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.wire.messages.forget_messages import Forgotten, Selection

_EXAMPLES = (
    "tsfusion map forget my-maps --session 3f2a91bc",
    "tsfusion map forget tcp://server:5555 --client robot1 --since 90 --erase",
)
_KEPT = "their records are still in the journal: --erase deletes them, also later"
_REMAINS = (
    "of each erased keyframe the journal keeps session, number and client, so that it is not taken again, "
    "and the corrected poses that its client sent",
    "not touched: meshes, pictures and maps that were exported (OUT/map.tsf), copies and snapshots of the "
    "disk, and what waits in a scanner's spool (`tsfusion spool list` there)",
)


def register(app: typer.Typer) -> None:
    """Add `forget` to the verbs of `tsfusion map`."""
    verbs.verb(app, *_EXAMPLES)(forget)


def forget(
    where: Annotated[
        str,
        typer.Argument(
            metavar="STATE|ADDRESS",
            help="A state folder that no server uses, or a server: tcp://HOST:PORT.",
        ),
    ],
    *,
    session: Annotated[
        str | None, typer.Option(metavar="ID", help="Session with an id that begins so.")
    ] = None,
    client: Annotated[str | None, typer.Option(metavar="NAME", help="Client, by its key's name.")] = None,
    since: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="From this time: ISO, or seconds before end."),
    ] = None,
    until: Annotated[str | None, typer.Option(metavar="TIME", help="Up to this time, as --since.")] = None,
    keyframes: Annotated[
        str | None, typer.Option(metavar="NUMBERS", help="Numbers in the session, such as 3-17,20.")
    ] = None,
    box: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(
            metavar="X Y Z X Y Z",
            help="Sensor and 90 % of points in this box, m.",
        ),
    ] = None,
    erase: Annotated[bool, typer.Option("--erase", help="Delete their bytes in the journal, too.")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Only print what would be forgotten.")] = False,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    map_: Annotated[str | None, typer.Option("--map", metavar="NAME", help="Name of the map.")] = None,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Take keyframes out of a map for good, exactly: as if they had never come.

    Several flags select what fits all of them; `journal info` lists sessions.
    A running server's map follows in a while (`status`: corrections_waiting).
    No correction brings them back; a keyframe that arrives later is new.
    With keys, a client may forget its own keyframes, and those of others
    after `tsfusion keys allow NAME --forget`.

    Exit status 1 also when nothing fits, or when some that fit stay in the
    map because its journal no longer has them.
    """
    import msgspec

    from tsfusion.cli import output
    from tsfusion.core.errors import JournalError

    selection = _selection(
        session=session, client=client, since=since, until=until, keyframes=keyframes, box=box
    )
    link = {"control": control, "key": key, "server_key": server_key}
    with _target(where, map_, link, changes=not dry_run, quiet=json) as ask:
        found = ask(selection, erase=False, dry_run=True)
        if not found.selected and not found.unavailable:
            raise JournalError(f"{where}: no keyframe fits, so nothing is forgotten")
        if not dry_run and (found.keyframes or (erase and found.selected)):
            _confirm(found, erase=erase, yes=yes)
            found = ask(selection, erase=erase, dry_run=False)
    counts = {"dry_run": dry_run, "keyframes": found.keyframes, "selected": found.selected}
    lines = _lines(found, erase=erase, dry_run=dry_run)
    output.result({**counts, **msgspec.structs.asdict(found)}, "\n".join(lines), json=json)
    if found.unavailable:
        raise JournalError(
            "keyframes that the journal no longer has stay in the map, although they fit: of session "
            + "; ".join(found.unavailable)
        )


def _selection(
    *,
    session: str | None,
    client: str | None,
    since: str | None,
    until: str | None,
    keyframes: str | None,
    box: tuple[float, ...] | None,
) -> "Selection":
    """Return the selection that the flags name. Raise InvalidConfig for a bad flag, or without any flag."""
    import math

    from tsfusion.core import number_ranges
    from tsfusion.core.config import make_settings
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.wire.messages.forget_messages import Selection

    if box is not None and not all(map(math.isfinite, box)):
        raise InvalidConfig(f"--box must be six finite numbers, got {' '.join(map(str, box))}")
    if session is not None and not re.fullmatch("[0-9a-fA-F]{1,32}", session):
        raise InvalidConfig(f"--session must be how a session's id begins, such as 3f2a91bc, got {session!r}")
    made = make_settings(
        Selection,
        {
            "session": (session or "").lower(),
            "client": client,
            "since_ns": None if since is None else _moment_ns(since),
            "until_ns": None if until is None else _moment_ns(until),
            "numbers": None if keyframes is None else number_ranges.parse(keyframes),
            "box": box,
        },
    )
    if made.is_empty:
        raise InvalidConfig(
            "name what is to be forgotten: --session, --client, --since, --until, --keyframes or --box"
        )
    return made


def _moment_ns(text: str) -> int:
    """Return a time in ns of the wall clock; a negative number counts back from the last record."""
    import time

    from tsfusion.journal import journaled_keyframes

    now = time.time_ns()
    try:
        float(text)
    except ValueError:
        return journaled_keyframes.moment_ns(text, now)
    return min(journaled_keyframes.moment_ns(text, now) - now, -1)


@contextmanager
def _target(
    where: str, map_: str | None, link: dict[str, str | None], *, changes: bool, quiet: bool
) -> "Iterator[Callable[..., Forgotten]]":
    """Yield a function that forgets keyframes, of a server's map or of a map that no server uses."""
    if "://" in where:
        from tsfusion.core.config import DEFAULT_MAP
        from tsfusion.wire.asking import queries
        from tsfusion.wire.sockets.curve import client_keys

        keys = client_keys(link["key"], link["server_key"])
        at = {"control": link["control"], "map_name": map_ or DEFAULT_MAP, "keys": keys}
        yield partial(queries.forget, where, **at)  # type: ignore[arg-type]
        return
    from tsfusion.cli import progress
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.pipelines.maps.private_server import open_state

    if given := [name for name, value in link.items() if value is not None]:
        flag = "--" + given[0].replace("_", "-")
        raise InvalidConfig(f"{flag} has no effect on {where}: only a live server (tcp://…) has one")
    with progress.shown(quiet=quiet) as display:
        display.stage(f"opening the map of {where}")
        with open_state(Path(where), map_, changes=changes) as opened:
            display.stage(f"looking for keyframes in {where}")
            yield opened.forget


def _confirm(found: "Forgotten", *, erase: bool, yes: bool) -> None:
    """Ask the user to confirm. Raise InvalidConfig if there is no terminal to ask at."""
    from tsfusion.core.errors import InvalidConfig

    what = f"{count_of(found.selected, 'keyframe')} of {count_of(len(found.sessions), 'session')}"
    what += " would be forgotten" + (" and erased" if erase else "")
    if yes:
        return
    if not sys.stdin.isatty():
        raise InvalidConfig(f"{what}, for good: say --yes")
    typer.echo("\n".join(_rows(found)), err=True)
    typer.confirm(f"{what}, for good. Go on?", abort=True, err=True)


def _lines(found: "Forgotten", *, erase: bool, dry_run: bool) -> list[str]:
    what = count_of(found.keyframes, "keyframe")
    if dry_run:
        known = found.selected - found.keyframes
        more = f"; {count_of(known, 'more that fits is', 'more that fit are')} forgotten already"
        return [f"{what} would be forgotten{more if known else ''}", *_rows(found)]
    lines = [f"forgot {what}", *_rows(found)]
    if not erase:
        return [*lines, _KEPT]
    aside = f", and {count_of(found.quarantined, 'file')} of the quarantine" if found.quarantined else ""
    lines.append(f"erased {count_of(found.erased, 'record')} of the journal{aside}")
    lines += [f"left: {note}" for note in _REMAINS]
    return lines + [f"left: {path} (delete it, if it is not needed)" for path in found.remains]


def _rows(found: "Forgotten") -> list[str]:
    from tsfusion.cli.output import first_of

    return first_of(
        [f"  {one.session[:8]}  {one.client or 'no key':<12} {one.numbers}" for one in found.sessions]
    )
