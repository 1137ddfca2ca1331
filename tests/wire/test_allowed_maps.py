# SPDX-License-Identifier: MIT
"""The maps that a key may use: by name, and by the topics of their mesh updates."""

import pytest

from tsfusion.wire.keys.key_folder import ALL_MAPS, AllowedMaps


@pytest.mark.parametrize(
    ("patterns", "inside", "outside"),
    [
        (None, ["house", "yard-1"], []),
        ((), [], ["house"]),
        (("house",), ["house"], ["house-2", "hous", "yard"]),
        (("house", "yard-*"), ["house", "yard-", "yard-1"], ["yard", "yar", "yards-1"]),
        (("*",), ["house"], []),
    ],
)
def test_names(patterns: tuple[str, ...] | None, inside: list[str], outside: list[str]) -> None:
    maps = AllowedMaps(patterns)
    assert all(name in maps for name in inside)
    assert not any(name in maps for name in outside)


@pytest.mark.parametrize(
    ("asked", "granted"),
    [
        (b"mesh/house/", [b"mesh/house/"]),
        (b"mesh/house", [b"mesh/house/"]),
        (b"mesh/house-2/", []),
        (b"mesh/yard-1/", [b"mesh/yard-1/"]),
        (b"mesh/yard-", [b"mesh/yard-"]),
        (b"mesh/ya", [b"mesh/yard-"]),
        (b"mesh/yard/", []),
        (b"mesh/", [b"mesh/house/", b"mesh/yard-"]),
        (b"scan/house/", [b"scan/house/"]),
        (b"scan/hut/", []),
        (b"scan/", [b"scan/house/", b"scan/yard-"]),
        (b"", [b"mesh/house/", b"scan/house/", b"mesh/yard-", b"scan/yard-"]),
        (b"other", []),
    ],
)
def test_a_subscription_is_cut_down_to_what_is_allowed(asked: bytes, granted: list[bytes]) -> None:
    assert AllowedMaps(("house", "yard-*")).topics(asked) == granted
    assert ALL_MAPS.topics(asked) == [asked]
