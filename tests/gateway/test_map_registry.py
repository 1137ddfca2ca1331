# SPDX-License-Identifier: MIT
"""The maps of a server whose state folder cannot be listed."""

import errno
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from failures import refuse

from tsfusion.core.config import ServerConfig
from tsfusion.core.errors import JournalError
from tsfusion.gateway.map_registry import MapRegistry


def test_no_free_name_is_guessed_where_the_maps_cannot_be_listed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nothing = cast("Any", ())
    registry = MapRegistry(nothing, ServerConfig(state=str(tmp_path)), nothing, nothing)
    hosted = SimpleNamespace(
        name="hall",
        sessions=SimpleNamespace(shares_frame=lambda *_: False),
        health=lambda: SimpleNamespace(keyframes_durable=1),
    )
    (tmp_path / "maps").mkdir()
    monkeypatch.setattr(os, "listdir", refuse(errno.EIO))
    with pytest.raises(JournalError, match=r"cannot list .*maps: Input/output error"):
        registry.keep_free_name("hall")
    denied = registry.denial_of_world(cast("Any", hosted), cast("Any", SimpleNamespace(session=b"")))
    assert denied is not None  # a scanner of another world is turned away all the same
    assert denied.free_map == ""
