# SPDX-License-Identifier: MIT
"""Either engine of kernels makes the same map, also on 64-bit Arm; wheels are where README says so."""

import os
import re
import subprocess
import sys
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from repository import ROOT

from lab.bench import engines

SIX = {"keyframes": 6, "voxel_size": 0.05, "color": False}
ROW = re.compile(r"^\| (Linux x86-64|Linux aarch64|macOS arm64) \| 3\.10–3\.13 \|", re.MULTILINE)
EMULATED = os.environ.get("TSFUSION_AARCH64", "")  # a Python of `engines.py --build-aarch64`
needs_emulated = pytest.mark.skipif(
    not EMULATED,
    reason="no emulated Python: TSFUSION_AARCH64=$(python lab/bench/engines.py --build-aarch64 DIR)",
)


def result(python: str, engine: str) -> dict[str, Any]:
    """The map's hash and the mesh's, of six keyframes."""
    return {
        name: text for name, text in engines.fused(python, engine, **SIX).items() if name in ("map", "mesh")
    }


@pytest.mark.skipif(
    not all(map(find_spec, engines.ENGINES)),
    reason="one engine alone is installed: pip install '.[quadrants]'",
)
def test_engines_agree_to_the_bit() -> None:
    taichi, quadrants = (result(sys.executable, name) for name in engines.ENGINES)
    assert taichi == quadrants


@needs_emulated
def test_64_bit_arm_agrees_to_the_bit() -> None:
    assert result(EMULATED, "quadrants") == result(sys.executable, "")


@needs_emulated
@pytest.mark.nightly
@pytest.mark.timeout(3600)
def test_the_demo_runs_on_64_bit_arm(tmp_path: Path) -> None:
    hashes = []
    for python in (EMULATED, sys.executable):
        out = tmp_path / Path(python).name
        command = [python, "-m", "tsfusion", "demo", "--rate", "1", "--out", out]
        done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, check=False)
        assert done.returncode == 0, done.stderr
        hashes += re.findall(r"hash (\w{32})", done.stdout)
    assert len(hashes) == 2
    assert hashes[0] == hashes[1]


def test_each_platform_asks_for_what_it_has() -> None:
    def names(platform: str, python: str, *extras: str) -> set[str]:
        return {re.split(r"[\[<>=]", one)[0] for one in engines.required(platform, python, *extras)}

    assert "taichi" in names("Linux x86-64", "3.11", "server")
    assert "quadrants" not in names("Linux x86-64", "3.11", "server")
    assert not {"taichi", "quadrants", "pydantic"} & names("Linux aarch64", "3.12")
    assert "quadrants" in names("Linux aarch64", "3.12", "server")
    assert [("pyrealsense2" in names("Linux aarch64", python, "scanner")) for python in engines.PYTHONS] == [
        True, False, True, False,
    ]  # fmt: skip
    assert "xatlas" not in names("Linux aarch64", "3.11", "test")
    assert "xatlas" in names("Linux x86-64", "3.11", "test")


def test_the_install_table_has_the_platforms() -> None:
    assert set(ROW.findall((ROOT / "README.md").read_text(encoding="utf-8"))) == set(engines.PLATFORMS)


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize("python", engines.PYTHONS)
@pytest.mark.parametrize("platform", engines.PLATFORMS)
def test_pip_finds_wheels_for_each_row(platform: str, python: str) -> None:
    named = engines.required(platform, python, "server", "scanner")
    lacking = engines.download(platform, python, [one for one in named if not one.startswith("pykitti")])
    if re.search(r"onnection|resolution|unreachable|[Tt]imed", lacking):
        pytest.skip(f"no package index can be reached: {lacking}")
    assert not lacking
