# SPDX-License-Identifier: MIT
"""`tsfusion status`."""

import sys
import time
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from rich.console import RenderableType

    from tsfusion.cli.health_poll import Ask, Look, Watcher

PLAIN_WIDTH = 160  # columns where there is no terminal


def status(
    *,
    connect: options.Connect = None,
    control: options.Control = None,
    key: options.Key = None,
    server_key: options.ServerKey = None,
    map_: Annotated[str | None, typer.Option("--map", metavar="NAME", help="Only this map.")] = None,
    watch: Annotated[
        float | None, typer.Option(metavar="SECONDS", min=0.1, help="Ask again and again.")
    ] = None,
    stall_after: Annotated[
        float,
        typer.Option(metavar="SECONDS", min=0.1, help="So long without a keyframe fused, while some wait."),
    ] = 10.0,
    timeout: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.1, help="Wait so long for an answer.")
    ] = 5.0,
    json: options.Json = False,
) -> int:
    """Ask a running server how it is: its maps, its clients, and what is wrong.

    Exit status, for health checks: 0 = ready; 1 = nobody answers; 2 = wrong usage; 3 = it answers, but is not
    ready, or keyframes wait and nothing is fused (it takes --stall-after seconds to be sure of that).

    With --watch, a terminal is redrawn until Ctrl-C. Elsewhere a block of lines (with --json: a line) is
    printed each time, until nobody answers (1) or nothing was well for --stall-after seconds (3).
    """
    from tsfusion.cli.health_poll import Watcher
    from tsfusion.core.config import ClientConfig

    address = connect or ClientConfig().address
    watcher = Watcher(
        address, _asker(address, control, key, server_key), timeout=timeout, stall_after=stall_after,
        only=map_ or "",
    )  # fmt: skip
    if watch is None:
        look = watcher.once()
        _print(look, json=json, line=False)
        return look.exit_status
    if sys.stdout.isatty() and not json:
        _redraw(watcher, address, watch)
    return _repeat(watcher, watch, json=json)


def _asker(address: str, control: str | None, key: str | None, server_key: str | None) -> "Ask":
    from tsfusion.wire import sockets
    from tsfusion.wire.curve import client_keys
    from tsfusion.wire.messages import Command, Reply
    from tsfusion.wire.queries import request
    from tsfusion.wire.sockets import control_address

    to, keys = control_address(sockets.connect_address(address), control), client_keys(key, server_key)

    def ask(command: Command, timeout: float) -> Reply:
        reply, _ = request(to, command, timeout=timeout, keys=keys)
        return reply

    return ask


def _repeat(watcher: "Watcher", seconds: float, *, json: bool) -> int:
    while True:
        look = watcher.again()
        _print(look, json=json, line=True)
        if watcher.unwell:
            return look.exit_status
        time.sleep(seconds)


def _redraw(watcher: "Watcher", address: str, seconds: float) -> None:
    """Until Ctrl-C, whatever becomes of the server."""
    from rich.console import Console
    from rich.live import Live

    from tsfusion.cli.health_poll import Look
    from tsfusion.cli.status_view import render
    from tsfusion.core.errors import TransportError

    with Live(console=Console(highlight=False), auto_refresh=False) as live:
        while True:
            try:
                look = watcher.again()
            except TransportError as error:
                look = Look(address=address, error=str(error))
            live.update(render(look), refresh=True)
            time.sleep(seconds)


def _print(look: "Look", *, json: bool, line: bool) -> None:
    from tsfusion.cli import output
    from tsfusion.cli.status_view import render

    if not json:
        typer.echo(_text(render(look)))
    elif line:
        output.as_json_line(look.as_json())
    else:
        output.as_json(look.as_json())
    sys.stdout.flush()


def _text(shown: "RenderableType") -> str:
    """As it looks on this terminal; without colours and wide where there is none."""
    from rich.console import Console

    console = Console(highlight=False, width=None if sys.stdout.isatty() else PLAIN_WIDTH)
    with console.capture() as captured:
        console.print(shown)
    return "\n".join(line.rstrip() for line in captured.get().splitlines())
