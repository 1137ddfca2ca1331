# SPDX-License-Identifier: MIT
"""Places of pages, and what is told of a missing viser before a web server is loaded."""

import pytest

from tsfusion.core.errors import InvalidConfig, MissingDependency
from tsfusion.viewer.page import page_guard
from tsfusion.viewer.page.page_server import PageServer


def test_places() -> None:
    assert page_guard.parse_place("127.0.0.1:80") == ("127.0.0.1", 80)
    assert page_guard.parse_place("[::1]:0") == ("::1", 0)
    assert page_guard.parse_place("*:80") == ("0.0.0.0", 80)
    for bad in ("", "80", "localhost", "tcp://127.0.0.1:80", "::1:80", "a:70000", "a:b"):
        with pytest.raises(InvalidConfig, match="HOST:PORT"):
            page_guard.parse_place(bad)


def test_a_missing_viser_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(page_guard, "find_spec", lambda name: None)
    with pytest.raises(MissingDependency, match=r"pip install '\.\[viewer\]'"):
        PageServer()
