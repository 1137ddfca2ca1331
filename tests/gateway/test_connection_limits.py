# SPDX-License-Identifier: MIT
"""Connections that are cut off because they hold too much memory."""

from collections import Counter
from types import SimpleNamespace
from typing import Any, cast

import pytest

from tsfusion.gateway.ports import connection_limits
from tsfusion.gateway.ports.connection_limits import ConnectionLimits


def limits_of(connections: SimpleNamespace, refused: Counter[str]) -> ConnectionLimits:
    ports, access = SimpleNamespace(connections=connections), SimpleNamespace(step=lambda: False)
    return ConnectionLimits(cast("Any", ports), cast("Any", access), refused, 1 << 30)


def test_those_that_fill_the_memory_go_first_and_all_if_that_does_not_help(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    refused = Counter[str]()
    limits = limits_of(SimpleNamespace(cut_hoarders=lambda: [("198.51.100.7", 9_000_000)]), refused)
    monkeypatch.setattr(limits._memory, "excess", lambda _: 2 << 30)
    now = 100.0
    monkeypatch.setattr(connection_limits, "time", SimpleNamespace(monotonic=lambda: now))
    assert [limits.all_must_go(0), limits.all_must_go(0)] == [False, True]
    now += connection_limits._CUT_HELPS_WITHIN
    assert not limits.all_must_go(0)
    assert refused == {"memory": 3}
