# SPDX-License-Identifier: MIT
"""Commands that start a fuser sooner than the server's own does: hundreds of tests start one each.

The server's own compiles kernels ahead, a few seconds of a core: those of keyframes before it is ready, the
others when it has nothing else to do. Tests of everything around the map need no kernel; others need few.
"""

import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from tsfusion.core.config import override

_PROGRAM = """
import sys
sys.path.insert(0, {folder!r})
import quick_fusers
quick_fusers.{before}()
from tsfusion.fuser.__main__ import main
sys.exit(main())
"""


def _command(before: str) -> tuple[str, ...]:
    return sys.executable, "-c", _PROGRAM.format(folder=str(Path(__file__).parent), before=before)


LAZY = _command("compile_no_more_than_keyframes_need")  # the real map; ready as late as the server's own
SUMS = _command("sum_up")  # a `SumMap`: for tests that need no surface, only which keyframes are in the map


def server_command(fuser: tuple[str, ...]) -> list[str]:
    """The command `tsfusion`, whose servers start their fusers so."""
    return [sys.executable, "-c", f"{chosen(fuser)}from tsfusion.__main__ import main\nmain()"]


def run_command(fuser: tuple[str, ...]) -> list[str]:
    """The command `tsfusion`, whose runs start a server with such fusers."""
    program = f"import quick_fusers\nquick_fusers.quicken_runs({fuser!r})\n"
    return [sys.executable, "-c", f"{program}from tsfusion.__main__ import main\nmain()"]


def quicken_runs(fuser: tuple[str, ...], put: Callable[[Any, str, Any], None] = setattr) -> None:
    """Have runs of this process start servers with such fusers, and draw little: most of a short run.

    Args:
        put: sets attributes of modules.
    """
    from tsfusion.pipelines.maps import mesh_preview
    from tsfusion.pipelines.report import latency_ledger
    from tsfusion.pipelines.runs import target_server

    whole = mesh_preview.picture

    def small(mesh: Any, camera: Any, width: int, height: int, **more: Any) -> Any:
        return whole(mesh, camera, width // 8, height // 8, **more)

    put(target_server, "subprocess", with_quick_servers(fuser))
    put(mesh_preview, "picture", small)
    put(latency_ledger, "plot", lambda _, path: path.touch())


def with_quick_servers(fuser: tuple[str, ...]) -> SimpleNamespace:
    """As much of `subprocess` as a run uses to start its server."""

    def start(command: list[str], **more: Any) -> "subprocess.Popen[str]":
        assert command[1:4] == ["-m", "tsfusion", "serve"], command
        return subprocess.Popen([*server_command(fuser), *command[3:]], **more)

    names = {name: getattr(subprocess, name) for name in ("PIPE", "TimeoutExpired")}
    return SimpleNamespace(Popen=start, **names)


def compile_no_more_than_keyframes_need() -> None:
    """Have maps of this process compile only the kernels of depth images ahead, the others at their launch.

    Not those too: a question how far the map is would wait for them, on a loaded machine too long.
    """
    from tsfusion.tsdf import volume
    from tsfusion.tsdf.integration.ray_buffers import keyframes_of_every_kind

    def warm_up(made: volume.Volume) -> Iterator[None]:
        throwaway = volume.Volume(override(made.config, max_blocks=1 << 14, max_blocks_per_keyframe=1 << 14))
        depth = keyframes_of_every_kind(made.model, made.config.voxel_size)[0]
        throwaway.integrate(depth)
        throwaway.retract(depth)
        yield

    volume.Volume.warming_up = warm_up  # type: ignore[method-assign]


def sum_up() -> None:
    """Have this process's fuser add up digests of keyframes."""
    import sum_map

    sum_map.take_the_place_of_volume()


def chosen(command: tuple[str, ...] | None) -> str:
    """Code by which a server process starts its fusers so; None = by its own command."""
    if command is None:
        return ""
    return f"from tsfusion.gateway.ports import fuser_process\nfuser_process.COMMAND = {command!r}\n"
