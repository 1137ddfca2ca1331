# SPDX-License-Identifier: MIT
"""News of each keyframe for viewers: its pose at once, its picture as it came, as long as there is room."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import zmq
from keyframes_and_servers import CAMERA, SHAPE, connected, secured, wall
from served_gateway import Served, record, serving_here

from tsfusion.gateway.people import scan_updates
from tsfusion.wire.keys import key_folder
from tsfusion.wire.messages import mesh_updates
from tsfusion.wire.messages.mesh_updates import Scanned
from tsfusion.wire.sockets import sockets
from tsfusion.wire.sockets.curve import ClientKeys, client_keys

TOPIC = sockets.scan_topic("default")


@contextmanager
def viewer(served: Served, keys: ClientKeys | None = None) -> Iterator[sockets.AnySocket]:
    """A viewer's socket that gets what scanners see."""

    def subscriber(context: "zmq.Context[Any]", keys: ClientKeys | None = None) -> sockets.AnySocket:
        made = sockets.subscriber(context, keys)
        made.setsockopt(zmq.SUBSCRIBE, TOPIC)
        return made

    with connected(subscriber, served.addresses.publish, keys) as made:
        yield made


def is_watched(served: Served) -> bool:
    return served.gateway._subscriptions.watched(TOPIC)


def heard(served: Served, link: sockets.AnySocket) -> tuple[Scanned, list[bytes]]:
    served.until(lambda: link.poll(0))
    topic, head, *frames = link.recv_multipart()
    assert topic == TOPIC
    return mesh_updates.scanned_of(head), frames


def test_a_keyframe_is_told_with_its_picture_as_it_came(tmp_path: Path) -> None:
    with serving_here(tmp_path) as served, connected(sockets.push, served.addresses.data) as push:
        push.send_multipart(record(1))  # nobody watches yet
        served.until(lambda: served.durable == 1)
        with viewer(served) as link:
            check_told(served, link, push)


def check_told(served: Served, link: sockets.AnySocket, push: sockets.AnySocket) -> None:
    served.until(lambda: link.poll(0) or is_watched(served))
    sent = record(2)
    push.send_multipart(sent)
    push.send_multipart(sent)  # once more, on its way
    scanned, frames = heard(served, link)
    assert frames == [sent[2]]
    assert frames[0][:2] == b"\xff\xd8"
    assert (scanned.session, scanned.seq, scanned.client) == (bytes(16), 2, "")
    assert (scanned.intrinsics, scanned.shape, scanned.late) == (CAMERA, SHAPE, False)
    np.testing.assert_array_equal(scanned.pose, wall(2).T_world_camera[:3].ravel())
    push.send_multipart(record(3))
    again, _ = heard(served, link)
    assert (again.seq, again.number, again.epoch) == (3, scanned.number + 1, scanned.epoch)


def test_pictures_take_so_many_bytes_and_the_newest_comes_late(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    clock = SimpleNamespace(now=0.0, monotonic=lambda: clock.now, monotonic_ns=time.monotonic_ns)
    monkeypatch.setattr(scan_updates, "time", clock)
    largest = max(len(record(seq)[2]) for seq in range(1, 9))
    monkeypatch.setattr(scan_updates, "PICTURE_BYTES", 4 * largest)  # a second; two at once
    with (
        serving_here(tmp_path) as served,
        viewer(served) as link,
        connected(sockets.push, served.addresses.data) as push,
    ):
        served.until(lambda: link.poll(0) or is_watched(served))
        for seq in range(1, 9):
            push.send_multipart(record(seq))
        got = [heard(served, link) for _ in range(8)]
        assert [one.seq for one, _ in got] == [*range(1, 9)]
        assert [one.seq for one, frames in got if frames] == [1, 2]
        clock.now = 1.0
        last, frames = heard(served, link)
        assert (last.seq, last.late, frames) == (8, True, [record(8)[2]])
        assert last.number == got[7][0].number


def test_a_key_for_another_map_hears_nothing(tmp_path: Path) -> None:
    given, guest = secured(tmp_path / "keys"), tmp_path / "guest"
    public = key_folder.create_pair(guest, "guest").public
    key_folder.allow(Path(given.server["keys"]), "guest", public, maps=["theirs"])
    theirs = client_keys(str(guest / "guest.key_secret"), given.client["server_key"])
    with (
        serving_here(tmp_path / "state", **given.server) as served,
        viewer(served, theirs) as stranger,
        viewer(served, given.keys) as robot,
        connected(sockets.push, served.addresses.data, given.keys) as push,
    ):
        served.until(lambda: robot.poll(0) or served.gateway._subscriptions._granted[TOPIC] == 1)
        served.until(lambda: stranger.poll(0) or served.gateway._subscriptions._denied[TOPIC] == 1)
        push.send_multipart(record(1))
        scanned, _ = heard(served, robot)
        assert scanned.client == "robot"
        assert not stranger.poll(200)
