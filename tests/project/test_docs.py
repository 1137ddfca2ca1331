# SPDX-License-Identifier: MIT
"""The documents name only what exists; their commands are understood, and their Python runs as it stands."""

import ast
import doctest
import inspect
import io
import os
import re
import shlex
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import doc_pages
import msgspec
import numpy as np
import own_recordings
import pytest
from command_processes import server
from repository import ROOT

import tsfusion
from tsfusion.core.config import ClientConfig, ServerConfig

ROOT_DOCUMENTS = ("README.md", "ARCHITECTURE.md", "CONTRIBUTING.md")
DOCUMENTS = [*(ROOT / name for name in ROOT_DOCUMENTS), *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("path", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_files_and_tests_that_are_named_exist(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for file, test in re.findall(r"((?:lab|tests|scripts|docs)/[\w/.-]+\.\w+)(?:::(\w+))?", text):
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
        assert (ROOT / "".join(path)).exists() or path[0].startswith(("dist/", "out/")), path
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    commands = [shlex.split(line, comments=True) for line in "".join(blocks).splitlines()]
    assert len(commands) >= 8
    for word in (word for command in commands for word in command if word.startswith(("lab/", "tests/"))):
        assert (ROOT / word).exists(), word


PAGES = [pytest.param(page, id=str(page.relative_to(ROOT))) for page in doc_pages.PAGES]
PYTHON = [page for page in PAGES if any(b.language == "python" for b in doc_pages.blocks(page.values[0]))]
LANGUAGES = {*doc_pages.SHELL, "python", "text", "toml", "cpp", "json", "diff"}


@pytest.mark.parametrize("page", PAGES)
def test_every_command_shown_is_understood(page: Path) -> None:
    """Each `tsfusion VERB …` line names a verb, flags and values that the command itself takes."""
    for block in doc_pages.blocks(page):
        assert block.language in LANGUAGES, f"{page.name}:{block.line}"
        assert block.mark in ("", "background") or block.needs, f"{page.name}:{block.line}: {block.mark}"
        if block.language in doc_pages.SHELL:
            for words in doc_pages.commands(block):
                assert not doc_pages.misread(words), f"{page.name}:{block.line}: {' '.join(words)}"
    for words in doc_pages.inline_commands(page):
        assert not doc_pages.unknown_words(words), f"{page.name}: `tsfusion {' '.join(words)}`"


def test_commands_are_found_and_wrong_ones_seen() -> None:
    found = [
        words
        for page in doc_pages.PAGES
        for block in doc_pages.blocks(page)
        if block.language in doc_pages.SHELL
        for words in doc_pages.commands(block)
    ]
    assert len(found) > 80
    assert "no verb" in doc_pages.misread(["scna"])
    assert "--voxelsize" in doc_pages.misread(["replay", "room", "--voxelsize", "0.02"])
    assert doc_pages.unknown_words(["map", "crpo"]) == ["crpo"]
    assert doc_pages.unknown_words(["mesh", "MAP", "--weight", "2"]) == ["--weight"]
    assert doc_pages.misread(["map", "crop", "a.tsf", "--box", "0", "0"])


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with a finished run, as pages assume one, and the address of a server in `ADDRESS`."""
    folder = tmp_path_factory.mktemp("reader")
    volume = tsfusion.Volume(voxel_size=0.02)
    for keyframe in tsfusion.open_dataset("synthetic:room", count=2):
        volume.integrate(keyframe)
    for run in ("out/latest", "room-run"):
        (folder / run).mkdir(parents=True)
        volume.save(folder / run / "map.tsf")
    volume.save_voxels(folder / "voxels.npz")
    view = replace(keyframe, depth=keyframe.depth // 10, depth_scale=0.001)
    own_recordings.image(folder / "incoming", "000000", view)
    with server(folder / "state", "--voxel-size", 0.05) as (address, _):
        (folder / "ADDRESS").write_text(address)
        with tsfusion.Client(address) as client:
            client.send(keyframe)
            client.wait_fused()
        yield folder


@pytest.mark.parametrize("page", PYTHON)
def test_python_runs(page: Path, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A page's Python runs from its first block to its last; what never ends is compiled."""
    monkeypatch.chdir(place)
    given = {
        "points": np.zeros((4, 3)),
        "keyframes": list(tsfusion.open_dataset("synthetic:room", count=2)),
        "volume": tsfusion.Volume.load("out/latest/map.tsf"),
        "__name__": "page",
    }
    for block in doc_pages.blocks(page):
        if block.language != "python":
            continue
        code = doc_pages.addressed(block.code, (place / "ADDRESS").read_text())
        program = compile(code, f"{page.name}:{block.line}", "exec")
        if not block.needs and not block.title and not _goes_on(code):
            exec(program, given)


@pytest.mark.parametrize("name", sorted(set(tsfusion.__all__) - {"__version__"}))
def test_examples_in_docstrings_run(name: str, place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(place)
    text = doc_pages.addressed(inspect.getdoc(getattr(tsfusion, name)) or "", (place / "ADDRESS").read_text())
    given = {"np": np, "tsfusion": tsfusion}
    examples = doctest.DocTestParser().get_doctest(text, given, name, None, 0)
    said = io.StringIO()
    assert doctest.DocTestRunner().run(examples, out=said.write).failed == 0, said.getvalue()


def _goes_on(code: str) -> bool:
    """Whether it loops for ever."""
    loops = (node for node in ast.walk(ast.parse(code)) if isinstance(node, ast.While))
    return any(isinstance(loop.test, ast.Constant) for loop in loops)


def test_what_is_shown_as_a_file_is_that_file() -> None:
    """A block with the name of an example is the example, to the letter; `test_examples.py` runs it."""
    shown = {}
    for page in doc_pages.PAGES:
        for block in doc_pages.blocks(page):
            if block.title.startswith("examples/"):
                assert block.code == (ROOT / block.title).read_text(encoding="utf-8"), block.title
                shown[block.title] = page
    assert set(shown) == {str(path.relative_to(ROOT)) for path in (ROOT / "examples").glob("*.py")}


def test_links_lead_somewhere() -> None:
    for page in doc_pages.PAGES:
        text = page.read_text(encoding="utf-8")
        text = re.sub(r"^```.*?^```$|`[^`\n]*`", "", text, flags=re.DOTALL | re.MULTILINE)
        for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
            if "://" not in link and not link.startswith("reference/"):
                assert (page.parent / link).exists() or _is_generated(page, link), f"{page.name}: {link}"


def _is_generated(page: Path, link: str) -> bool:
    """Whether the site alone has that page; `test_site.py` builds it."""
    place = os.path.relpath((page.parent / link).resolve(), ROOT / "docs")
    return place in {f"reference/{name}.md" for name in ("cli", "settings", "architecture", "changelog")}


def _said_by(path: Path) -> Iterator[str]:
    """Every text in a module; what is put into it is left out."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.JoinedStr):
            yield "".join(str(one.value) if isinstance(one, ast.Constant) else "…" for one in node.values)
        elif isinstance(node, ast.Constant) and isinstance(node.value, str):
            yield node.value


def test_the_messages_that_are_explained_are_said() -> None:
    """Each message in the first column of a table of `troubleshooting.md` stands in the code."""
    said = "\n".join(
        " ".join(text.split()) for path in (ROOT / "tsfusion").rglob("*.py") for text in _said_by(path)
    )
    page = (ROOT / "docs" / "troubleshooting.md").read_text(encoding="utf-8")
    elsewhere = ("cannot open shared object file", "Address already in use")  # the system's
    found = 0
    for cell in re.findall(r"^\| ([^|]*`[^|]*) \|", page, re.MULTILINE):
        for message in re.findall(r"`([^`]+)`", cell):
            for part in re.split(r"…|\bN\b|\b\d+(?:×\d+)?\b|\w+:// ?|(?<=\w): ", message):
                words = part.strip(" :→")
                if " " in words and not any(words in one for one in elsewhere):
                    found += 1
                    assert words in said, f"{message!r}: {words!r}"
    assert found > 15
