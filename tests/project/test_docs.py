# SPDX-License-Identifier: MIT
"""The documents name only what exists."""

import re
from pathlib import Path

import msgspec
import pytest
from repository import ROOT

from tsfusion.core.config import ClientConfig, ServerConfig

DOCUMENTS = [ROOT / "README.md", ROOT / "ARCHITECTURE.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_tests_that_are_named_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for file, test in re.findall(r"((?:tests|scripts|docs)/[\w/.-]+\.\w+)(?:::(\w+))?", text):
        named = ROOT / file
        assert named.exists(), file
        assert not test or f"def {test}(" in named.read_text(encoding="utf-8"), f"{file}::{test}"


def test_the_limits_that_are_named_are_settings() -> None:
    text = (ROOT / "docs" / "delivery.md").read_text(encoding="utf-8")
    section = text[text.index("**Limits**") : text.index("No pickle")]
    settings = {
        field.name for struct in (ServerConfig, ClientConfig) for field in msgspec.structs.fields(struct)
    }
    named = set(re.findall(r"`(\w+_\w+)`", section))
    assert named
    assert named <= settings
