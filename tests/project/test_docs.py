# SPDX-License-Identifier: MIT
"""The documents name only what exists."""

import re
import shlex
from pathlib import Path

import msgspec
import pytest
from repository import ROOT

from tsfusion.core.config import ClientConfig, ServerConfig

ROOT_DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
DOCUMENTS = [*(ROOT / name for name in ROOT_DOCUMENTS), *sorted((ROOT / "docs").rglob("*.md"))]


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


def test_the_commands_for_contributors_exist() -> None:
    names = ("CONTRIBUTING.md", "Makefile", "pyproject.toml")
    text, makefile, pyproject = ((ROOT / name).read_text(encoding="utf-8") for name in names)
    targets = re.findall(r"^(\w+):", makefile, re.MULTILINE)
    markers = re.findall(r'^    "(\w+): ', pyproject, re.MULTILINE)
    assert set(re.findall(r"make (\w+)", text)) <= set(targets)
    assert set(re.findall(r"marked `(\w+)`", text)) == set(markers) == {"slow", "nightly"}
    for path in re.findall(r"`([\w.]*/[\w./]+)`|\]\(([\w./]+)\)", text):
        assert (ROOT / "".join(path)).exists() or path[0] == "dist/", path
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    commands = [shlex.split(line, comments=True) for line in "".join(blocks).splitlines()]
    assert len(commands) >= 8
    for word in (word for command in commands for word in command if word.startswith(("tests/", "scripts/"))):
        assert (ROOT / word).exists(), word
