# SPDX-License-Identifier: MIT
"""`tsfusion status`: show the health of a server, once or repeatedly."""

import sys
import time
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from tsfusion.cli import options, verbs

if TYPE_CHECKING:
    from tsfusion.cli.health_poll import ServerSnapshot, ServerWatcher

PLAIN_WIDTH = 160  # columns if there is no terminal


def status(
    server: Annotated[
        str | None, typer.Argument(metavar="[ADDRESS]", help="tcp://HOST:PORT of the server.")
    ] = None,
    *,
    connect: options.Connect = None,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    map_: Annotated[str | None, typer.Option("--map", metavar="NAME", help="Show this map alone.")] = None,
    watch: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.1, help="Ask again every so many seconds.")
    ] = None,
    stall_after: Annotated[
        float,
        typer.Option(
            metavar="SECONDS", min=0.1, help="Stalled: keyframes wait, and none is fused for so long."
        ),
    ] = 10.0,
    timeout: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="Longest wait for an answer.")
    ] = 5.0,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> int:
    """Ask a server how it is: its maps, its clients, and what is wrong.

    Exit status, for health checks: 0 = ready; 1 = nobody answers; 2 = wrong usage; 3 = it answers, but is not
    ready, or a map takes or fuses nothing (it takes --stall-after seconds to be sure of that).

    With --watch, a terminal is redrawn until Ctrl-C (130), which leaves the last state. Elsewhere a block of
    lines (with --json: a line) is printed each time, until nobody answers (1) or the server was not ready for
    --stall-after seconds (3).
    """
    from tsfusion.cli.health_poll import ServerWatcher
    from tsfusion.core.config import ClientConfig
    from tsfusion.wire.sockets.curve import client_keys

    address = server or connect or ClientConfig().address
    watcher = ServerWatcher(
        address, control=control, keys=client_keys(key, server_key), timeout=timeout,
        stall_after=stall_after, only=map_ or "",
    )  # fmt: skip
    if watch is None:
        snapshot = watcher.check_once()
        _print(snapshot, json=json, line=False)
        return snapshot.exit_status
    if sys.stdout.isatty() and not json:
        _redraw(watcher, address, watch)
    return _repeat(watcher, watch, json=json)


def _repeat(watcher: "ServerWatcher", seconds: float, *, json: bool) -> int:
    while True:
        snapshot = watcher.check_again()
        _print(snapshot, json=json, line=True)
        if watcher.unwell:
            return snapshot.exit_status
        time.sleep(seconds)


def _redraw(watcher: "ServerWatcher", address: str, seconds: float) -> NoReturn:
    """Redraw the screen until Ctrl-C, whatever happens to the server. Leave its last state.

    Lines are overwritten on the terminal's alternate screen, so that nothing flickers.
    """
    from rich.console import Console
    from rich.live import Live

    from tsfusion.cli.status_view import StatusScreen
    from tsfusion.core.errors import TransportError

    console = Console(highlight=False)
    screen = StatusScreen(console, address)
    try:
        with Live(console=console, screen=True, get_renderable=screen.cut, refresh_per_second=2) as live:
            while True:
                screen.ask()
                try:
                    screen.answer(watcher.check_again())
                except TransportError as error:
                    screen.fail(str(error))
                live.refresh()
                time.sleep(seconds)
    finally:
        console.print(screen.whole())


def _print(snapshot: "ServerSnapshot", *, json: bool, line: bool) -> None:
    from tsfusion.cli import output

    if not json:
        typer.echo(_text(snapshot))
    elif line:
        output.as_json(snapshot.as_json(), indent=None)
    else:
        output.as_json(snapshot.as_json())
    sys.stdout.flush()


def _text(snapshot: "ServerSnapshot") -> str:
    """Return the screen as text for this terminal. Without a terminal it is wide and has no colours."""
    from rich.console import Console

    from tsfusion.cli.status_view import render

    console = Console(highlight=False, width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    with console.capture() as captured:
        console.print(render(snapshot, console.width))
    return "\n".join(line.rstrip() for line in captured.get().splitlines())
