# SPDX-License-Identifier: MIT
"""`tsfusion view`: show a live or a saved map in a browser."""

import logging
import os
import re
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import closing, suppress
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, verbs
from tsfusion.viewer import LISTEN

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsfusion.pipelines.report.measured_errors import Measure
    from tsfusion.viewer.foxglove.foxglove_server import FoxgloveServer
    from tsfusion.viewer.map_feed import MapFeed
    from tsfusion.viewer.page.page_server import PageServer
    from tsfusion.viewer.shown_feed import ShownFeed
    from tsfusion.wire.sockets.curve import ClientKeys

_ANSWER_SECONDS = 1.0  # wait for a server's answer
_SERVER = re.compile(r"[\w.-]+:\d{1,5}|\[[\da-fA-F:.]+\]:\d{1,5}", re.ASCII)
_ERROR = "Error [m]"  # name on the page
_NICENESS = 10  # of a page beside a run
_MEMORY_SHARE, _LEAST_MEMORY = 4, 2 << 30  # a page may take 1/4 of the memory, but always 2 GiB
_AGAIN = "its map is seen again with: tsfusion view"
_LEAST_SECONDS = 60.0  # a page that lasted so long may begin again

log = logging.getLogger(__name__)


def view(
    context: typer.Context,
    where: Annotated[
        str | None,
        typer.Argument(metavar="WHERE", help="tcp://HOST:PORT, a .tsf file, or a folder."),
    ] = None,
    *,
    map_: options.Map = None,
    truth: Annotated[
        str | None, options.option("--truth", "FILE", "True surface (mesh), to colour by error.")
    ] = None,
    listen: Annotated[
        str,
        options.option("--listen", "HOST:PORT", "Page's address; port 0 = free.", envvar="TSFUSION_VIEW"),
    ] = LISTEN,
    foxglove: Annotated[
        str | None, options.option("--foxglove", "[HOST:PORT]", "Show it in Foxglove, in no browser.")
    ] = None,
    token: Annotated[
        str | None, options.option("--token", "TEXT", "Needed to open the page; random, if any.")
    ] = None,
    no_browser: Annotated[
        bool, options.option("--no-browser", None, "Open no browser; only print the address.")
    ] = False,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    json: options.Json = False,
    publish: Annotated[str | None, typer.Option("--publish", hidden=True)] = None,
    again: Annotated[str | None, typer.Option("--again", hidden=True)] = None,
    from_parent: Annotated[bool, typer.Option("--from-parent", hidden=True)] = False,
    help_all: verbs.HelpAll = None,
) -> int:
    """Show a map in a browser or Foxglove: as it grows, or a saved one.

    Prints the address of the page, and shows it until Ctrl-C. Without WHERE: the
    server on this machine if one runs, else the newest run's map (out/latest).

    Beyond this machine (--listen 0.0.0.0:5558) the address has a token in it.
    """
    from tsfusion.cli import progress
    from tsfusion.core import logs, process
    from tsfusion.viewer.page.page_guard import parse_place
    from tsfusion.wire.sockets.curve import client_keys

    logs.configure("text", "warning", "view")
    keys = _keys_from_parent() if from_parent else client_keys(key, server_key)
    if foxglove is not None:
        options.refuse(context, ("listen", "truth"), "has no effect with --foxglove, which shows no page")
    target = _target(where, keys)
    if isinstance(target, Path):
        options.refuse(
            context, ("control", "key", "server_key"), f"has no effect on {target}: it is no server"
        )
    measures = _measures(target, truth)
    if publish is not None:
        log.warning("--publish has no effect: a server has no third port any more")
    link = {"control": control, "keys": keys}
    (host, port), is_announced = parse_place(foxglove or listen), False
    memory_bytes = max(process.physical_memory_bytes() // _MEMORY_SHARE, _LEAST_MEMORY)
    process.limit_memory(process.data_bytes() + memory_bytes)
    stop = threading.Event()
    with progress.ended_by_signals(stop.set, words=b""):
        while not stop.is_set():
            began = time.monotonic()
            page, show = _server(host, port, token, foxglove=foxglove is not None, measures=measures)
            with (
                closing(page),
                closing(_feed(target, map_, link)) as feed,
            ):
                shown = show(feed)
                if not is_announced:
                    _announce(page.url, feed.title, json=json)
                    if not no_browser and foxglove is None:
                        _open_browser(page.url)
                is_announced, port, token = True, page.port, page.token  # which stay if it begins again
                try:
                    shown.run(stop, memory_bytes=memory_bytes)
                    seen = "this page has ended" if again is None else f"the run has ended; {_AGAIN} {again}"
                    shown.tell_end(seen)
                except MemoryError as error:
                    if time.monotonic() < began + _LEAST_SECONDS:  # the map itself is too much
                        raise
                    log.warning("%s: it begins again", error)
    return 0


def _server(
    host: str, port: int, token: str | None, *, foxglove: bool, measures: "dict[str, Measure]"
) -> "tuple[PageServer | FoxgloveServer, Callable[[MapFeed], ShownFeed]]":
    """Return a running server of a page, or for Foxglove, and what shows a feed's map there."""
    if foxglove:
        from tsfusion.viewer.foxglove.foxglove_server import FoxgloveServer
        from tsfusion.viewer.foxglove.foxglove_view import FoxgloveView

        there = FoxgloveServer(host, port, token=token)
        return there, partial(FoxgloveView, there)
    from tsfusion.viewer.live_page import LivePage
    from tsfusion.viewer.page.page_server import PageServer

    page = PageServer(host, port, token=token)
    return page, partial(LivePage, page.server, measures=measures)


def _target(where: str | None, keys: "ClientKeys | None") -> str | Path:
    """Return the address of a server, or a path that exists."""
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import DEFAULT, LATEST
    from tsfusion.wire.sockets.sockets import connect_address

    if where is None:
        return _usual_target(keys, Path(DEFAULT, LATEST))
    if "://" in where:
        return connect_address(where)
    path = Path(where).expanduser()
    if path.exists():
        return path
    if _SERVER.fullmatch(where):
        return connect_address(f"tcp://{where}")
    raise InvalidConfig(
        f"{where} does not exist; expected a server such as tcp://127.0.0.1:5555, a map (.tsf), the folder "
        "of a run, or that of a server's state"
    )


def _usual_target(keys: "ClientKeys | None", latest: Path) -> str | Path:
    """Return the address of the server on this machine, or the folder of the newest run."""
    from tsfusion.core.config import ClientConfig
    from tsfusion.core.errors import InvalidConfig, ServerUnreachable
    from tsfusion.wire.asking.queries import fetch_health

    address = ClientConfig().address
    try:
        fetch_health(address, timeout=_ANSWER_SECONDS, keys=keys)
        return address
    except ServerUnreachable:
        if latest.is_dir():
            return latest
    raise InvalidConfig(
        f"nothing to show: no server answers at {address}, and there is no {latest}; name a server "
        "(tcp://HOST:PORT), a map (.tsf) or a folder"
    )


def _feed(target: str | Path, map_: str | None, link: dict[str, Any]) -> "MapFeed":
    if isinstance(target, Path):
        from tsfusion.pipelines.shown.viewed_maps import open_feed

        return open_feed(target, map_name=map_)
    from tsfusion.core.config import DEFAULT_MAP
    from tsfusion.wire.asking.map_watcher import MapWatcher

    return MapWatcher(target, map_ or DEFAULT_MAP, **link)


def _measures(target: str | Path, truth: str | None) -> "dict[str, Measure]":
    """Return further colours of a map: its error, if the truth is given or a run has measured it."""
    if truth is not None:
        from tsfusion.pipelines.report.measured_errors import error_measure

        return {_ERROR: error_measure(truth)}
    if isinstance(target, Path) and (target / "error.npy").exists():
        return {_ERROR: partial(_error_of_run, target)}
    return {}


@cache
def _measure_of_run(folder: Path) -> "Measure":
    from tsfusion.pipelines.report.measured_errors import error_measure

    return error_measure(folder)


def _error_of_run(folder: Path, points: "NDArray[np.float32]") -> "NDArray[np.float32]":
    """Return the error of a run at points. The run's mesh is read at the first call, which is slow."""
    return _measure_of_run(folder)(points)


def _announce(url: str, title: str, *, json: bool) -> None:
    if json:
        from tsfusion.cli import output

        output.as_json({"url": url, "shows": title}, indent=None)
    else:
        typer.echo(f"{url} shows {title} until Ctrl-C")
    sys.stdout.flush()


def _open_browser(url: str) -> None:
    """Open a browser if there is a screen. The browser's output is dropped."""
    has_screen = sys.platform == "darwin" or any(map(os.environ.get, ("DISPLAY", "WAYLAND_DISPLAY")))
    if has_screen:
        with suppress(OSError):
            subprocess.Popen(
                [sys.executable, "-m", "webbrowser", url],
                stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                start_new_session=True,
            )  # fmt: skip


def _keys_from_parent() -> "ClientKeys | None":
    """Return the keys that the parent process writes to stdin. From now on this process ends when its parent
    ends, and has a lower priority."""
    import msgspec

    from tsfusion.core import process
    from tsfusion.wire.sockets.curve import ClientKeys

    os.nice(_NICENESS)
    line = sys.stdin.readline()
    process.end_with_stdin()
    return msgspec.json.decode(line, type=ClientKeys | None)
