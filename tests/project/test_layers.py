# SPDX-License-Identifier: MIT
"""Imports go down the table of ARCHITECTURE.md, and what must stay light stays light."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest
from command_processes import python
from repository import ROOT, TESTS

PACKAGE = ROOT / "tsfusion"

# Top to bottom. A wing imports from the rows below its own, and nothing from its neighbours in the row.
ROWS = (
    ("__main__",),
    ("cli",),
    ("cluster",),
    ("pipelines",),
    ("scanner", "server"),
    ("gateway", "client", "evaluation"),
    ("fuser", "delivery", "datasets", "viewer"),
    ("journal",),
    ("tsdf", "wire"),
    ("kernels", "geometry"),
    ("core",),
)

# Folders of a wing, top to bottom. A room imports from those behind it, and from the folder that holds it.
ROOMS = {
    "pipelines": ("shown", "runs", "report", "maps"),
    "scanner": ("sources", "localization"),
    "scanner.localization": ("rgbd", "stereo", "loop_closure", "pose_feed"),
    "gateway": ("people", "migration", "intake", "maps", "records", "clients", "fusers", "ports", "health"),
    "datasets": ("formats", "ros2", "rosbag", "worlds", "download"),
    "viewer": ("panels", "foxglove", "map", "page"),
    "tsdf": ("device", "files", "texture", "answers", "sums", "surface", "integration", "store"),
    "wire": ("asking", "messages", "keys", "records", "sockets"),
    "kernels": ("device", "worlds", "answers", "surface", "integration", "base"),
}

# Files that import one another in a circle, types included.
CIRCLES: list[str] = []

# All others run where there is no Taichi, and answer while kernels run.
MAY_REACH_TAICHI = (
    *(
        "kernels",
        "tsdf",
        "fuser",
        "datasets.worlds",
        "evaluation",
        "pipelines",
        "cluster",
        "cli",
        "pipelines.runs.run",
        "__main__",
    ),
)
TAICHI_FREE = ("fuser.fuser_messages",)
LIGHT = (
    *("client", "server", "scanner.scanner", "wire.records.codec"),
    *(
        "journal",
        "journal.journaled_keyframes",
        "datasets",
        "cli",
        "wire.asking.map_client",
        "wire.asking.map_watcher",
    ),
)


@cache
def modules() -> dict[str, Path]:
    """Dotted name inside the package → file."""
    found = {}
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        found[".".join(part for part in parts if part != "__init__")] = path
    return found


@cache
def parsed(name: str) -> ast.Module:
    return ast.parse(modules()[name].read_text(encoding="utf-8"))


def is_for_types(node: ast.AST) -> bool:
    """Whether it is an `if TYPE_CHECKING:`."""
    return isinstance(node, ast.If) and "TYPE_CHECKING" in (
        getattr(node.test, "id", None), getattr(node.test, "attr", None)
    )  # fmt: skip


@cache
def imports(name: str, *, loading: bool = False, types: bool = False) -> frozenset[str]:
    """Every absolute name it imports; `loading`: none inside functions; `types`: those for types too."""
    tree = parsed(name)
    left_out = {
        id(inner)
        for node in ast.walk(tree)
        if (is_for_types(node) and not types) or (loading and isinstance(node, ast.FunctionDef))
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


def own_imports(name: str, *, loading: bool = False, types: bool = False) -> set[str]:
    """The package's modules it imports, by dotted name inside the package."""
    found = set()
    for target in imports(name, loading=loading, types=types):
        head, *parts = target.split(".")
        if head != "tsfusion":
            continue
        while parts and ".".join(parts) not in modules():
            parts.pop()
        found.add(".".join(parts))
    return found - {"", name}  # the package itself holds the version and loads names on demand


def wing(name: str) -> str:
    """The folder of a module, or the module itself where it stands at the root."""
    return name.partition(".")[0]


def row(name: str) -> int:
    """Index of the wing's row; 0 is the top."""
    rows = [index for index, wings in enumerate(ROWS) if wing(name) in wings]
    assert rows, f"tsfusion.{name} has no row: add its wing here and in ARCHITECTURE.md"
    return rows[0]


def may_reach_taichi(name: str) -> bool:
    inside = any(name == place or name.startswith(f"{place}.") for place in MAY_REACH_TAICHI)
    return inside and name not in TAICHI_FREE


INSIDE = sorted(name for name in modules() if name)


def test_architecture_shows_every_wing() -> None:
    text = (ROOT / "ARCHITECTURE.md").read_text(encoding="utf-8")
    shown = set(re.findall(r"^  (\w+)(?:/|\.py) ", text, re.MULTILINE))
    assert shown >= {one for wings in ROWS for one in wings} - {"__main__"}


def test_tests_lie_where_their_wing_says() -> None:
    folders = {path.parent for path in TESTS.rglob("test_*.py")}
    others = {TESTS / name for name in ("end_to_end", "lab", "project")}
    assert others <= folders
    for folder in folders - others:
        assert (PACKAGE / folder.relative_to(TESTS)).is_dir(), f"{folder} is the folder of no wing"


def test_imports_go_down() -> None:
    upward = [
        f"tsfusion.{name} imports {target}, which is not below it"
        for name in INSIDE
        for target in sorted(own_imports(name))
        if wing(target) != wing(name) and row(target) <= row(name)
    ]
    assert not upward


def rooms_of(name: str) -> dict[str, str]:
    """Folder → the room of it that a module stands in."""
    parts = name.split(".")[:-1]
    return {".".join(parts[:depth]): parts[depth] for depth in range(1, len(parts))}


def test_rooms_import_down() -> None:
    found = {(folder, room) for name in INSIDE for folder, room in rooms_of(name).items()}
    assert found == {(folder, room) for folder, rooms in ROOMS.items() for room in rooms}
    upward = [
        f"tsfusion.{name} imports {target}, whose room is above"
        for name in INSIDE
        for target in sorted(own_imports(name, types=True))
        for folder, room in rooms_of(name).items()
        if (there := rooms_of(target).get(folder)) and ROOMS[folder].index(there) < ROOMS[folder].index(room)
    ]
    assert not upward


def test_files_import_one_another_in_no_new_circle() -> None:
    """Imports inside functions and for types count."""
    direct = {name: own_imports(name, types=True) for name in INSIDE}

    @cache
    def reached(start: str) -> frozenset[str]:
        seen: set[str] = set()
        waiting = [start]
        while waiting:
            new = direct[waiting.pop()] - seen
            seen |= new
            waiting.extend(new)
        return frozenset(seen)

    circles = {
        tuple(sorted(other for other in reached(name) if name in reached(other)))
        for name in INSIDE
        if name in reached(name)
    }
    shown = [f"{wing(one[0])}: {' '.join(name.partition('.')[2] for name in one)}" for one in circles]
    assert sorted(shown) == CIRCLES


def test_no_module_needs_what_is_not_installed() -> None:
    for name in modules():
        heads = {target.partition(".")[0] for target in imports(name)}
        assert not heads & {"lab", "scripts", "tests"}, f"tsfusion.{name} imports from beside the package"


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
        if not may_reach_taichi(name):
            reached, waiting = set(), [name]
            while waiting:
                at = waiting.pop()
                if at not in reached:
                    reached.add(at)
                    waiting.extend(own_imports(at, loading=name.startswith("datasets")))
            heavy = {at for at in reached if wing(at) in {"kernels", "tsdf"}}
            assert not heavy, f"tsfusion.{name} reaches {', '.join(sorted(heavy))}"
            assert not any(target.split(".")[0] == "taichi" for at in reached for target in imports(at))


@pytest.mark.parametrize(
    ("name", "heavy"),
    [
        *((name, "taichi pykitti open3d matplotlib") for name in LIGHT),
        ("client", "cv2 mcap.writer scipy"),
        ("cli", "numpy zmq cv2 msgspec taichi trimesh"),
        ("cli.status", "numpy zmq msgspec rich.table"),
    ],
)
def test_import_leaves_heavy_modules_out(name: str, heavy: str) -> None:
    done = python(
        f"import sys, tsfusion.{name}; sys.exit(', '.join({set(heavy.split())} & set(sys.modules)) or 0)"
    )
    assert done.returncode == 0, f"import tsfusion.{name} also imports {done.stderr}"


def test_header_and_docstring() -> None:
    for name in INSIDE:
        text = modules()[name].read_text(encoding="utf-8")
        assert text.startswith("# SPDX-License-Identifier: MIT\n"), f"tsfusion.{name} has no such line"
        assert name == "kernels" or ast.get_docstring(parsed(name)), f"tsfusion.{name} has no docstring"
