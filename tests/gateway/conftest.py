# SPDX-License-Identifier: MIT
"""The gateway of most tests: in this process, without sockets."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from served_gateway import Served, hosting


@pytest.fixture
def served(tmp_path: Path) -> Iterator[Served]:
    """A gateway whose default map is open and empty."""
    with hosting(tmp_path) as made:
        yield made
