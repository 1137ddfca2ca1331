# SPDX-License-Identifier: MIT
"""Fusers that wait for maps: as many as are wanted, for maps with their settings, replaced when they die."""

import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from keyframes_and_servers import connected, until
from served_gateway import Served, record, serving_here

from tsfusion.core.config import VolumeConfig
from tsfusion.wire import sockets


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """A gateway with two spare fusers that are ready."""
    with serving_here(tmp_path, spare_fusers=2) as made:
        made.until(lambda: len(spares(made)) == 2)
        yield made


def spares(served: Served) -> list[int]:
    """The processes that are ready for a map."""
    return [one.process.pid for one in served.gateway.maps._spares._spares if one.is_warm]


def open_map(served: Served, name: str) -> int:
    """Send a first record to a map; the process of its fuser."""
    with (
        connected(sockets.dealer, served.addresses.control) as link,
        connected(sockets.push, served.addresses.data) as push,
    ):
        served.greet(link, name)
        push.send_multipart(record(1, name))
        served.until(lambda: (opened := served.gateway.maps.get(name)) and opened.health().keyframes_fused)
    hosted: Any = served.gateway.maps.get(name)
    return int(hosted.fuser.pid)


def test_a_new_map_takes_a_fuser_that_waits_and_another_begins(served: Served) -> None:
    before = spares(served)
    assert open_map(served, "yard") == before[0]
    served.until(lambda: len(spares(served)) == 2)
    assert before[0] not in spares(served)
    assert open_map(served, "house") == before[1]


def test_one_that_dies_is_replaced_and_never_given_to_a_map(served: Served) -> None:
    dead, other = spares(served)
    os.kill(dead, signal.SIGKILL)
    until(lambda: served.gateway.maps._spares._spares[0].process.status is not None)
    assert open_map(served, "yard") == other
    served.until(lambda: len(spares(served)) == 2)
    assert not {dead, other} & set(spares(served))


def test_a_map_of_other_settings_gets_a_process_of_its_own(served: Served, tmp_path: Path) -> None:
    taken = served.gateway.maps._spares.take("yard", VolumeConfig(voxel_size=0.5))
    assert taken.pid not in spares(served)
    taken.close()
    assert len(spares(served)) == 2


def test_they_end_with_the_server(tmp_path: Path) -> None:
    with serving_here(tmp_path, spare_fusers=1) as served:
        served.until(lambda: spares(served))
        (one,) = served.gateway.maps._spares._spares
    assert one.process.status is not None
