#!/usr/bin/env python3
# SPDX-License-Identifier: MIT
"""Compare the engines of kernels, Taichi and quadrants: maps, meshes, time; also on emulated 64-bit Arm.

    python lab/bench/engines.py                        # the installed engines, by turns
    python lab/bench/engines.py --build-aarch64 DIR    # an emulated Python in DIR, for --aarch64
    python lab/bench/engines.py --aarch64 DIR/python   # that one as well
    python lab/bench/engines.py --wheels               # which packages have wheels, by platform and Python

--build-aarch64 needs Debian's or Ubuntu's qemu-user-static and mmdebstrap, and 800 MB.
"""

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections import defaultdict
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from tsfusion.core.process import ENGINES

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

ROOT = Path(__file__).parents[2]
PYTHONS = ("3.10", "3.11", "3.12", "3.13")
_GLIBCS = ("manylinux_2_34", "manylinux_2_28", "manylinux_2_27", "manylinux_2_17", "manylinux2014")
PLATFORMS: dict[str, dict[str, str]] = {  # name → variables of markers
    "Linux x86-64": {"sys_platform": "linux", "platform_machine": "x86_64"},
    "Linux aarch64": {"sys_platform": "linux", "platform_machine": "aarch64"},
    "macOS arm64": {"sys_platform": "darwin", "platform_machine": "arm64"},
}
_MACOS = [f"macosx_{major}_0_arm64" for major in range(11, 16)]
_KEYFRAMES, _WARM_UP = 40, 5
_FUSE = f"""
import hashlib, json, os, platform, sys, time
os.sched_setaffinity(0, list(os.sched_getaffinity(0))[-1:])
began = time.process_time()
from tsfusion import Volume, open_dataset
from tsfusion.kernels import ENGINE
count, voxel_size, color = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3] == "color"
imported = time.process_time() - began
frames = list(open_dataset("synthetic:room", count=count))
volume, costs = Volume(voxel_size, threads=1, color=color), []
for keyframe in frames:
    started = time.process_time()
    volume.integrate(keyframe)
    costs.append(1e3 * (time.process_time() - started))
started = time.process_time()
mesh = volume.extract_mesh()
first_mesh = time.process_time() - started
started = time.process_time()
volume.extract_mesh()
again = time.process_time() - started
digest = hashlib.md5(mesh.vertices.tobytes() + mesh.faces.tobytes() + mesh.normals.tobytes()).hexdigest()
print(json.dumps({{
    "machine": platform.machine(), "engine": ENGINE, "map": volume.map_hash(), "mesh": digest,
    "start_s": imported + costs[0] / 1e3 + first_mesh - again,
    "keyframe_ms": sorted(costs[{_WARM_UP}:] or costs)[len(costs[{_WARM_UP}:] or costs) // 2],
    "mesh_ms": 1e3 * again,
}}))
"""


def fused(python: str, engine: str, *, keyframes: int, voxel_size: float, color: bool) -> dict[str, Any]:
    """Fuse a synthetic room with one engine in a process of its own; return its map's hash and CPU times.

    Raises:
        subprocess.CalledProcessError: when the process fails; its stderr has the error.
    """
    words = [str(keyframes), str(voxel_size), "color" if color else "plain"]
    done = subprocess.run(
        [python, "-c", _FUSE, *words], capture_output=True, text=True, check=True,
        env={**os.environ, "TSFUSION_ENGINE": engine}, cwd=ROOT,
    )  # fmt: skip
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def compare(pythons: dict[str, str], rounds: int) -> Iterator[dict[str, Any]]:
    """Yield the runs of each engine, by turns; an emulated Python makes one run, for its hashes alone."""
    engines = [name for name in ENGINES if find_spec(name)]
    for number in range(rounds):
        for engine in engines:
            yield fused(sys.executable, engine, keyframes=_KEYFRAMES, voxel_size=0.02, color=True) | {
                "round": number
            }
    for python in pythons.values():
        yield fused(python, "quadrants", keyframes=6, voxel_size=0.05, color=False)


def build_aarch64(folder: Path) -> Path:
    """Unpack an aarch64 Debian with Python and our packages; return the command that runs it, emulated.

    Raises:
        SystemExit: without qemu-aarch64-static or mmdebstrap.
    """
    for tool in ("qemu-aarch64-static", "mmdebstrap"):
        if shutil.which(tool) is None:
            raise SystemExit(f"{tool} is missing: apt-get install qemu-user-static mmdebstrap")
    root, packages, command = folder / "root", folder / "packages", folder / "python"
    folder.mkdir(parents=True, exist_ok=True)
    # Packages are unpacked only: nothing of them is run, so that the system needs no binfmt_misc.
    subprocess.run(
        ["mmdebstrap", "--mode=root", "--arch=arm64", "--variant=extract", "--include=python3,libglib2.0-0",
         "bookworm", root], check=True,
    )  # fmt: skip
    (version,) = (one.name.removeprefix("python") for one in (root / "usr/bin").glob("python3.??"))
    named = [text for text in required("Linux aarch64", version, "server") if not text.startswith("pykitti")]
    download("Linux aarch64", version, named, packages)
    subprocess.run(
        [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--target", packages, "pykitti"],
        check=True,
    )
    emulated = f'qemu-aarch64-static -L "{root}" -0 "{command}" "{root}/usr/bin/python{version}"'
    paths = f'PYTHONPATH="{ROOT}:{packages}"'
    command.write_text(f'#!/bin/sh\n{paths} exec {emulated} "$@"\n', encoding="utf-8")
    command.chmod(0o755)
    return command


def required(platform: str, python: str, *extras: str) -> list[str]:
    """Return what pip is asked for on a platform: names and versions, without markers."""
    from packaging.requirements import Requirement

    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines = [
        *project["dependencies"],
        *(one for extra in extras for one in project["optional-dependencies"][extra]),
    ]
    variables = PLATFORMS[platform] | {"python_version": python, "python_full_version": f"{python}.0"}
    wanted = []
    for line in lines:
        one = Requirement(line)
        if one.name == "tsfusion":
            wanted += required(platform, python, *one.extras)
        elif one.marker is None or one.marker.evaluate({**variables, "extra": ""}):
            extra = f"[{','.join(one.extras)}]" if one.extras else ""
            wanted.append(f"{one.name}{extra}{one.specifier}")
    return sorted(set(wanted))


def download(platform: str, python: str, packages: list[str], target: Path | None = None) -> str:
    """Ask pip for wheels of packages for another platform; return what has none, empty if all have one.

    Args:
        target: folder to unpack them to; None only asks.
    """
    variables = PLATFORMS[platform]
    is_linux = variables["sys_platform"] == "linux"
    kinds = [f"{one}_{variables['platform_machine']}" for one in _GLIBCS] if is_linux else _MACOS
    words = [word for one in kinds for word in ("--platform", one)] + ([] if target else ["--dry-run"])
    install = [sys.executable, "-m", "pip", "install", "--quiet", "--only-binary=:all:"]
    with tempfile.TemporaryDirectory() as nowhere:
        done = subprocess.run(
            [*install, "--python-version", python, *words, "--target", target or nowhere, *packages],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
    lacking = [
        line.split(" for ")[-1] for line in done.stderr.splitlines() if "No matching distribution" in line
    ]
    return ", ".join(lacking) or (done.stderr.strip().splitlines()[-1] if done.returncode else "")


def wheels(extras: list[tuple[str, ...]]) -> Iterator[tuple[str, str, str, str]]:
    """Yield platform, Python, extras, and what has no wheel there."""
    for platform in PLATFORMS:
        for python in PYTHONS:
            for chosen in extras:
                named = [one for one in required(platform, python, *chosen) if not one.startswith("pykitti")]
                yield platform, python, "+".join(chosen) or "base", download(platform, python, named)


def main() -> None:
    """Print a JSON line for each run, then the ratios of quadrants to Taichi; or what was asked for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3, help="runs of each engine (default: 3)")
    parser.add_argument("--aarch64", type=Path, metavar="PYTHON", help="an emulated Python")
    parser.add_argument("--build-aarch64", type=Path, metavar="DIR", help="make one in this folder")
    parser.add_argument("--wheels", action="store_true", help="say which packages have wheels")
    arguments = parser.parse_args()
    if arguments.build_aarch64:
        print(build_aarch64(arguments.build_aarch64.absolute()))
        return
    if arguments.wheels:
        for row in wheels([(), ("server",), ("scanner",), ("test",)]):
            print("\t".join(row), flush=True)
        return
    found: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for one in compare({"aarch64": str(arguments.aarch64)} if arguments.aarch64 else {}, arguments.rounds):
        print(json.dumps(one), flush=True)
        found[one["machine"], one["engine"]].append(one)
    taichi, quadrants = (found.get((os.uname().machine, name), []) for name in ENGINES)
    for figure in ("start_s", "keyframe_ms", "mesh_ms") if taichi and quadrants else ():
        best = [min(one[figure] for one in runs[1:] or runs) for runs in (taichi, quadrants)]
        print(f"{figure}: quadrants is {best[1] / best[0]:.2f} of taichi")


if __name__ == "__main__":
    main()
