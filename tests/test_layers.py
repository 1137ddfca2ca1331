# SPDX-License-Identifier: MIT
"""Imports go down the table of ARCHITECTURE.md, and what must stay light stays light."""

import ast
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "tsfusion"

# Top to bottom. A module may import from its own row (without a cycle) and from the rows below it.
ROWS: tuple[tuple[str, frozenset[str]], ...] = (
    ("command line", frozenset({"cli", "__main__"})),
    ("whole runs", frozenset({"pipeline", "scanning", "destination", "scan_results", "summary", "child"})),
    ("processes", frozenset({"server", "gateway", "intake", "door", "atlas", "hosted", "outcomes",
                             "retention", "reports", "questions", "quota", "quarantine", "routes",
                             "sessions", "subscriptions", "ports", "fuser_link", "fuser_process",
                             "fuser", "saved_map", "client", "scanner", "fetch", "backpressure", "room",
                             "sender", "connection", "conversation", "refused", "outbox", "spool",
                             "gone", "times", "recording", "corrector", "revisions", "correcting"})),
    ("views and sources", frozenset({"datasets", "localizers", "sources", "evaluation", "ledger", "preview",
                             "results", "metrics", "inspection", "salvage", "ros"})),
    ("map and wire", frozenset({"volume", "integration", "surface", "field", "blockstore", "meshing",
                             "scratch", "storage", "checkpoint", "warmup", "journal", "transport",
                             "codec", "maps", "keys", "corrections"})),
    ("ground", frozenset({"kernels", "runtime", "keyframe", "frame", "stereo", "se3", "calibration",
                             "calibration_files", "config", "config_toml", "mesh", "errors", "process",
                             "disk", "logs", "watchdog", "private_folder", "registration"})),
)  # fmt: skip

# All others run where there is no Taichi, and answer while kernels run.
MAY_REACH_TAICHI = frozenset({
    "__main__", "cli", "pipeline", "scanning", "scan_results", "summary", "fuser", "saved_map", "datasets",
    "evaluation", "preview",
    "volume", "integration", "surface", "field", "blockstore", "meshing", "scratch", "storage", "checkpoint",
    "warmup", "kernels", "runtime",
})  # fmt: skip
MAY_IMPORT_KERNELS = frozenset({
    "kernels", "runtime", "volume", "integration", "surface", "field", "blockstore", "meshing", "scratch",
    "preview",
    "datasets.synthetic", "evaluation.predict",
})  # fmt: skip


@cache
def modules() -> dict[str, Path]:
    """Dotted name inside the package → file."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = path
    return found


@cache
def imports(name: str, *, loading: bool = False) -> frozenset[str]:
    """Every absolute name it imports, type-only ones left out; `loading`: those inside functions too."""
    tree = ast.parse(modules()[name].read_text(encoding="utf-8"))
    left_out = {
        id(inner)
        for node in ast.walk(tree)
        if (isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test))
        or (loading and isinstance(node, ast.FunctionDef))
        for statement in node.body
        for inner in ast.walk(statement)
    }
    found: set[str] = set()
    for node in ast.walk(tree):
        if id(node) in left_out:
            continue
        if isinstance(node, ast.Import):
            found.update(alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, f"tsfusion.{name} imports relatively: {ast.unparse(node)}"
            assert node.module is not None
            found.update(f"{node.module}.{alias.name}" for alias in node.names)
    return frozenset(found)


def own_imports(name: str, *, loading: bool = False) -> set[str]:
    """The package's modules it imports, by dotted name inside the package."""
    found = set()
    for target in imports(name, loading=loading):
        head, *parts = target.split(".")
        if head != "tsfusion":
            continue
        while parts and ".".join(parts) not in modules():
            parts.pop()
        found.add(".".join(parts))
    return found - {"", name}  # the package itself holds the version and loads names on demand


def row(name: str) -> int:
    """Index of the module's row; 0 is the top."""
    top = name.partition(".")[0]
    rows = [index for index, (_, members) in enumerate(ROWS) if top in members]
    assert rows, f"tsfusion.{name} has no row: add it here and in ARCHITECTURE.md"
    return rows[0]


INSIDE = sorted(name for name in modules() if name)


def test_architecture_shows_this_table() -> None:
    text = (PACKAGE.parent / "ARCHITECTURE.md").read_text(encoding="utf-8")
    for title, members in ROWS:
        (shown,) = re.findall(rf"^\| {title} \| (.+) \|$", text, re.MULTILINE)
        assert set(re.findall(r"`(\w+)`", shown)) == members, title


@pytest.mark.parametrize("name", INSIDE)
def test_imports_go_down(name: str) -> None:
    upward = {target for target in own_imports(name) if row(target) < row(name)}
    assert not upward, f"tsfusion.{name} imports upward: {', '.join(sorted(upward))}"


def test_package_root_imports_nothing() -> None:
    assert own_imports("") == set()


def test_no_cycles() -> None:
    finished: set[str] = set()

    def visit(name: str, path: tuple[str, ...]) -> None:
        assert name not in path, " → ".join((*path[path.index(name) :], name))
        if name not in finished:
            for target in own_imports(name, loading=True):
                visit(target, (*path, name))
            finished.add(name)

    for name in INSIDE:
        visit(name, ())


def test_light_modules_reach_no_kernel() -> None:
    for name in INSIDE:
        if name.split(".")[0] not in MAY_REACH_TAICHI:
            reached, waiting = set(), [name]
            while waiting:
                at = waiting.pop()
                if at not in reached:
                    reached.add(at)
                    waiting.extend(own_imports(at))
            heavy = {at for at in reached if at.split(".")[0] in {"kernels", "runtime", "volume"}}
            assert not heavy, f"tsfusion.{name} reaches {', '.join(sorted(heavy))}"
            assert not any(target.split(".")[0] == "taichi" for at in reached for target in imports(at))


def test_kernels_have_few_callers() -> None:
    for name in INSIDE:
        if {target.split(".")[0] for target in own_imports(name)} & {"kernels"}:
            assert {name, name.split(".")[0]} & MAY_IMPORT_KERNELS, f"tsfusion.{name} imports kernels"


@pytest.mark.parametrize(
    "name", ["client", "server", "recording", "codec", "journal", "ledger", "datasets", "cli"]
)
def test_import_leaves_taichi_out(name: str) -> None:
    program = (
        f"import sys, tsfusion.{name}; "
        "sys.exit(', '.join({'taichi', 'pykitti', 'open3d', 'matplotlib'} & set(sys.modules)) or 0)"
    )
    done = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, f"import tsfusion.{name} also imports {done.stderr}"


@pytest.mark.parametrize("name", INSIDE)
def test_header_and_docstring(name: str) -> None:
    text = modules()[name].read_text(encoding="utf-8")
    assert text.startswith("# SPDX-License-Identifier: MIT\n")
    assert name == "kernels" or ast.get_docstring(ast.parse(text)), f"tsfusion.{name} has no docstring"
