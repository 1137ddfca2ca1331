# SPDX-License-Identifier: MIT
"""`tsfusion doctor`: check the installation, and say what to do about each fault."""

import platform
import shutil
import socket
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module, metadata
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options
from tsfusion.core.process import ENGINES, version_of

if TYPE_CHECKING:
    from packaging.requirements import Requirement

PYTHONS = ((3, 10), (3, 13))
DISK_BYTES = 2_000_000_000
_CLIENT = "tsfusion-client"
# `tsfusion.kernels` imports the engine without its banner.
_MODULES = {
    "opencv-python-headless": "cv2", "prometheus-client": "prometheus_client", "pyzmq": "zmq",
    **dict.fromkeys(ENGINES, "tsfusion.kernels"),
}  # fmt: skip


# Optional parts: name of the extra → its package, and what it is for.
_EXTRAS = {
    "slam": ("scipy", "loop closure"),
    "lidar": ("kiss-icp", "LiDAR odometry"),
    "realsense": ("pyrealsense2", "RealSense cameras"),
    "ros": ("rosbags", "ROS recordings"),
    "exr": ("OpenEXR", "depth in EXR files"),
    "download": ("pooch", "public recordings"),
}


@dataclass(frozen=True)
class Finding:
    """Result of one check."""

    name: str  # what was checked
    ok: bool
    found: str  # version or state, or the fault
    advice: str = ""  # what to do; empty if nothing
    optional: bool = False  # an optional part that is not installed


def doctor(
    path: Annotated[
        Path, typer.Argument(metavar="DIR", help="Folder for maps, whose disk is checked, too.")
    ] = Path(),
    json: options.Json = False,
) -> int:
    """Check the installation, and say what to do about each fault.

    Exit status 1 when something is wrong.
    """
    findings = []
    for finding in check(path):
        findings.append(finding)
        if not json:
            _print_finding(finding)
    ok = all(finding.ok for finding in findings)
    if json:
        from tsfusion.cli import output

        output.as_json({"ok": ok, "checks": findings})
    elif ok:
        typer.echo("all good: try `tsfusion demo`")
    return 0 if ok else 1


def check(path: Path) -> Iterator[Finding]:
    """Yield each finding as soon as it is known."""
    yield _python()
    yield from _packages()
    yield from map(_extra, _EXTRAS)
    if _installed() == _CLIENT:
        yield Finding("kernels", True, f"left out: {_CLIENT} sends to a server that fuses", optional=True)
    else:
        yield _guarded(_kernels, "kernels", "unset TSFUSION_ENGINE, and install taichi or quadrants again")
    yield _guarded(_port, "loopback", "let this user listen on 127.0.0.1")
    yield _disk(path)


def _print_finding(finding: Finding) -> None:
    mark = typer.style("✓", fg="green") if finding.ok else typer.style("✗", fg="red")
    mark = "–" if finding.optional else mark
    advice = f" → {finding.advice}" if finding.advice else ""
    typer.echo(f"{mark} {finding.name}: {finding.found}{advice}")


def _python() -> Finding:
    low, high = (".".join(map(str, version)) for version in PYTHONS)
    ok = PYTHONS[0] <= sys.version_info[:2] <= PYTHONS[1]
    found = f"{platform.python_version()} on {platform.platform(terse=True)} {platform.machine()}"
    return Finding("python", ok, found, "" if ok else f"install Python {low} to {high}")


def _packages() -> Iterator[Finding]:
    """Yield a finding for each package that this installation needs, without the extras."""
    try:
        from packaging.requirements import Requirement

        requirements = [Requirement(line) for line in metadata.requires(_installed()) or []]
    except (ImportError, metadata.PackageNotFoundError) as error:
        yield Finding(
            "packages",
            False,
            f"tsfusion is not installed completely ({error})",
            "pip install . in your clone of tsfusion",
        )
        return
    for requirement in sorted(requirements, key=lambda requirement: requirement.name):
        if requirement.marker is None or requirement.marker.evaluate({"extra": ""}):
            yield _package(requirement)
        elif requirement.name == "taichi" and version_of("quadrants") != "missing":
            yield _package(Requirement("quadrants"))
        elif requirement.name == "taichi":
            found = f"no build for Python {platform.python_version()} on {platform.machine()}"
            advice = "to fuse here, pip install '.[server]'; to send keyframes elsewhere, nothing"
            yield Finding("taichi", False, found, advice)


def _installed() -> str:
    """Return the name of the installed distribution: the whole tsfusion, or a robot's `tsfusion-client`."""
    try:
        metadata.version("tsfusion")
    except metadata.PackageNotFoundError:
        with suppress(metadata.PackageNotFoundError):
            metadata.version(_CLIENT)
            return _CLIENT
    return "tsfusion"


def _package(requirement: "Requirement") -> Finding:
    name = requirement.name
    advice = f"pip install '{name}{requirement.specifier}'"
    try:
        version = metadata.version(name)
        import_module(_MODULES.get(name, name))
    except metadata.PackageNotFoundError:
        return Finding(name, False, "missing", advice)
    except Exception as error:  # noqa: BLE001  whatever an import of a broken package raises is the finding
        return Finding(name, False, f"{version} does not import: {error}", f"{advice} --force-reinstall")
    if not requirement.specifier.contains(version, prereleases=True):
        return Finding(name, False, f"{version}, needs {requirement.specifier}", advice)
    return Finding(name, True, version)


def _extra(name: str) -> Finding:
    """Return a finding for an optional part. A missing part is no fault, a broken one is."""
    package, purpose = _EXTRAS[name]
    install = f"pip install '.[{name}]' in your clone of tsfusion"
    try:
        version = metadata.version(package)
    except metadata.PackageNotFoundError:
        return Finding(package, True, f"not installed; for {purpose}: {install}", optional=True)
    try:
        import_module(package.replace("-", "_"))
    except Exception as error:  # noqa: BLE001  as above
        return Finding(package, False, f"{version} does not import: {error}", f"again: {install}")
    return Finding(package, True, f"{version} ({purpose})")


def _kernels() -> Finding:
    """Compile (or load) and run a kernel, and compare its result with the right one."""
    import numpy as np

    from tsfusion.geometry.mesh import Mesh
    from tsfusion.kernels import ENGINE
    from tsfusion.kernels.base.quick_launch import QuickLaunch
    from tsfusion.kernels.base.runtime import kept_in, load_fast
    from tsfusion.pipelines.maps.mesh_preview import PreviewCamera, draw

    started = time.perf_counter()
    corners = np.array([(-9, -9, 2), (-9, 9, 2), (9, 9, 2)], np.float32)
    normals = np.tile(np.array((0, 0, -1), np.float32), (3, 1))
    depth = draw(Mesh(corners, np.array([(0, 1, 2)], np.int32), normals), PreviewCamera(np.eye(4)), 8, 8)[
        ..., 3
    ]
    seconds = time.perf_counter() - started
    if depth[6, 1] != 2:
        return Finding(
            "kernels", False, f"a kernel gave {depth[6, 1]} where 2 is right", "please report this"
        )
    folder, why = kept_in()
    found = f"{ENGINE} runs; first kernel after {seconds:.1f} s"
    if not (load_fast() and QuickLaunch.is_active):
        found += f"; this {ENGINE} loads and launches kernels slowly: tsfusion does not know its parts"
    note = f"; compiled ones are kept in {folder}, as {why}" if why else ""
    return Finding("kernels", True, found + note, "set XDG_CACHE_HOME to a folder of your own" if why else "")


def _port() -> Finding:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return Finding(
            "loopback", True, f"can listen on 127.0.0.1 (port {listener.getsockname()[1]} was free)"
        )


def _disk(path: Path) -> Finding:
    name = f"disk {path.absolute()}"
    try:
        with tempfile.TemporaryFile(dir=path):
            free = shutil.disk_usage(path).free
    except OSError as error:
        return Finding(name, False, f"cannot be written: {error.strerror}", "choose another folder")
    advice = "" if free >= DISK_BYTES else "free some space: journals grow by about 0.1–0.3 MB a keyframe"
    return Finding(name, not advice, f"{free / 1e9:.1f} GB free", advice)


def _guarded(check: Callable[[], Finding], name: str, advice: str) -> Finding:
    """Return the finding of a check, or its error as a finding."""
    try:
        return check()
    except Exception as error:  # noqa: BLE001  any error of a check is its finding
        return Finding(name, False, f"{type(error).__name__}: {error}", advice)
