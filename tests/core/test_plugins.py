# SPDX-License-Identifier: MIT
"""Options that a user gives by name: names and types are checked, usual spellings are converted."""

from pathlib import Path
from typing import Any

import pytest

from tsfusion.core import plugins
from tsfusion.core.errors import InvalidConfig
from tsfusion.geometry.keyframe import Intrinsics


def camera(
    *,
    size: tuple[int, int] = (1, 1),
    rate: float | None = None,
    place: str | Path = "",
    count: int = 1,
    lens: Intrinsics | None = None,
    **others: Any,
) -> tuple[object, ...]:
    return size, rate, place, count, lens, others


def call(**options: object) -> tuple[object, ...]:
    return plugins.call(camera, options, name="a camera", error=InvalidConfig)


def test_options_are_converted_to_the_type_of_the_parameter() -> None:
    lens = Intrinsics(1.0, 2.0, 3.0, 4.0)
    made = call(size=[2, 3], rate=5, place=7, count=None, lens=(1, 2, 3, 4))
    assert made == ([2, 3], 5.0, "7", 1, lens, {})
    assert call(place=Path("a"), lens=lens, exposure="long")[2:] == (Path("a"), 1, lens, {"exposure": "long"})


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"rate": True}, "`rate` must be a number, got True"),
        ({"count": 1.5}, "`count` must be a whole number, got 1.5"),
        ({"place": ["a"]}, r"`place` must be text, got \['a'\]"),
        ({"lens": [1, 2, 3]}, r"`lens` must be numbers \[fx, fy, cx, cy\], got \[1, 2, 3\]"),
        ({"lens": 4}, r"`lens` must be numbers \[fx, fy, cx, cy\], got 4"),
    ],
)
def test_an_option_of_another_type_is_refused(option: dict[str, object], message: str) -> None:
    with pytest.raises(InvalidConfig, match=f"^{message}$"):
        call(**option)
