# SPDX-License-Identifier: MIT
"""Fusers that wait for maps: as many as are wanted, for maps with their settings, replaced when they die."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from served_gateway import QuietFuser, Served, hosting, record

from tsfusion.core.config import ServerConfig, VolumeConfig
from tsfusion.gateway.fusers.spare_fusers import SpareFusers


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """A gateway with two spare fusers that are ready."""
    with hosting(tmp_path, spare_fusers=2) as made:
        made.until(lambda: len(spares(made)) == 2)
        yield made


def spares(served: Served) -> list[int]:
    """The processes that are ready for a map."""
    return [one.process.pid for one in served.gateway.maps._spares._spares if one.is_warm]


def open_map(served: Served, name: str) -> int:
    """Send a first record to a map; the process of its fuser."""
    served.greet(name)
    served.take(record(1, name))
    served.until(lambda: (opened := served.gateway.maps.get(name)) and opened.outcomes.fused)
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
    served.gateway.maps._spares._spares[0].process.kill()
    assert open_map(served, "yard") == other
    served.until(lambda: len(spares(served)) == 2)
    assert not {dead, other} & set(spares(served))


def test_a_map_of_other_settings_gets_a_process_of_its_own(served: Served, tmp_path: Path) -> None:
    taken = served.gateway.maps._spares.take("yard", VolumeConfig(voxel_size=0.5))
    assert taken.pid not in spares(served)
    taken.close()
    assert len(spares(served)) == 2


def test_they_end_with_the_server(tmp_path: Path) -> None:
    with hosting(tmp_path, spare_fusers=1) as served:
        served.until(lambda: spares(served))
        (one,) = served.gateway.maps._spares._spares
    assert one.process.status is not None


def test_none_begins_while_the_server_ends(served: Served) -> None:
    maps = served.gateway.maps
    maps.finish()
    for _ in range(3):  # as until every map is saved
        served.step()
        assert not maps._spares._spares


class Broken(QuietFuser):
    """A process that ends at once."""

    def start(self) -> None:
        self.status = 3


def test_after_one_that_never_gets_ready_the_next_one_waits(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    start: Any = Broken
    made = SpareFusers(start, ServerConfig(state=str(tmp_path), spare_fusers=1))
    for pause in (1, 2, 4):
        made._start_at = 0.0  # it is over
        for _ in ("starts", "has ended"):
            made.step(VolumeConfig(), may_start=True)
        assert not made._spares
        assert f"it ended with status 3; it is tried again in {pause} s" in caplog.text
