# SPDX-License-Identifier: MIT
"""Rules for every verb: help on one screen, examples that run, variables, completion."""

import shlex
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from command_processes import Here, environment
from repository import GOLDEN

from tsfusion import cli
from tsfusion.cli import verbs
from tsfusion.core.errors import OutputError
from tsfusion.pipelines.runs.run import RunPlan

WIDTH, MOST_LINES = 80, 40  # a terminal as it opens


def commands(command: Any, *names: str) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with its words: () is `tsfusion` itself."""
    yield names, command
    for name, below in getattr(command, "commands", {}).items():
        yield from commands(below, *names, name)


COMMANDS = dict(commands(typer.main.get_command(cli.app)))
VERBS = [words for words, command in COMMANDS.items() if not hasattr(command, "commands")]


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", str(WIDTH))


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_help_fits_a_screen(here: Here, words: tuple[str, ...]) -> None:
    done = here(*words, "--help")
    lines = done.stdout.rstrip().splitlines()
    assert (done.returncode, done.stderr) == (0, "")
    assert len(lines) <= MOST_LINES
    assert all(len(line) <= WIDTH for line in lines)
    assert f"Usage: {' '.join(('tsfusion', *words))}" in done.stdout
    assert "<bool>" not in done.stdout
    assert "env var" not in done.stdout
    assert "TSFUSION_" not in done.stdout or not words
    if words in VERBS:
        assert [line.split()[:2] for line in lines[-3:]] == [["Examples:"], *[["$", "tsfusion"]] * 2]


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("words", COMMANDS, ids=" ".join)
def test_every_command_knows_help_all(here: Here, words: tuple[str, ...]) -> None:
    done = here(*words, "--help-all")
    assert (done.returncode, done.stderr) == (0, "")
    assert f"Usage: {' '.join(('tsfusion', *words))}" in done.stdout
    told = [one.opts[0] for one in COMMANDS[words].params if one.param_type_name == "option" and one.help]
    assert [flag for flag in told if f"{flag} " not in done.stdout] == []


def parameters() -> Iterator[str]:
    """Each argument and flag of each verb, with what it takes."""
    for words in VERBS:
        for one in COMMANDS[words].params:
            named = [*one.opts, *one.secondary_opts] if one.param_type_name == "option" else [one.name]
            choices = "|".join(map(str, getattr(one.type, "choices", ())))
            takes = "" if getattr(one, "is_flag", False) else choices or one.metavar or one.type.name
            many = f"x{one.nargs}" * (one.nargs != 1) + " …" * getattr(one, "multiple", False)
            yield " ".join(f"{' '.join(words)} {'/'.join(named)} {takes} {many}".split())


# Changed on purpose since tests/golden/verbs.txt was written, which never changes: old line and reason.
CHANGED = {"spool send names [SPOOL]... x-1": "the folder may stand before the names"}


def test_no_verb_and_no_flag_is_lost() -> None:
    """Commands of before are understood: a flag keeps its names, its values and how many it takes."""
    before = (GOLDEN / "verbs.txt").read_text(encoding="utf-8").splitlines()
    assert len(before) > 350
    assert [line for line in before if line not in set(parameters())] == list(CHANGED)


@pytest.mark.parametrize("words", VERBS, ids=" ".join)
def test_examples_are_commands(words: tuple[str, ...]) -> None:
    command = COMMANDS[words]
    for line in command.epilog.splitlines()[1:]:
        typed = shlex.split(line.partition(" > ")[0].removeprefix("$ tsfusion "))
        given = typed[len(words) :] if typed[: len(words)] == list(words) else typed[len(words) - 1 :]
        command.make_context(words[-1], given)


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("verb", ["demo", "scan", "replay", "check", "mesh", "serve"])
def test_rare_flags_are_shown_on_request(here: Here, verb: str) -> None:
    few, all_ = here(verb, "--help").stdout, here(verb, "--help-all").stdout
    params = COMMANDS[verb,].params
    rare = {one.opts[0] for one in params if one.hidden and one.help and one.param_type_name == "option"}
    assert rare
    assert not [flag for flag in rare if f"{flag} " in few]
    assert not [flag for flag in rare if f"{flag} " not in all_]
    assert "--until-eof" not in all_


@pytest.fixture
def asked(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Arguments that `replay` hands to the pipeline, which is not run."""
    found: dict[str, Any] = {}

    def record(plan: RunPlan, out: Path | None, *_: object, **__: object) -> None:
        found.update(plan=plan, out=out)
        raise OutputError("recorded")

    monkeypatch.setattr("tsfusion.pipelines.runs.run.run", record)
    return found


def test_every_flag_has_a_variable(
    here: Here, asked: dict[str, Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {"MAX_FRAMES": "3", "VOXEL_SIZE": "0.5", "OUT": "there", "NO_SUCH_FLAG": "1"}.items():
        monkeypatch.setenv(f"{verbs.PREFIX}{name}", value)
    here("replay", "synthetic:room")
    assert (asked["plan"].source.length, asked["plan"].volume.voxel_size, asked["out"]) == (
        3,
        0.5,
        Path("there"),
    )
    here("replay", "synthetic:room", "--max-frames", 2)
    assert asked["plan"].source.length == 2


def test_earlier_names_are_understood(here: Here, asked: dict[str, Any]) -> None:
    here("replay", "synthetic:room", "--max-keyframes", 3)
    assert asked["plan"].source.length == 3
    here("replay", "synthetic:room", "--max-keyframes=2")
    assert asked["plan"].source.length == 2
    done = here("replay", "synthetic:room", "--poses", "a.txt")
    assert "a.txt is missing; expected a trajectory" in done.stderr
    for words in (["--source", "nowhere"], ["--source=nowhere"]):
        assert "nowhere does not exist" in here("scan", *words).stderr


SHELL = """
tsfusion --install-completion >&2
. "$HOME/.bashrc"
complete_words() {
    COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); COMPREPLY=()
    _tsfusion_completion tsfusion; echo "${COMPREPLY[*]}"
}
complete_words tsfusion re
complete_words tsfusion replay --voxel
complete_words tsfusion scan --sensor re
complete_words tsfusion journal ver
complete_words tsfusion vi
complete_words tsfusion serve --vi
"""


def test_bash_completes_verbs_flags_and_values(tmp_path: Path) -> None:
    program = tmp_path / "tsfusion"
    program.write_text(f"#!{sys.executable}\nfrom tsfusion.__main__ import main\nmain()\n")
    program.chmod(program.stat().st_mode | stat.S_IXUSR)
    (tmp_path / "script.sh").write_text(SHELL)
    env = environment()
    done = subprocess.run(
        ["bash", tmp_path / "script.sh"], capture_output=True, text=True, timeout=60, check=False,
        env={**env, "HOME": str(tmp_path), "PATH": f"{tmp_path}:{env['PATH']}"}, stdin=subprocess.DEVNULL,
    )  # fmt: skip
    assert done.stdout.splitlines() == [
        "replay report",
        "--voxel-size",
        "realsense",
        "verify",
        "view",
        "--view",
    ], done.stderr
