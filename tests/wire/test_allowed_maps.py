# SPDX-License-Identifier: MIT
"""The maps that a key may use: by name."""

import pytest

from tsfusion.wire.keys.key_folder import AllowedMaps


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
