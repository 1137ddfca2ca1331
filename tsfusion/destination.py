# SPDX-License-Identifier: MIT
"""Where a scan's keyframes go: a server of its own, or one elsewhere with spools on this disk."""

import logging
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tsfusion.child import ServerChild, own_server
from tsfusion.client import Client
from tsfusion.config import ClientConfig, ServerConfig, VolumeConfig, override
from tsfusion.errors import TransportError, TsfusionError
from tsfusion.fetch import fetch_status
from tsfusion.sources import Source
from tsfusion.transport import client_keys

AHEAD = 3  # keyframes of a recording under way: fusing, waiting, travelling
MAPS = 16  # of an own server: its default one, and a submap each

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Destination:
    """The link's settings, the own server (None: it is elsewhere), and the folder of spools."""

    link: ClientConfig
    child: ServerChild | None
    spools: Path


def elsewhere(client: ClientConfig | None, connect: str, spool: Path) -> Destination:
    """A running server at a data address."""
    return Destination(override(client or ClientConfig(), address=connect), None, spool)


def of_its_own(
    stack: ExitStack,
    client: ClientConfig | None,
    server: ServerConfig | None,
    volume: VolumeConfig,
    scratch: Path,
) -> Destination:
    """A server that runs until the stack is closed, and keeps its files in `scratch`.

    Raises:
        TransportError: when it does not start.
    """
    scratch.mkdir()
    own = server or ServerConfig(listen="tcp://127.0.0.1:0", state=str(scratch / "state"))
    own = override(own, max_maps=max(own.max_maps, MAPS))
    link, child = stack.enter_context(own_server(client or ClientConfig(), own, volume, scratch))
    return Destination(link, child, scratch / "spool")


def _pace(source: Source, place: Destination) -> dict[str, Any]:
    """What waits leaves nothing out: a recording waits for a server of its own, and for no other."""
    if source.live:
        return {}
    return {"policy": "block", "backlog": AHEAD} if place.child else {"policy": "spool_all"}


def opener(stack: ExitStack, place: Destination, source: Source) -> tuple[set[str], Callable[[str], Client]]:
    """The maps that an earlier scan's keyframes wait for, and what opens a client and closes it in the end.

    Those keyframes are sent, too, but this scan begins no submap of their names.
    """

    pace = _pace(source, place)

    def connect(name: str) -> Client:
        link = override(place.link, map=name, **pace)
        client = Client(link.address, spool=place.spools / name, control=link.control, config=link)
        stack.callback(client.close)
        return client

    waiting = {path.parent.name for path in place.spools.glob("*/*.mcap")} - {place.link.map}
    for name in sorted(waiting):
        try:
            left = connect(name).stats.waiting
            if left:
                log.warning("an earlier scan left %d keyframes for the map %s: they go, too", left, name)
        except TsfusionError as error:
            log.warning("what waits in %s is not sent: %s", place.spools / name, error)
    return waiting, connect


def warn_of_another_world(place: Destination) -> None:
    """Say so when the map has keyframes already, or will have: this scan's world is not theirs."""
    link = place.link
    begins = "a scan that localises itself begins its own world; give it a map of its own (--map NAME)"
    if any((place.spools / link.map).glob("*.mcap")):
        log.warning("keyframes of an earlier scan wait for the map %s: %s", link.map, begins)
        return
    with suppress(TransportError):  # a server that is not there yet, or has no such map
        keys = client_keys(link.key, link.server_key)
        status = fetch_status(link.address, control=link.control, map_name=link.map, timeout=2.0, keys=keys)
        if status.keyframes_durable:
            log.warning("the map %s has %d keyframes already: %s", link.map, status.keyframes_durable, begins)
