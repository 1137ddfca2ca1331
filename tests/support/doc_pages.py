# SPDX-License-Identifier: MIT
"""The code blocks of a page, and a page run from its first block to its last as its reader would.

A comment over a block says what a test does with it: `<!-- test: background -->` starts a command that goes
on, `<!-- test: needs a camera -->` (or whatever it needs) leaves the block out. No reader sees it.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import typer
from command_processes import DEADLINE, end, environment, read_until
from repository import ROOT

from tsfusion import cli
from tsfusion.geometry.map_questions import LONGEST_S

_BLOCK = re.compile(
    r"^(?P<indent> *)(?:<!-- test: (?P<mark>[^>]+) -->\n+ *)?"
    r"```(?P<language>\w*)(?P<more>[^\n]*)\n(?P<code>.*?)^ *```$",
    re.DOTALL | re.MULTILINE,
)
_COMMAND = re.compile(r"^(?:\w*\$ +)?(?:\S*/)?tsfusion(?: |$)")
_ANY_PORT = "tcp://127.0.0.1:0"
SHELL = ("", "sh", "console")
ADDRESSES = ("tcp://127.0.0.1:5555", "tcp://server:5555", "127.0.0.1 5555")
# Typer's own click or the real one, by version: both name it so.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")


PAGES = sorted([ROOT / "README.md", *(ROOT / "docs").rglob("*.md"), ROOT / "contrib" / "README.md"])


class Block(NamedTuple):
    """A fenced block."""

    language: str
    code: str
    mark: str  # what a test does with it; empty = runs it
    title: str
    line: int

    @property
    def needs(self) -> str:
        """What no test has; empty = nothing."""
        return self.mark.removeprefix("needs ") if self.mark.startswith("needs ") else ""


def blocks(page: Path) -> list[Block]:
    """The fenced blocks of a page, in order."""
    text = page.read_text(encoding="utf-8")
    found = []
    for match in _BLOCK.finditer(text):
        code = re.sub(rf"^{match['indent']}", "", match["code"], flags=re.MULTILINE)
        title = re.search(r'title="([^"]+)"', match["more"])
        line = text.count("\n", 0, match.start()) + 1
        mark = (match["mark"] or "").strip()
        found.append(Block(match["language"], code, mark, title[1] if title else "", line))
    return found


def commands(block: Block) -> Iterator[list[str]]:
    """The words of each `tsfusion` command in a shell block, as it is typed."""
    for line in re.split(r"\s*(?:\n|&&)\s*", block.code.replace("\\\n", " ").strip()):
        if _COMMAND.match(line):
            typed = shlex.split(_COMMAND.sub("", line, count=1), comments=True)
            ends = (number for number, word in enumerate(typed) if word in ("|", ">", "&", "…"))
            yield typed[: next(ends, len(typed))]


@cache
def _root() -> Any:
    return typer.main.get_command(cli.app)


def misread(words: list[str]) -> str:
    """Why `tsfusion WORDS` would not be understood; empty = it would."""
    command: Any = _root()
    names: list[str] = []
    while words and words[0] in getattr(command, "commands", {}):
        command = command.commands[words[0]]
        names.append(words[0])
        words = words[1:]
    if hasattr(command, "commands") and not names:
        return "" if words and words[0].startswith("-") else f"there is no verb {words[:1]}"
    try:
        command.make_context(" ".join(names), list(words), resilient_parsing="--help" in words)
    except typer.Exit:
        return ""
    except _UsageError as error:
        return f"{' '.join(names)}: {error or type(error).__name__}"
    return ""


def addressed(code: str, address: str) -> str:
    """A block with a server's own address in place of those that pages show, and more time for answers."""
    code = re.sub(r"\btimeout=[\d.]+", f"timeout={LONGEST_S}", code)
    host, port = address.removeprefix("tcp://").rsplit(":", 1)
    for shown in ADDRESSES:
        code = code.replace(shown, address if shown.startswith("tcp") else f"{host} {port}")
    return code


def run(page: Path, folder: Path) -> str:
    """Run a page's blocks in a folder, in order; what they printed.

    `tsfusion` and `python` are those of this process. A server that a page starts listens on a free port, and
    ends with the page.

    Raises:
        AssertionError: naming the block that failed, with what it printed.
    """
    programs = folder / ".programs"
    programs.mkdir()
    for name, words in (("tsfusion", "-m tsfusion"), ("python", ""), ("python3", "")):
        program = programs / name
        program.write_text(f'#!/bin/sh\nexec "{sys.executable}" {words} "$@"\n')
        program.chmod(0o755)
    env = {**environment(), "PATH": f"{programs}:{os.environ['PATH']}", "TSFUSION_LISTEN": _ANY_PORT}
    address = ADDRESSES[0]
    going: list[subprocess.Popen[str]] = []
    printed = []
    try:
        for block in blocks(page):
            if block.needs or block.language not in (*SHELL, "python"):
                continue
            if block.mark == "background":
                process, address = _started(block.code, folder, env)
                going.append(process)
                continue
            (folder / ".block").write_text(addressed(block.code, address))
            how = ["python"] if block.language == "python" else ["bash", "-euo", "pipefail"]
            given = [address] if block.title else []  # an example is told where the server is
            done = subprocess.run(
                [*how, ".block", *given], cwd=folder, env=env, text=True, check=False,
                stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
                timeout=2 * DEADLINE,
            )  # fmt: skip
            assert done.returncode == 0, f"{page.name}:{block.line} failed:\n{block.code}\n{done.stdout}"
            printed.append(done.stdout)
    finally:
        for process in reversed(going):
            end(process)
    return "".join(printed)


def _started(code: str, folder: Path, env: dict[str, str]) -> tuple["subprocess.Popen[str]", str]:
    """A server, once it is ready, and its address."""
    words = shlex.split(code.strip(), comments=True)
    process = subprocess.Popen(
        words, cwd=folder, env=env, text=True, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT, executable=str(folder / ".programs" / words[0]),
    )  # fmt: skip
    try:
        line = read_until(process, "ready")
        return process, re.findall(r"tcp://[\d.]+:\d+", line)[0]
    except BaseException:
        end(process)
        raise


def inline_commands(page: Path) -> Iterator[list[str]]:
    """The words of each `tsfusion VERB …` in the sentences of a page."""
    text = re.sub(r"^ *```.*?^ *```$", "", page.read_text(encoding="utf-8"), flags=re.DOTALL | re.MULTILINE)
    for shown in re.findall(r"`tsfusion (\w[^`]*)`", text):
        yield shown.replace("'", "").replace("…", "").split()


def unknown_words(words: list[str]) -> list[str]:
    """Words of a command in a sentence that is no verb, or a flag that its verb does not have."""
    command: Any = _root()
    rest = list(words)
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest.pop(0)]
    if hasattr(command, "commands") and rest and rest[0].islower() and "|" not in rest[0]:
        return rest[:1]
    known = {
        flag for param in getattr(command, "params", []) for flag in (*param.opts, *param.secondary_opts)
    }
    return [
        word for word in rest if word.startswith("--") and word.partition("=")[0] not in {*known, "--help"}
    ]
