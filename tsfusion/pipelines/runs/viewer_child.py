# SPDX-License-Identifier: MIT
"""Show a live page, or Foxglove, beside a run: `tsfusion view` as a child, which cannot harm the run."""

import json
import logging
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress

import msgspec

from tsfusion.core import process
from tsfusion.core.config import DEFAULT_MAP
from tsfusion.pipelines.runs.target_server import Target
from tsfusion.viewer.page.page_guard import check_installed, listen, parse_place
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys

_COMMAND = (sys.executable, "-m", "tsfusion", "view", "--json", "--from-parent")
_ANYWHERE = {"0.0.0.0": "127.0.0.1", "*": "127.0.0.1", "::": "::1"}  # host listened at → host to reach
_WARNING = "tsfusion view: WARNING: "
_END_SECONDS = 5.0
_FOR_THE_VIEWER = ("TSFUSION_TOKEN", "TSFUSION_NO_BROWSER")

log = logging.getLogger(__name__)


class ViewerChild:
    """A `tsfusion view` process that ends when this process ends in any way.

    Args:
        place: HOST:PORT of the page.
        tell: called in a thread with the address of the page, when it can be opened.
        truth: known surface of the map, as `tsfusion view --truth` takes it.
        foxglove: True serves Foxglove there, instead of a page.

    Raises:
        MissingDependency: without viser, or foxglove-sdk.
        InvalidConfig: for a bad `place`.
        TransportError: when the port is taken.
    """

    def __init__(
        self, place: str, tell: Callable[[str], None], *, truth: str | None = None, foxglove: bool = False
    ) -> None:
        check_installed("foxglove" if foxglove else "viewer")
        listen(*parse_place(place)).close()
        self._what = "what Foxglove shows" if foxglove else "the page"
        self._listen = f"--{'foxglove' if foxglove else 'listen'}={place}"
        self._truth = truth
        self._tell = tell
        self._process: subprocess.Popen[str] | None = None
        self._reader = threading.Thread(target=self._follow, name="page", daemon=True)
        self._is_ending = False

    def start(
        self,
        address: str,
        *,
        control: str | None = None,
        map_name: str = DEFAULT_MAP,
        keys: ClientKeys | None = None,
        again: str | None = None,
    ) -> None:
        """Show a map of the server that listens at `address`. Failures are logged as warnings.

        Args:
            again: what to give to `tsfusion view` after the run; the page says so at the end.
        """
        given = {
            "--control": control and _reached(control),
            "--truth": self._truth,
            "--map": map_name,
            "--again": again,
        }
        flags = [self._listen]
        flags += [f"{flag}={value}" for flag, value in given.items() if value is not None]
        try:
            self._process = subprocess.Popen(
                [*_COMMAND, _reached(address), *flags],
                stdin=subprocess.PIPE,  # closes when this process dies in any way; that ends the viewer
                stdout=subprocess.PIPE,
                stderr=subprocess.STDOUT,
                text=True,
                env=process.without_flags(*_FOR_THE_VIEWER),
                **process.OWN_GROUP,  # Ctrl-C is ours to handle
            )
            assert self._process.stdin is not None
            self._process.stdin.write(json.dumps(keys and msgspec.to_builtins(keys)) + "\n")
            self._process.stdin.flush()
        except OSError as error:
            log.warning("%s cannot be shown: %s; everything else goes on", self._what, error.strerror)
        if self._process is not None:
            self._reader.start()

    def close(self) -> None:
        """End the viewer process."""
        self._is_ending = True
        if self._process is None:
            return
        self._process.terminate()
        try:
            self._process.wait(_END_SECONDS)
        except subprocess.TimeoutExpired:
            self._process.kill()
        self._reader.join(_END_SECONDS)
        with suppress(OSError), self._process:  # closes its pipes
            pass

    def _follow(self) -> None:
        """Pass on what the viewer process prints (the page's address, warnings), until it ends."""
        child, why = self._process, ""
        assert child is not None
        assert child.stdout is not None
        for line in map(str.strip, child.stdout):
            if line.startswith('{"url"'):
                self._tell(json.loads(line)["url"])
            elif line.startswith(_WARNING):
                log.warning("%s: %s", self._what.removeprefix("the "), line.removeprefix(_WARNING))
            elif line:  # the last line says why the viewer ends
                why = f": {line.removeprefix('tsfusion: ')}"
        status = child.wait()
        if not self._is_ending:
            log.warning("%s has ended with status %d%s; everything else goes on", self._what, status, why)


def _reached(address: str) -> str:
    """Return the address to connect to for a listening address such as tcp://0.0.0.0:5555."""
    host, port = sockets.parse_address(address)
    return sockets.format_address(_ANYWHERE.get(host, host), port)


@contextmanager
def showing(viewer: ViewerChild | None, target: Target, again: str) -> Iterator[None]:
    """Show the map that a run sends to, until the end of the block. `again`: see `ViewerChild.start`."""
    if viewer is None:
        yield
        return
    link = target.link
    try:
        viewer.start(link.address, control=link.control, map_name=link.map, keys=target.keys, again=again)
        yield
    finally:
        viewer.close()
