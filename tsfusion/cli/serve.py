# SPDX-License-Identifier: MIT
"""`tsfusion serve`."""

import logging
import os
import signal
import sys
import threading
import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.wire.sockets import Addresses

log = logging.getLogger(__name__)


@options.takes_map_settings
def serve(
    *,
    listen: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", envvar="TSFUSION_LISTEN", help="Address for keyframes; port 0 = any free port."
        ),
    ] = None,
    control: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS", envvar="TSFUSION_CONTROL", help="Address for commands; default: the next port."
        ),
    ] = None,
    state: Annotated[
        str | None,
        typer.Option(
            metavar="DIR",
            envvar="TSFUSION_STATE",
            help="Folder of journals and maps; those there are continued.",
        ),
    ] = None,
    metrics: Annotated[
        str | None,
        typer.Option(
            metavar="HOST:PORT",
            envvar="TSFUSION_METRICS",
            help="Address for Prometheus and health checks, such as 127.0.0.1:9464; this machine only.",
        ),
    ] = None,
    log_format: Annotated[
        str | None,
        typer.Option(metavar="FORMAT", envvar="TSFUSION_LOG_FORMAT", help="Log on stderr as text or json."),
    ] = None,
    log_level: Annotated[
        str | None,
        typer.Option(
            metavar="LEVEL",
            envvar="TSFUSION_LOG_LEVEL",
            help="Log from debug, info, warning or error on.",
        ),
    ] = None,
    keys: Annotated[
        str | None,
        typer.Option(
            metavar="DIR",
            envvar="TSFUSION_KEYS",
            help="Let only those connect whom `tsfusion keys allow` named; needed beyond this machine.",
        ),
    ] = None,
    config: options.ConfigFile = None,
    json: options.Json = False,
    until_eof: Annotated[bool, typer.Option("--until-eof", hidden=True)] = False,
    **settings: Any,
) -> int:
    """Fuse keyframes that scanners send; SIGTERM or Ctrl-C saves the map and ends the server.

    A line with `ready` is printed once keyframes may come: every kernel is compiled by then.
    """
    started = time.monotonic()
    from tsfusion import server
    from tsfusion.core import logs
    from tsfusion.core.errors import TsfusionError

    chosen = options.configuration(
        config, listen=listen, control=control, state=state, keys=keys, metrics=metrics,
        log_format=log_format, log_level=log_level, **settings,
    )  # fmt: skip
    logs.configure(chosen.server.log_format, chosen.server.log_level)
    if until_eof:
        threading.Thread(target=_stop_at_eof, daemon=True).start()

    def on_ready(addresses: "Addresses") -> None:
        _announce(addresses, chosen.server.state, time.monotonic() - started, json)

    try:
        return server.run(chosen.server, chosen.volume, on_ready, volumes=chosen.volumes())
    except TsfusionError as error:
        if chosen.server.log_format == "text":
            raise
        log.critical("%s", error)  # the last line is a JSON object too
        return 1


def _announce(addresses: "Addresses", state: str, seconds: float, json: bool) -> None:
    if json:
        from tsfusion.cli import output

        output.as_json_line(
            {
                "ready": True, "listen": addresses.data, "control": addresses.control,
                "publish": addresses.publish, "state": state, "seconds": round(seconds, 3),
            }
        )  # fmt: skip
    else:
        typer.echo(
            f"ready in {seconds:.1f} s: keyframes {addresses.data}, control {addresses.control}, "
            f"mesh updates {addresses.publish}, state {state}"
        )
    sys.stdout.flush()


def _stop_at_eof() -> None:
    """End as by SIGTERM when the parent closes stdin, which happens also when it is killed."""
    while os.read(sys.stdin.fileno(), 4096):  # unbuffered: no lock is held when the interpreter ends
        pass
    os.kill(os.getpid(), signal.SIGTERM)
