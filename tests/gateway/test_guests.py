# SPDX-License-Identifier: MIT
"""The key of a server's own page: it may watch every map, and send nothing."""

from pathlib import Path

import pytest
from served_gateway import LINK, hosting, record

from tsfusion.gateway.ports.access_control import GUEST
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import messages
from tsfusion.wire.messages.forget_messages import Selection
from tsfusion.wire.messages.messages import Command
from tsfusion.wire.messages.questions import Scans
from tsfusion.wire.sockets.curve import ClientKeys, server_keys


@pytest.mark.parametrize("limited", [False, True], ids=["", "with clients of few maps"])
def test_a_guest_watches_and_sends_nothing(tmp_path: Path, limited: bool) -> None:
    key_folder.create_pair(tmp_path / "keys", "server")
    robot = key_folder.create_pair(tmp_path / "robot", "robot")
    key_folder.allow(tmp_path / "keys", "robot", robot.public, maps=["yard"] if limited else None)
    keys = ClientKeys.drawn(server_keys(tmp_path / "keys").public)
    with hosting(tmp_path / "state", keys=str(tmp_path / "keys"), guest=keys.public) as served:
        assert served.gateway._access.client_of(keys.public) == GUEST
        assert list(served.ask(Command(name="health"), client=GUEST).health.maps) == ["default"]
        assert served.ask(Command(name="ask", question=Scans(wait_s=0.0)), client=GUEST).answer is not None

        served.say(messages.Hello(bytes(16), messages.PROTOCOL_VERSION), LINK, client=GUEST)
        denied = served.heard(messages.Denied)
        assert (denied.reason, denied.message) == ("map", "this key may only watch")
        served.take(record(1), client=GUEST)
        assert served.refused == {"forbidden": 2, "map": 1}
        assert served.durable == 0
        everything = Command(name="forget", selection=Selection(client="robot"))
        reply = served.ask(everything, client=GUEST)
        assert "may forget keyframes of client (guest) only" in str(reply.error)
        assert served.gateway._access.client_of(ClientKeys.drawn(keys.server).public) is None
