# SPDX-License-Identifier: MIT
"""The documents name only what exists, and the README's Python is run as it stands."""

import re
import shlex
from pathlib import Path

import msgspec
import pytest
from command_processes import server, tsfusion
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


README = (ROOT / "README.md").read_text(encoding="utf-8")
LIVE = "tcp://127.0.0.1:5555"


def blocks(language: str) -> list[str]:
    """The fenced blocks of a language, in order."""
    return re.findall(rf"^```{language}\n(.*?)^```$", README, re.DOTALL | re.MULTILINE)


@pytest.mark.parametrize(
    "code", [pytest.param(code, id=f"block{i}") for i, code in enumerate(blocks("python"))]
)
def test_python_runs(code: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    program = compile(code, "README.md", "exec")
    if LIVE not in code:
        exec(program, {"__name__": "readme"})
        return
    with server(tmp_path / "state") as (address, _):
        exec(compile(code.replace(LIVE, address), "README.md", "exec"), {"__name__": "readme"})


def test_there_is_python_to_run() -> None:
    assert len(blocks("python")) >= 2


def words_of(command: list[str]) -> tuple[str, ...]:
    """The verb of a command, with its group."""
    return tuple(command[: 2 if command[0] in ("map", "journal", "keys", "spool", "config") else 1])


def test_every_flag_shown_exists() -> None:
    """Each `tsfusion VERB …` line of the README names a verb and flags that its help knows."""
    lines = [
        re.sub(r"^\w+\$\s+", "", line)  # the prompt says on which machine
        for block in blocks("sh")
        for line in re.split(r"&&|>|\n", block)
    ]
    commands = [
        shlex.split(line, comments=True)[1:]
        for line in lines
        if line.strip().split(" ")[0].endswith("tsfusion")
    ]
    assert len(commands) >= 6
    for verb in {words_of(command) for command in commands}:
        text = tsfusion(*verb, "--help-all").stdout or tsfusion(*verb, "--help").stdout
        flags = {
            word
            for command in commands
            if words_of(command) == verb
            for word in command
            if word.startswith("--")
        }
        assert text, verb
        assert all(flag in text for flag in flags), (verb, flags)


def test_links_lead_somewhere() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert links
    missing = [link for link in links if not (ROOT / link).exists()]
    assert not missing
