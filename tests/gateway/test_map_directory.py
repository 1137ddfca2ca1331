# SPDX-License-Identifier: MIT
"""The file in which the servers of a fleet write who has which map."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from tsfusion.core.errors import JournalError
from tsfusion.gateway.maps.moved_maps import MapDirectory

ONE, TWO = ("tcp://one:5555", "tcp://one:5556"), ("tcp://two:5555", "tcp://two:5556")


def test_who_claims_first_has_the_map_until_it_moves(tmp_path: Path) -> None:
    mine, other = (MapDirectory(str(tmp_path / "maps.sqlite")) for _ in range(2))
    assert mine.place_of("yard") is None
    assert mine.claim("yard", ONE) == ONE
    assert other.claim("yard", TWO) == ONE
    other.move("yard", TWO)
    assert mine.place_of("yard") == mine.claim("yard", ONE) == TWO


def test_of_many_that_claim_at_once_one_has_the_map(tmp_path: Path) -> None:
    def claim(number: int) -> tuple[str, str]:
        return MapDirectory(str(tmp_path / "maps.sqlite")).claim("yard", (f"tcp://{number}:1", "tcp://c:2"))

    with ThreadPoolExecutor(8) as pool:
        assert len(set(pool.map(claim, range(16)))) == 1


def test_a_directory_that_cannot_be_used_is_one_clear_error(tmp_path: Path) -> None:
    (tmp_path / "maps.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(JournalError, match="cannot use the directory of maps"):
        MapDirectory(str(tmp_path / "maps.sqlite")).claim("yard", ONE)
    with pytest.raises(JournalError, match="cannot use the directory of maps"):
        MapDirectory(str(tmp_path / "nowhere" / "maps.sqlite")).place_of("yard")
