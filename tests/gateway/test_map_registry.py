# SPDX-License-Identifier: MIT
"""Free names of maps, for clients that may use all names or some."""

from pathlib import Path
from typing import Any, cast

import zmq

from tsfusion.core.config import ServerConfig
from tsfusion.gateway.client_routes import ClientRoutes
from tsfusion.gateway.map_registry import MapRegistry
from tsfusion.gateway.metrics import Metrics
from tsfusion.journal import state_folder
from tsfusion.wire.allowed_maps import AllowedMaps


def test_a_free_name_is_one_that_the_client_may_use(tmp_path: Path) -> None:
    for name in ("yard", "yard-2", "house"):
        (state_folder.map_folder(tmp_path, name) / state_folder.JOURNAL_FOLDER).mkdir(parents=True)
    maps: Any = MapRegistry(
        zmq.Context.instance(), ServerConfig(state=str(tmp_path)), cast(ClientRoutes, []), Metrics()
    )
    names = [
        maps.free_name(like, AllowedMaps(patterns))
        for like, patterns in (
            ("yard", None), ("attic", None), ("yard", ("yard-*",)), ("default", ("yard-*",)),
            ("default", ("house", "shed")), ("default", ("house",)), ("default", ()), ("default", ("*",)),
        )
    ]  # fmt: skip
    assert names == ["yard-3", "attic", "yard-3", "yard-3", "shed", None, None, "default"]
    assert maps.keep_free_name("default", AllowedMaps(("house",))) is None
    why = maps.why_none_free("default", AllowedMaps(("house",)))
    assert why == "no name is free of the maps that this key may use: house"
