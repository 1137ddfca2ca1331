# SPDX-License-Identifier: MIT
"""`tsfusion mesh`."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.core.config import VolumeConfig
    from tsfusion.geometry.up_direction import Up
    from tsfusion.pipelines.journal_fusion import JournalMap

ColorBy = Literal["client", "session"]

_OF_A_JOURNAL = ("until", "only", "color_by")


@options.takes_map_settings
def mesh(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="A map (.tsf), a state folder, a journal (folder or .mcap), or tcp://HOST:PORT.",
        ),
    ],
    out: Annotated[Path, typer.Argument(metavar="OUT", help="A .ply, .glb or .obj file.")],
    *,
    up: options.UpDirection = None,
    keep_islands: options.KeepIslands = None,
    until: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="As it was at TIME: ISO, or seconds from the end."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="SESSION", help="As this session or client saw it (repeatable)."),
    ] = None,
    color_by: Annotated[
        ColorBy | None, typer.Option(metavar="WHAT", help="client or session: a colour for each.")
    ] = None,
    preview: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw a picture, too.")] = None,
    memory: Annotated[
        str | None,
        options.option("--memory", "BYTES", "Of the map, as 2GB; else half of the machine's.", rare=True),
    ] = None,
    control: options.Control = None,
    map_: options.Map = None,
    key: options.Key = None,
    server_key: options.ServerKey = None,
    config: options.ConfigFile = None,
    json: options.Json = False,
    **settings: Any,
) -> None:
    """Write the mesh of a saved map, of a live server, or of a journal.

    A journal is fused again, with the map flags given here. With --until, --only
    or --color-by it is fused again as its map was, with corrected poses.

    A mesh larger than memory is made in tiles: one .ply, or a .glb each.
    """
    from dataclasses import replace

    from tsfusion.core import process
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.geometry.mesh import FORMATS
    from tsfusion.pipelines import mesh_files

    given_up = options.up_direction(up)
    legend: list[dict[str, Any]] = []
    check_writable(out, FORMATS)
    if preview is not None:
        check_writable(preview, (".png",))
    if "://" in source:
        options.refuse(
            context, _OF_A_JOURNAL, "needs a journal: give the state folder of the server",
        )  # fmt: skip
        options.refuse(
            context, {*options.MAP_OPTIONS, "config", "memory"} - {"min_weight"},
            "has no effect on a live server's map: give it to `tsfusion serve`",
        )  # fmt: skip
        from tsfusion.core.config import DEFAULT_MAP
        from tsfusion.wire.curve import client_keys
        from tsfusion.wire.queries import fetch_mesh

        made = fetch_mesh(
            source, control=control, map_name=map_ or DEFAULT_MAP, min_weight=settings["min_weight"],
            keys=client_keys(key, server_key),
        )  # fmt: skip
    else:
        options.refuse(
            context, ("control", "key", "server_key"),
            f"has no effect on {source}: only a live server (tcp://…) has one",
        )  # fmt: skip
        if source.endswith(".tsf"):
            options.refuse(
                context, _OF_A_JOURNAL,
                "has no effect on a saved map: give the state folder or the journal that has its keyframes",
            )  # fmt: skip
            options.refuse(
                context, options.MAP_OPTIONS.keys() - options.VIEW_OPTIONS,
                "has no effect on a saved map: give the state folder or the journal to fuse it anew",
            )  # fmt: skip
        chosen = options.configuration(config, **settings)
        given = config is not None or any(
            value is not None for name, value in settings.items() if name not in options.VIEW_OPTIONS
        )
        most = options.byte_count(memory)
        view = {"until": until, "only": only or (), "color_by": color_by}
        found = _map(Path(source), chosen.volume, most, name=map_, given=given, quiet=json, view=view)
        if found.volume.stats().bytes > (most or process.physical_memory_bytes() // 2):
            options.refuse(context, ("preview",), "needs all of the mesh, which is too large for memory")
            if keep_islands is False:
                raise InvalidConfig("--drop-islands needs all of the mesh, which is too large for memory")
            _write_tiles(found, out, given_up, json)
            return
        made, legend = found.volume.extract_mesh(), found.legend
    if given_up is not None:
        made = replace(made, known_up=given_up)
    files = [out] if preview is None else [out, preview]
    left_out = mesh_files.write(made, files, keep_islands=keep_islands)
    written = made.without_islands() if out.name in left_out["files"] else made
    _print_result(out, {**written.figures, "left_out": left_out}, legend, json)


def _write_tiles(found: "JournalMap", out: Path, up: "Up | None", json: bool) -> None:
    """Write the mesh in bounded memory."""
    from tsfusion.cli import progress
    from tsfusion.geometry import mesh_parts

    mesh_parts.check(out)
    with progress.shown(quiet=json) as display:
        display.stage("meshing in tiles")
        parts = found.volume.mesh_parts(out.parent, up=up)
        files = parts.save(out)
    figures = {**parts.figures, "left_out": {"islands": 0, "triangles": 0, "files": []}}
    figures["files"] = list(map(str, files))
    _print_result(files[0] if len(files) == 1 else out, figures, found.legend, json)


def _map(
    source: Path,
    config: "VolumeConfig",
    memory_bytes: int | None,
    *,
    name: str | None,
    given: bool,
    quiet: bool,
    view: dict[str, Any],
) -> "JournalMap":
    """The saved map where it is complete; otherwise a new map of every keyframe of the journal."""
    from tsfusion.cli import opened_maps, progress
    from tsfusion.core.config import VIEW_SETTINGS
    from tsfusion.core.counts import count_of
    from tsfusion.core.errors import DatasetError
    from tsfusion.journal import state_folder
    from tsfusion.pipelines import journal_fusion
    from tsfusion.tsdf.volume import Volume

    if not source.exists():
        raise DatasetError(f"{source} does not exist; expected a map (.tsf), a state folder or a journal")
    if source.suffix == ".tsf":
        changed = {name: getattr(config, name) for name in VIEW_SETTINGS}
        memory = opened_maps.memory_for(source, memory_bytes)
        loaded = Volume.load(source, config.threads, memory_bytes=memory, **changed)
        return journal_fusion.JournalMap(loaded, {})
    source = state_folder.resolve_map(source, name)
    with progress.shown(quiet=quiet) as display:

        def watch(read: int, fused: int, total: int) -> None:
            if read == 1:
                display.stage(f"fusing {source}")
            display.update(read, fused, total)

        def memory_for(saved: Path | None) -> int | None:
            return memory_bytes if saved is None else opened_maps.memory_for(saved, memory_bytes)

        found = journal_fusion.map_of(
            source,
            config,
            given=given,
            memory_for=memory_for,
            reading=partial(display.show_bytes, opened_maps.JOURNAL),
            watch=watch,
            **view,
        )
    for reason, count in found.left_out.items():
        typer.echo(f"left out {count_of(count, 'keyframe')}: {reason}", err=True)
    if found.missing:
        have = count_of(found.missing, "keyframe", "keyframes")
        typer.echo(f"warning: the journal lacks {have} of the saved map: not in this mesh", err=True)
    return found


def _print_result(out: Path, figures: dict[str, Any], legend: list[dict[str, Any]], json: bool) -> None:
    from tsfusion.cli import output, run_summary
    from tsfusion.geometry.mesh import summarise

    if json:
        output.as_json({"path": str(out), **figures, **({"legend": legend} if legend else {})})
    else:
        colors = [f"  {one['color']}  {one['name']}, {one['keyframes']} keyframes" for one in legend]
        typer.echo("\n".join((f"{out}: {summarise(figures)}", *run_summary.mesh_notes(figures), *colors)))
