# SPDX-License-Identifier: MIT
"""`tsfusion fuse`: fuse journals and recordings with many processes, or a cluster."""

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, verbs
from tsfusion.core import process

if TYPE_CHECKING:
    from tsfusion.cluster.fusion import FusedRun
    from tsfusion.cluster.schedulers import Scheduler


@options.takes_map_settings
def fuse(
    sources: Annotated[
        list[str],
        typer.Argument(metavar="SOURCE…", help="Journals, state folders, datasets, URLs."),
    ],
    *,
    out: options.OutFlag = None,
    overwrite: options.Overwrite = False,
    workers: Annotated[
        int | None,
        options.option("--workers", "N", "Number of processes; default: all cores.", min=1),
    ] = None,
    ray: Annotated[str | None, options.option("--ray", "[ADDRESS]", "Use a Ray cluster (extra ray).")] = None,
    worker_memory: Annotated[
        str | None, options.option("--worker-memory", "BYTES", "Memory limit of each process, as 2GB.")
    ] = None,
    tile_size: Annotated[
        float | None, options.option("--tiles", "METRES", "Write 3D Tiles of this size, too.")
    ] = None,
    map_: options.Map = None,
    same_frame: Annotated[
        bool, options.option("--same-frame", None, "The sources' poses are in one frame.", rare=True)
    ] = False,
    origin: options.OriginFlag = None,
    option: options.DatasetOptions = None,
    up: options.UpDirection = None,
    keep_islands: options.KeepIslands = None,
    config: options.ConfigFile = None,
    json: options.RunJson = False,
    **settings: Any,
) -> None:
    """Fuse journals and recordings with many processes, or a cluster.

    One map: that of one machine, to the last bit. Keyframes count at their
    final poses. Started again, an interrupted run goes on where it was.
    """
    from tsfusion.cli import output, progress, runs
    from tsfusion.cluster import fusion, keyframe_sources
    from tsfusion.core.errors import IncompleteRun, InvalidConfig
    from tsfusion.pipelines.report import shortfall

    for source in sources:
        runs.refuse_live(source)
    memory = options.byte_count(worker_memory)
    if tile_size is not None and not 0 < tile_size < float("inf"):
        raise InvalidConfig(f"--tiles must be a number of metres above 0, got {tile_size:g}")
    wishes = fusion.Wishes(
        up=options.up_direction(up),
        keep_islands=keep_islands,
        worker_memory=memory,
        tile_size=tile_size,
        sensor=settings["sensor"],
    )
    with progress.shown(quiet=json) as display:
        found = keyframe_sources.listed(
            sources,
            map_name=map_,
            same_frame=same_frame,
            options=options.dataset_options(option, **({} if origin is None else {"origin": origin})),
            watch=partial(display.show_bytes, "reading the journal"),
        )
        result = fusion.fuse(
            found,
            options.configuration_for(
                found.sensor,
                config,
                usual=found.saved or found.usual,
                tell=True,
                preset={"threads": 1},  # a worker is a process on a core
                **settings,
            ).volume,
            out,
            partial(_scheduler, workers or len(process.cores()), ray),
            display,
            wishes=wishes,
            overwrite=overwrite,
        )
    if json:
        output.as_json(result)
    else:
        _print(result)
    missed = (
        shortfall.of_damage(result.keyframes_lost), shortfall.of_absence(found.absent),
        shortfall.of_poses(result.keyframes, found.left_out), shortfall.of_clock(found.left_out),
        shortfall.of_unreadable(result.keyframes, result.keyframes_rejected),
    )  # fmt: skip
    if text := shortfall.together(missed):
        raise IncompleteRun(text)


def _scheduler(workers: int, ray: str | None) -> "Scheduler":
    if ray is not None:
        from tsfusion.cluster.ray_scheduler import RayCluster

        return RayCluster(workers, None if ray == verbs.LOCAL else ray)
    from tsfusion.cluster.schedulers import LocalProcesses

    return LocalProcesses(workers)


def _print(result: "FusedRun") -> None:
    import msgspec

    from tsfusion.core.readable_numbers import count_of
    from tsfusion.geometry.mesh import summarise
    from tsfusion.geometry.up_direction import Up

    up = result.mesh.get("up")
    figures = {**result.mesh, "up": None if up is None else msgspec.convert(up, Up)}
    for reason, count in result.keyframes_rejected.items():
        typer.echo(f"left out {count_of(count, 'keyframe')}: {reason}", err=True)
    took = sum(result.seconds.values())
    tiles = f", {count_of(result.tiles, 'tile')}" if result.tiles else ""
    typer.echo(
        f"{result.folder}: {result.keyframes_fused} of {result.keyframes} keyframes, "
        f"{count_of(result.blocks, 'block')}, in {took:.1f} s by {count_of(result.workers, 'worker')}\n"
        f"hash {result.map_hash}\nmesh: {summarise(figures)}{tiles}"
    )
