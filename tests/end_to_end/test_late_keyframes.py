# SPDX-License-Identifier: MIT
"""Keyframes that come late, after they were sent again: known, counted, and not journaled twice."""

import time
from pathlib import Path

from bad_network import Proxy
from delivery_verdict import verify
from keyframes_and_servers import DEADLINE, serving, until, wall

from tsfusion import Client
from tsfusion.core.config import ClientConfig
from tsfusion.wire.queries import fetch_health, fetch_status


def test_what_was_sent_again_counts_once(tmp_path: Path) -> None:
    """The connection hangs; the client opens another, and what hung comes after all."""
    state = tmp_path / "state"
    config = ClientConfig(policy="spool_all", stall_timeout=0.5)
    with serving(state) as server, Proxy() as proxy:
        proxy.target(server.address, server.control)
        with Client(proxy.address, spool=tmp_path / "spool", config=config) as client:
            client.send(wall(0))
            client.flush(timeout=DEADLINE)
            proxy.jam(True)
            for i in range(1, 6):
                client.send(wall(i, captured_ns=time.monotonic_ns()))
            client.flush(timeout=DEADLINE)
            assert fetch_health(server.address).duplicates == 0
            proxy.jam(False)
            until(lambda: fetch_health(server.address).duplicates == 5)
            client.wait_fused(timeout=DEADLINE)
        status = fetch_status(server.address)
        assert server.terminate() == 0
    assert verify(state, 6, status.map_hash) == []
