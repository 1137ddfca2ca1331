# SPDX-License-Identifier: MIT
"""Admission of messages: who sent them, whose session they belong to, and how many were refused."""

from collections import Counter

import zmq

from tsfusion.gateway.access_control import GUEST, AccessControl
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.sessions import Sessions
from tsfusion.wire.allowed_maps import AllowedMaps


class Admission:
    """The checks that every socket of a server makes, and their counter."""

    def __init__(self, access: AccessControl, routes: ClientRoutes) -> None:
        self.refused: Counter[str] = Counter()  # messages that were not taken, by reason
        self._access = access
        self._routes = routes

    def client_of(self, frame: zmq.Frame) -> str | None:
        """The client that sent a frame, empty without keys; None when it has no access, which is counted."""
        client = self._access.client_of(frame)
        if client is None:
            self.refused["key"] += 1
        return client

    def maps_of(self, client: str) -> AllowedMaps:
        """The maps that a client may use."""
        return self._access.maps_of(client)

    def denial_of_map(self, client: str, map_name: str, *, sends: bool = False) -> str:
        """Reason why a client may not use a map, which is counted; empty = it may.

        Args:
            sends: whether it is to send keyframes into it.
        """
        maps = self._access.maps_of(client)
        if map_name in maps and not (sends and client == GUEST):
            return ""
        self.refused["forbidden"] += 1
        return "this key may only watch" if client == GUEST else maps.denial(map_name)

    def owns(self, sessions: Sessions, key: bytes, client: str) -> bool:
        """Whether a client may go on with a session: no other client has journaled it, or is connected."""
        session, route = sessions.get(key), self._routes.get(key)
        return (session is None or session.belongs_to(client)) and (route is None or route.open_to(client))
