# SPDX-License-Identifier: MIT
"""The names that `import tsfusion` offers."""

import inspect
import re

import pytest
from command_processes import python
from repository import ROOT

import tsfusion
from tsfusion.core import errors


def test_every_name_offered_is_there() -> None:
    assert sorted(tsfusion.__all__) == dir(tsfusion)
    for name in tsfusion.__all__:
        assert getattr(tsfusion, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'Volumes'"):
        tsfusion.Volumes


def _errors() -> set[str]:
    """Names of the classes that the module of errors defines."""
    found = inspect.getmembers(errors, inspect.isclass)
    return {name for name, value in found if value.__module__ == errors.__name__}


def test_the_public_surface() -> None:
    """A name more or less here is a change that users see: CHANGELOG."""
    tree = _errors()
    assert set(tsfusion.__all__) - tree == {
        "Blocks", "Client", "Config", "DistanceField", "DistanceSlice", "Intrinsics", "Keyframe",
        "Layout", "MapClient", "Mesh", "OccupancySlice", "PointCloud", "Samples", "SliceGrid",
        "Source", "View", "Volume", "VolumeConfig", "__version__", "open_dataset", "open_source",
    }  # fmt: skip
    assert tree <= set(tsfusion.__all__)
    assert all(issubclass(getattr(errors, name), tsfusion.TsfusionError) for name in tree)
    assert all(name in (errors.__doc__ or "") for name in tree)


def test_help_names_what_is_public() -> None:
    """The docstring names each class and function, and each has an example and says what it takes."""
    tree = _errors()
    for name in set(tsfusion.__all__) - tree - {"__version__"}:
        assert re.search(rf"\b{name}\b", tsfusion.__doc__ or ""), name
        assert ">>> " in (inspect.getdoc(getattr(tsfusion, name)) or ""), name


# Calls between the wings: `docs/reference/python.md` leaves them out.
_WITHIN = re.findall(r'"!\^\(([\w|]+)\)\$"', (ROOT / "docs/reference/python.md").read_text(encoding="utf-8"))[
    0
]
_BY_SETTINGS = ("Config", "VolumeConfig")  # each field stands on the page of settings


def test_docstrings_name_every_argument() -> None:
    """Each argument of a public class, method or function stands in its docstring, with unit or shape."""
    checked = 0
    tree = _errors()
    for name in sorted(set(tsfusion.__all__) - tree - {"__version__", "Source"}):
        public = getattr(tsfusion, name)
        found = {} if name in _BY_SETTINGS else {name: public}
        if inspect.isclass(public):
            methods = inspect.getmembers(public, callable)
            found |= {
                f"{name}.{word}": value
                for word, value in methods
                if not word.startswith("_") and word not in _WITHIN.split("|")
            }
        for place, value in found.items():
            if not getattr(value, "__module__", "").startswith("tsfusion"):
                continue  # inherited from a library
            text = inspect.getdoc(value) or ""
            for argument in set(inspect.signature(value).parameters) - {"self", "cls"}:
                checked += 1
                named = rf"^ *(\w+, )*{argument}(, \w+)*: |`[^`]*\b{argument}\b[^`]*`"
                assert re.search(named, text, re.MULTILINE), f"{place}: {argument}"
    assert checked > 150


def test_a_scanner_imports_no_taichi() -> None:
    program = (
        "import sys, tsfusion; tsfusion.FlushTimeout, tsfusion.InvalidKeyframe; "
        "tsfusion.Client, tsfusion.Keyframe; sys.exit('taichi' in sys.modules)"
    )
    assert python(program).returncode == 0


def test_a_scan_loads_nothing_that_only_some_scans_need() -> None:
    """Pages, a place in a map and worlds that are made up: ten megabytes of a robot's memory."""
    program = (
        # NumPy and OpenCV load some of it themselves, by their version
        "import sys, numpy, cv2; there = set(sys.modules); import tsfusion.pipelines.runs.run; "
        "few = {'asyncio', 'multiprocessing', 'numpy.random', 'ssl'} - there; "
        "sys.exit(' '.join(few & set(sys.modules)) or None)"
    )
    done = python(program)
    assert done.returncode == 0, done.stderr
