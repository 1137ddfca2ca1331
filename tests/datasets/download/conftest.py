# SPDX-License-Identifier: MIT
"""A download server for each test."""

from collections.abc import Iterator

import pytest
from download_server import Server, serving

from tsfusion.datasets.download import http as download_http


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[Server]:
    monkeypatch.setattr(download_http, "_PAUSE_S", 0.0)
    with serving() as running:
        yield running
