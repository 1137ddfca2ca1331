# SPDX-License-Identifier: MIT
"""Every line of the documents and messages that installs something does so, from a clone."""

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from repository import ROOT

PIP = re.compile(r"pip install ((?:-e |--upgrade )?(?:'\.(?:\[[\w,]+\])?'|\.)(?=[\s`\"]|$))", re.MULTILINE)
SOURCES = sorted(
    path
    for pattern in (
        "*.md",
        "docs/**/*.md",
        "contrib/**/*.md",
        "tsfusion/**/*.py",
        "scripts/*.py",
        "lab/**/*.py",
    )
    for path in ROOT.glob(pattern)
    if path.name != "CHANGELOG.md"
)


def installed() -> list[str]:
    """Targets of the install lines, each once: `.`, `.[ros]` and so on."""
    found = {
        shlex.split(words)[-1] for path in SOURCES for words in PIP.findall(path.read_text(encoding="utf-8"))
    }
    return sorted(found)


def extras() -> set[str]:
    text = (ROOT / "pyproject.toml").read_text(encoding="utf-8")
    table = text[text.index("[project.optional-dependencies]") : text.index("[project.scripts]")]
    return set(re.findall(r"^(\w+) = ", table, re.MULTILINE))


def test_install_lines_name_a_clone_and_its_extras() -> None:
    """The package is on no index: `pip install tsfusion` would find nothing, or something else."""
    assert {".", ".[scanner]", ".[dev]", ".[ros]"} <= set(installed())
    for path in SOURCES:
        text = path.read_text(encoding="utf-8")
        assert "'tsfusion[" not in text, path
        assert "pip install tsfusion" not in text, path
    named = {extra for line in installed() for extra in re.findall(r"\w+", line)}
    assert named <= extras()


def test_the_client_needs_less_of_the_same() -> None:
    """A robot's distribution has the whole one's versions, without what servers and plots need."""
    whole, client = (requirements(path) for path in ("pyproject.toml", "packaging/client/pyproject.toml"))
    assert set(client) - {"packaging"} < set(whole)
    assert all(client[name] == whole[name] for name in set(client) - {"packaging"})
    assert not {"taichi", "matplotlib", "pykitti", "prometheus-client"} & set(client)


def requirements(path: str) -> dict[str, str]:
    """Version and marker by the name of each package that a distribution needs without extras."""
    text = (ROOT / path).read_text(encoding="utf-8")
    listed = re.search(r"^dependencies = \[\n(.*?)^\]", text, re.MULTILINE | re.DOTALL)
    assert listed is not None
    lines = re.findall(r'"((?:[^"\\]|\\.)+)"', re.sub(r"#.*", "", listed[1]))
    return {line.partition(">")[0]: line.partition(">")[2] for line in lines}


@pytest.mark.nightly
def test_pip_finds_all_that_the_lines_need(tmp_path: Path) -> None:
    named = {extra for line in installed() for extra in re.findall(r"\w+", line)}
    named -= {"align", "bench", "fuzz"}  # large: they are installed in the nightly run
    command = [
        sys.executable,
        "-m",
        "pip",
        "install",
        "--dry-run",
        "--quiet",
        f".[{','.join(sorted(named))}]",
    ]
    done = subprocess.run(command, cwd=copied(tmp_path), capture_output=True, text=True, check=False)
    if done.returncode and re.search(r"hatchling|onnection|resolution|unreachable|[Tt]imed", done.stderr):
        pytest.skip(f"no package index can be reached: {done.stderr.strip().splitlines()[-1]}")
    assert done.returncode == 0, done.stderr


@pytest.mark.nightly
@pytest.mark.timeout(1800)
@pytest.mark.parametrize("what", installed())
def test_a_fresh_environment_is_installed(what: str, tmp_path: Path) -> None:
    subprocess.run([sys.executable, "-m", "venv", tmp_path / "venv"], check=True)
    python = tmp_path / "venv" / "bin" / "python"
    done = subprocess.run(
        [python, "-m", "pip", "install", "--quiet", what],
        cwd=copied(tmp_path), capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    doctor = subprocess.run([tmp_path / "venv" / "bin" / "tsfusion", "doctor"], check=False, cwd=tmp_path)
    assert doctor.returncode == 0


def copied(folder: Path) -> Path:
    """A copy of the clone that a build may write to."""
    left_out = shutil.ignore_patterns(".git", ".venv", "out", "__pycache__")
    return Path(shutil.copytree(ROOT, folder / "clone", ignore=left_out))
