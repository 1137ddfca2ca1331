# SPDX-License-Identifier: MIT
"""`tsfusion spool list|send|drop`: list, send or delete keyframes that wait for a server."""

import sys
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options, verbs
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from collections.abc import Callable

    from tsfusion.client import Client
    from tsfusion.core.config import ClientConfig
    from tsfusion.delivery.left_spools import LeftSpool

app = typer.Typer(
    cls=verbs.Group,
    help="""List, send or delete keyframes that wait here for a server.

    A scan to a server writes each keyframe to a spool first, and the server's acknowledgement takes it out.
    What a server did not have at the end of a scan stays there. The next scan sends it to the map it was made
    for, when that map has the same world or is new; else it waits until you send it elsewhere or drop it.
    """,
)
SpoolFlag = Annotated[
    Path, typer.Option("--spool", metavar="DIR", envvar="TSFUSION_SPOOL", help="The folder of spools.")
]
_FOLDER = Path("tsfusion-spool")
_POLL = 0.05  # seconds
_AGES = ((86400.0, "d"), (3600.0, "h"), (60.0, "min"), (1.0, "s"))


@verbs.verb(app, "tsfusion spool list", "tsfusion spool list /robot/spool", name="list")
def list_(
    folder: Annotated[Path | None, typer.Argument(metavar="[DIR]", help="The folder of spools.")] = None,
    *,
    spool: SpoolFlag = _FOLDER,
    json: options.Json = False,
) -> None:
    """List the spools in which keyframes wait: map, world, keyframes, bytes, age; oldest first.

    Exit status 1 where damage has destroyed some.
    """
    from tsfusion.core.errors import IncompleteRun
    from tsfusion.delivery import left_spools

    spool = folder or spool
    _check_there(spool)
    rows = [(left, *left.count()) for left in left_spools.find(spool)]
    if json:
        from tsfusion.cli import output

        output.as_json([_record(*row) for row in rows])
    elif rows:
        _print(rows)
    else:
        typer.echo(f"no keyframes wait in {spool}", err=True)
    if damaged := left_spools.damaged(spool):
        raise IncompleteRun("; ".join(map(_lost, damaged, damaged.values())))


def _lost(folder: Path, count: int) -> str:
    return f"{folder}: {count_of(count, 'record is', 'records are')} damaged: what had not been sent is lost"


def _print(rows: "list[tuple[LeftSpool, int, int, int]]") -> None:
    width = max(len(left.folder.name) for left, *_ in rows)
    typer.echo(f"{'spool':<{width}}  {'map':<16}  {'world':<8}  {'keyframes':>9}  {'bytes':>8}  age")
    for left, keyframes, _, nbytes in rows:
        typer.echo(_line(left, keyframes, nbytes, width))


def _record(left: "LeftSpool", keyframes: int, corrections: int, nbytes: int) -> dict[str, object]:
    return {
        "folder": str(left.folder), "map": left.map, "world": left.world, "session": left.session.hex(),
        "keyframes": keyframes, "corrections": corrections, "bytes": nbytes, "since_ns": left.since_ns,
        "used_by": left.used_by,
    }  # fmt: skip


def _line(left: "LeftSpool", keyframes: int, nbytes: int, width: int) -> str:
    from tsfusion.cli.output import size

    seconds = max(time.time() - left.since_ns / 1e9, 0.0)
    unit, name = next((each for each in _AGES if seconds >= each[0]), _AGES[-1])
    used = f"  in use (pid {left.used_by})" if left.used_by else ""
    world = left.world[:8] or left.session.hex()[:8]
    return (
        f"{left.folder.name:<{width}}  {left.map:<16}  {world:<8}  {keyframes:>9}  {size(nbytes):>8}  "
        f"{seconds / unit:.0f} {name}{used}"
    )


@verbs.verb(app, "tsfusion spool send --connect tcp://server:5555", "tsfusion spool send default --map auto")
def send(
    names: Annotated[
        list[str] | None,
        typer.Argument(metavar="[DIR] [SPOOL]...", help="Names as `list` shows them; default: all."),
    ] = None,
    *,
    spool: SpoolFlag = _FOLDER,
    connect: options.Connect = None,
    control: options.Control = None,
    map_: options.NewMap = None,
    same_frame: options.SameFrame = False,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    config: options.ConfigFile = None,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Send what waits, each spool to the map it was made for, or to another one (--map).

    Exit status 1 when not all of it is on the server's disk at the end; the rest stays in its spool.
    """
    from tsfusion.cli import output
    from tsfusion.core.config import override
    from tsfusion.core.errors import TransportError
    from tsfusion.delivery import left_spools

    if names and Path(names[0]).is_dir() and not (spool / names[0]).is_dir():
        spool, names = Path(names[0]), names[1:]
    chosen = _choose(spool, names)
    folders = {one.folder for one in chosen}
    damaged = {  # counted first: a file is deleted when the rest of it is sent
        folder: count
        for folder, count in left_spools.damaged(spool).items()
        if folder in folders or not names
    }
    given = {"control": control, "key": key, "server_key": server_key}
    link = override(options.configuration(config).client, address=connect, **given)
    left, reasons = 0, []
    for one in chosen:
        name, waiting, why = _send(one, link, map_, same_frame=same_frame, quiet=json)
        left += waiting
        if json:
            output.as_json({"folder": str(one.folder), "map": name, "left": waiting, "why": why})
        else:
            typer.echo(f"{one.folder} → map {name}: {f'{waiting} not sent' if waiting else 'all sent'}")
        if why:
            reasons.append(f"{one.folder}: {why}")
    if not chosen:
        typer.echo(f"no keyframes wait in {spool}", err=True)
    if reasons or damaged:
        kept = count_of(
            left,
            "keyframe did not get through and stays where it is",
            "keyframes did not get through and stay where they are",
        )
        told = "; ".join([*reasons, *map(_lost, damaged, damaged.values())])
        raise TransportError(f"{kept}: {told}" if left else told)


def _check_there(spool: Path) -> None:
    """Raise JournalError for a folder that the user named and that does not exist."""
    from tsfusion.core.errors import JournalError

    if spool != _FOLDER and not spool.is_dir():
        raise JournalError(f"{spool} is no folder; expected the one that a scan had as --spool")


def _choose(root: Path, names: list[str] | None) -> "list[LeftSpool]":
    """Return the spools with these names. Raise JournalError for a name without a spool."""
    from tsfusion.core.errors import JournalError
    from tsfusion.delivery import left_spools

    _check_there(root)
    found = {left.folder.name: left for left in left_spools.find(root)}
    if unknown := [name for name in names or () if name not in found]:
        there = ", ".join(found) or "none"
        raise JournalError(f"no keyframes wait in a spool {unknown[0]} of {root}; spools there: {there}")
    return [found[name] for name in names] if names else list(found.values())


def _send(
    left: "LeftSpool", link: "ClientConfig", map_: str | None, *, same_frame: bool, quiet: bool
) -> tuple[str, int, str]:
    """Send a spool. Return the map, the number of records not sent, and why (empty if all were sent)."""
    from tsfusion.cli import progress
    from tsfusion.client import Client
    from tsfusion.core.errors import TsfusionError
    from tsfusion.delivery.spool import Spool
    from tsfusion.pipelines.runs import target_server

    try:
        name = target_server.map_to_send_to(link, map_ or left.map, left.map)
        opened = Spool(
            left.folder, link.segment_bytes,
            map_name=name, world=left.own_world, same_frame=same_frame, elsewhere=True,
        )  # fmt: skip
    except TsfusionError as error:
        keyframes, corrections, _ = left.count()
        return map_ or left.map, keyframes + corrections, str(error)
    with (
        Client(link.address, spool=opened, control=link.control, config=link) as client,
        progress.reading(f"sending {left.folder}", quiet=quiet) as watch,
    ):
        why = _wait(client, watch, link.address, link.connect_timeout)
        stats = client.stats
        if refused := sum(stats.refused.values()):
            why = why or f"the server refused {refused} for good; they are in {left.folder / 'refused'}"
        if corrections := sum(stats.corrections_refused.values()):
            count = count_of(corrections, "correction was", "corrections were")
            why = "; ".join(filter(None, (why, f"{count} not taken, see the log")))
        return name, stats.waiting + refused, why


def _wait(client: "Client", watch: "Callable[[int, int], None]", address: str, patience: float) -> str:
    """Wait until the spool is empty. Return why not, if no record left it for `patience` seconds."""
    total = client.stats.waiting_bytes
    last, moved = total, time.monotonic()
    while client.stats.waiting and not client.is_of_other_world:
        watch(total - last, total)
        if (now := client.stats.waiting_bytes) != last:
            last, moved = now, time.monotonic()
        elif time.monotonic() - moved > patience:
            silent = f"nothing was taken for {patience:g} s; is `tsfusion serve` running at {address}?"
            return client.problem or silent
        time.sleep(_POLL)
    return client.problem if client.stats.waiting else ""


@verbs.verb(app, "tsfusion spool drop default", "tsfusion spool drop default.2 --yes")
def drop(
    name: Annotated[str, typer.Argument(metavar="SPOOL", help="Name as `list` shows it.")],
    *,
    spool: SpoolFlag = _FOLDER,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Delete the keyframes that wait in a spool: no server will get them."""
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.delivery import left_spools

    (left,) = _choose(spool, [name])
    keyframes, _, _ = left.count()
    what = f"{count_of(keyframes, 'keyframe')} for the map {left.map} in {left.folder}"
    if not yes:
        if not sys.stdin.isatty():
            raise InvalidConfig(f"{what} would be deleted: say --yes")
        typer.confirm(f"Delete {what}?", abort=True)
    left_spools.drop(left)
    typer.echo(f"deleted {what}")
