# SPDX-License-Identifier: MIT
"""`tsfusion serve`: run a server that fuses what scanners send."""

import logging
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.core.config import Config
    from tsfusion.pipelines.runs.viewer_child import ViewerChild
    from tsfusion.wire.messages.health import Health
    from tsfusion.wire.sockets.curve import ClientKeys
    from tsfusion.wire.sockets.sockets import Addresses

log = logging.getLogger(__name__)


def _flag(flag: str, metavar: str, help_: str, *, rare: bool = False) -> Any:
    return Annotated[str | None, options.option(flag, metavar, help_, rare=rare)]


# By name: settings of the `server` table.
SERVER_OPTIONS: dict[str, Any] = {
    "listen": _flag("--listen", "ADDRESS", "Address for keyframes; port 0 = a free one."),
    "control": _flag("--control", "ADDRESS", "Address for commands; default: next port."),
    "state": _flag("--state", "DIR", "Folder of journals and maps (kept)."),
    "metrics": _flag("--metrics", "HOST:PORT",
                     "Serve Prometheus and health checks here: 127.0.0.1:9464."),
    "log_format": _flag("--log-format", "FORMAT", "Log on stderr as text or json."),
    "log_level": _flag("--log-level", "LEVEL", "Least level: debug, info, warning, error."),
    "keep_seconds": Annotated[float | None, options.option(
        "--keep-seconds", "SECONDS", "Forget keyframes that came this long before the newest.", rare=True)],
    "keep_keyframes": Annotated[int | None, options.option(
        "--keep-keyframes", "N", "Forget all but the newest N keyframes of a map.", rare=True)],
    "keep_radius": Annotated[float | None, options.option(
        "--keep-radius", "METRES", "Forget keyframes taken farther than this from the newest.", rare=True)],
    "directory": _flag("--directory", "FILE", "File that says which server has which map.", rare=True),
    "advertise": _flag("--advertise", "ADDRESS", "Address by which clients reach this server.", rare=True),
    "keys": _flag("--keys", "DIR",
                  "Folder of clients' keys; other machines need keys (`tsfusion keys`)."),
    "fuser_memory_bytes": _flag("--memory", "BYTES",
                                "Memory for each map's blocks, such as 2GB; the rest is on the disk."),
    "fuser_disk_bytes": _flag("--disk", "BYTES",
                              "Most disk for blocks beyond --memory; default: all that is free.", rare=True),
    "cache": _flag("--cache", "DIR", "Folder for blocks beyond --memory; default: the map's own.", rare=True),
}  # fmt: skip


@partial(options.takes_map_settings, also=SERVER_OPTIONS)
def serve(
    context: typer.Context,
    folder: Annotated[
        str | None, typer.Argument(metavar="[DIR]", help="The same as --state.", hidden=True)
    ] = None,
    *,
    config: options.ConfigFile = None,
    view: options.ViewFlag = None,
    foxglove: options.FoxgloveFlag = None,
    json: options.Json = False,
    until_eof: Annotated[bool, typer.Option("--until-eof", hidden=True)] = False,
    **settings: Any,
) -> int:
    """Fuse what scanners send, until Ctrl-C or SIGTERM saves the maps.

    A line with `ready` is printed once keyframes may come: their kernels are compiled by then.
    """
    started = time.monotonic()
    from tsfusion import server
    from tsfusion.core import logs, process
    from tsfusion.core.errors import TsfusionError

    if folder is not None:
        options.refuse(context, ("state",), f"and {folder!r} are two folders; give one")
        settings["state"] = folder
    chosen = _configuration(config, settings)
    logs.configure(chosen.server.log_format, chosen.server.log_level)
    if until_eof:
        process.end_with_stdin()

    try:
        pages, guest = _pages({"page": view, "foxglove": foxglove}, chosen.server.keys, json)

        def on_ready(addresses: "Addresses") -> None:
            _announce(addresses, chosen.server.state, time.monotonic() - started, json)
            for page in pages:
                page.start(addresses.data, control=addresses.control, keys=guest)

        with ExitStack() as shown, _shown_state(chosen.server.log_format) as show:
            for page in pages:
                shown.enter_context(closing(page))
            return server.run(
                chosen.server,
                chosen.volume,
                on_ready,
                volumes=chosen.volumes(),
                guest=None if guest is None else guest.public,
                on_health=show,
            )
    except TsfusionError as error:
        if chosen.server.log_format == "text":
            raise
        log.critical("%s", error)  # the last line is a JSON object too
        return 1


@contextmanager
def _shown_state(log_format: str) -> "Iterator[Callable[[Health], None]]":
    """Yield a function that shows the server's state on the last line of the terminal, if there is one."""
    if log_format != "text" or not sys.stderr.isatty():
        yield lambda _: None
        return
    from tsfusion.cli.bottom_line import BottomLine

    with BottomLine() as line:
        yield line.show


def _configuration(file: Path | None, settings: dict[str, Any]) -> "Config":
    """Return all settings. If a flag limits the memory, the rest of a map goes to the disk."""
    from msgspec.structs import replace

    from tsfusion.core.config import CacheConfig, override
    from tsfusion.core.errors import InvalidConfig

    sizes = {name: options.byte_count(settings[name]) for name in ("fuser_memory_bytes", "fuser_disk_bytes")}
    try:
        chosen = options.configuration_for(None, file, **{**settings, **sizes})
    except InvalidConfig as error:  # the message names the setting, not the flag
        flags = {"fuser_memory_bytes must": "--memory", "fuser_disk_bytes must": "--disk"}
        flag = next((flag for begin, flag in flags.items() if str(error).startswith(begin)), None)
        raise error if flag is None else InvalidConfig(f"{flag}: {error}") from error
    server = chosen.server
    if server.fuser_disk_bytes is None:
        if sizes["fuser_memory_bytes"] is not None:
            server = override(server, fuser_disk_bytes=CacheConfig(folder="").disk_bytes)
        elif settings["cache"] is not None:
            raise InvalidConfig("--cache has no effect without --memory: all blocks stay in memory")
    return replace(chosen, server=server)


def _announce(addresses: "Addresses", state: str, seconds: float, json: bool) -> None:
    from tsfusion.cli import output

    if json:
        fields = {
            "ready": True, "listen": addresses.data, "control": addresses.control, "state": state,
            "seconds": round(seconds, 3),
        }  # fmt: skip
        output.as_json(fields, indent=None)
    else:
        output.text(
            f"ready in {seconds:.1f} s: keyframes {addresses.data}, control {addresses.control}, "
            f"state {state}"
        )
    sys.stdout.flush()


def _pages(
    places: dict[str, str | None], folder: str | None, json: bool
) -> "tuple[list[ViewerChild], ClientKeys | None]":
    """Return the viewers of a server, and keys for them alone if the server has a folder of keys."""
    from tsfusion.pipelines.runs.viewer_child import ViewerChild
    from tsfusion.wire.sockets.curve import ClientKeys, server_keys

    def tell(kind: str, url: str) -> None:
        if json:
            from tsfusion.cli import output

            output.as_json({kind: url}, indent=None)
        else:
            typer.echo(f"{kind} {url}")
        sys.stdout.flush()

    pages = [
        ViewerChild(place, partial(tell, kind), foxglove=kind == "foxglove")
        for kind, place in places.items()
        if place is not None
    ]
    keys = ClientKeys.drawn(server_keys(folder).public) if pages and folder is not None else None
    return pages, keys
