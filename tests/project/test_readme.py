# SPDX-License-Identifier: MIT
"""The README's Python is run as it stands, its commands as far as they need no data."""

import re
import shlex
from pathlib import Path

import pytest
from command_processes import server, tsfusion
from repository import ROOT

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
    for verb in {command[0] for command in commands}:
        text = tsfusion(verb, "--help").stdout
        flags = {
            word for command in commands if command[0] == verb for word in command if word.startswith("--")
        }
        assert text, verb
        assert all(flag in text for flag in flags), (verb, flags)


def test_links_lead_somewhere() -> None:
    links = [link for link in re.findall(r"\]\(([^)]+)\)", README) if "://" not in link]
    assert links
    missing = [link for link in links if not (ROOT / link).exists()]
    assert not missing
