# SPDX-License-Identifier: MIT
"""A link that changes bytes on the way, without keys: what comes damaged is sent again, within reason."""

from pathlib import Path
from typing import Any

import zmq
from bad_network import Proxy
from idle_fuser import keeping
from keyframes_and_servers import DEADLINE, connected, wall

from tsfusion import Client, journal
from tsfusion.gateway.intake import keyframe_intake
from tsfusion.journal.state_folder import find_journal
from tsfusion.wire.asking.queries import fetch_health
from tsfusion.wire.messages import messages
from tsfusion.wire.records import codec
from tsfusion.wire.sockets import sockets

SESSION = bytes(range(16))
KEYFRAMES = 24


def test_what_is_damaged_on_the_way_is_sent_again(tmp_path: Path) -> None:
    state = tmp_path / "state"
    with keeping(state) as server, Proxy() as proxy:
        proxy.target(server.address, server.control)
        with Client(proxy.address, spool=tmp_path / "spool", policy="spool_all") as client:
            client.connect(DEADLINE)
            proxy.flip(4_000)  # bytes; a keyframe has three to four thousand
            for number in range(KEYFRAMES):
                client.send(wall(number))
            client.flush(DEADLINE)
            assert proxy.flipped > 10
            assert client.stats.durable == KEYFRAMES
            assert client.stats.refused == {}
            session = client._outbox.spool.session
    records = [record for path in find_journal(state).files() for record in journal.records(path)]
    assert len(records) == KEYFRAMES
    for number, record in enumerate(records):
        sent = codec.encode(wall(number), session=session, seq=record.seq, jpeg_quality=90)
        assert record.frames[1:] == sent[1:]
        found = codec.decode_keyframe(record.frames)
        assert (found.T_world_camera == wall(number).T_world_camera).all()
        assert found.timestamp_ns == wall(number).timestamp_ns


def test_a_record_that_always_comes_damaged_is_given_up(tmp_path: Path) -> None:
    def answer(dealer: sockets.AnySocket) -> Any:
        assert dealer.poll(10_000)
        return messages.decode_to_client(dealer.recv())

    with (
        keeping(tmp_path / "state") as server,
        connected(sockets.dealer, server.control) as dealer,
        connected(sockets.push, server.address) as push,
    ):
        dealer.send(messages.encode(messages.Hello(SESSION, messages.PROTOCOL_VERSION)))
        assert isinstance(answer(dealer), messages.Welcome)
        head, first, *rest = codec.encode(wall(), session=SESSION, seq=1, jpeg_quality=90)
        assert push.poll(10_000, zmq.POLLOUT)
        for _ in range(keyframe_intake._MOST_DAMAGED - 1):
            push.send_multipart([head, first[:-1] + b"?", *rest])
            assert answer(dealer) == messages.Ack(SESSION, 0, 0, (), resend=True)
        push.send_multipart([head, first[:-1] + b"?", *rest])
        given_up = answer(dealer)
        assert (given_up.seq, given_up.stage, given_up.reason) == (1, "door", "crc")
        health = fetch_health(server.address)
        assert health.refused["crc"] == keyframe_intake._MOST_DAMAGED
        assert health.clients[0].refused == 1
