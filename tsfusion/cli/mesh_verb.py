# SPDX-License-Identifier: MIT
"""`tsfusion mesh`: write the mesh of a saved map, a live server, or a journal."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tsfusion.cli import opened_maps, options

if TYPE_CHECKING:
    from tsfusion.core.config import VolumeConfig
    from tsfusion.geometry.mesh import Mesh
    from tsfusion.geometry.up_direction import Up
    from tsfusion.pipelines.maps.journal_fusion import JournalMap
    from tsfusion.tsdf.volume import Volume
    from tsfusion.wire.sockets.curve import ClientKeys


_OF_A_JOURNAL = ("until", "only", "color_by", "texture", "texture_size")
_OF_A_WHOLE_MESH = ("preview", "texture", "fill_holes", "mark_guesses", "simplify")


@options.takes_map_settings
def mesh(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SOURCE",
            help="Map, state folder, journal, or tcp://HOST:PORT.",
        ),
    ],
    out: Annotated[
        Path, typer.Argument(metavar="OUT", help=".ply, .glb, .obj, .stl; points: .pcd, .las, .laz.")
    ],
    *,
    up: options.UpDirection = None,
    keep_islands: options.KeepIslands = None,
    until: Annotated[
        str | None,
        typer.Option(metavar="TIME", help="Map as of then: ISO, or seconds before end."),
    ] = None,
    only: Annotated[
        list[str] | None,
        typer.Option(metavar="SESSION", help="Only surface that this client/session saw."),
    ] = None,
    color_by: Annotated[
        Literal["client", "session"] | None,
        options.option("--color-by", "WHAT", "One colour for each client, or each session.", rare=True),
    ] = None,
    crop: Annotated[
        tuple[float, float, float, float, float, float] | None,
        typer.Option(metavar="BOX", help="Cut to x0 y0 z0 x1 y1 z1, in metres."),
    ] = None,
    min_component: Annotated[
        float | None,
        options.option("--min-component", "METRES", "Leave out pieces smaller than this."),
    ] = None,
    fill_holes: Annotated[
        int | None,
        options.option("--fill-holes", "VOXELS", "Close holes up to this width, by a guess."),
    ] = None,
    mark_guesses: Annotated[
        bool, options.option("--mark-guesses", None, "Paint what --fill-holes guessed.", rare=True)
    ] = False,
    simplify: Annotated[
        str | None,
        options.option("--simplify", "TARGET", "25%, 50000 triangles, or 5mm of error."),
    ] = None,
    texture: Annotated[bool, typer.Option("--texture", help="Texture from the journal's images.")] = False,
    texture_size: Annotated[
        int | None,
        options.option("--texture-size", "TEXELS", "Largest side of a texture image (4096).", rare=True),
    ] = None,
    preview: Annotated[Path | None, typer.Option(metavar="PNG", help="Draw the mesh as a picture.")] = None,
    memory: Annotated[
        str | None,
        options.option("--memory", "BYTES", "Memory for the map, as 2GB; default: half of all.", rare=True),
    ] = None,
    control: options.Control = None,
    map_: options.Map = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    config: Annotated[
        Path | None, options.option("--config", "FILE", "Settings, as `tsfusion config dump`.", rare=True)
    ] = None,
    json: options.Json = False,
    **settings: Any,
) -> None:
    """Write the mesh of a saved map, of a live server, or of a journal.

    A journal is fused again, with the map flags below; --help-all has more.
    """
    from dataclasses import replace

    from tsfusion.core import process
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.pipelines.maps import mesh_finishing

    if texture and color_by is not None:
        raise InvalidConfig("--texture shows what the cameras saw, --color-by who saw it: give one of them")
    if texture_size is not None and not texture:
        raise InvalidConfig("--texture-size goes with --texture")
    if texture:
        from tsfusion.geometry import texture_charts

        texture_charts.check_installed()
    given_up = options.up_direction(up)
    check_writable(out, mesh_finishing.SURFACES)
    if preview is not None:
        check_writable(preview, (".png",))
    finishing = mesh_finishing.checked(
        crop=crop, min_component=min_component, fill_holes=fill_holes, simplify=simplify,
        mark_guesses=mark_guesses,
    )  # fmt: skip
    if min_component is not None and keep_islands is not None:
        raise InvalidConfig(
            "--min-component says which pieces go: leave out --keep-islands or --drop-islands"
        )
    legend: list[dict[str, Any]] = []
    lost, behind = 0, dict[str, int]()
    if "://" in source:
        from tsfusion.wire.sockets.curve import client_keys

        _refuse_for_server(context)
        keys = client_keys(key, server_key)
        made, behind = _of_server(source, map_, keys, control=control, min_weight=settings["min_weight"])
    else:
        _refuse_for_files(context, source)
        chosen = options.configuration_for(None, config, usual=_saved_settings(source, map_), **settings)
        given = config is not None or any(
            value is not None for name, value in settings.items() if name not in options.VIEW_OPTIONS
        )
        most = options.byte_count(memory)
        view = {"until": until, "only": only or (), "color_by": color_by}
        found = _map(Path(source), chosen.volume, most, name=map_, given=given, quiet=json, view=view)
        most = most or process.physical_memory_bytes() // 2
        if found.volume.stats().bytes > most and crop is not None:
            found.volume = mesh_finishing.part_around(found.volume, crop, most)
        if found.volume.stats().bytes > most:
            options.refuse(
                context,
                _OF_A_WHOLE_MESH,
                "needs all of the mesh, which is too large for memory: give a --crop",
            )
            if keep_islands is False:
                raise InvalidConfig("--drop-islands needs all of the mesh, which is too large for memory")
            _write_tiles(found, source, out, given_up, min_component=min_component, json=json)
            opened_maps.note_lost(found.lost)
            return
        found.volume = mesh_finishing.fitting(
            found.volume, crop, most, fill_holes=fill_holes is not None, simplify=simplify is not None,
            texture=texture,
        )  # fmt: skip
        made, legend, lost = _extracted(found.volume, source, fill_holes, json), found.legend, found.lost
    if given_up is not None:
        made = replace(made, known_up=given_up)
    with _stage(f"finishing the mesh of {source}", json or finishing.is_nothing):
        made, dropped = finishing.apply(made)
    if texture:  # with a live server, --texture was refused
        made = _textured(made, Path(source), map_, found, size=texture_size, view=view, quiet=json)
    files = [out] if preview is None else [out, preview]
    left_out = mesh_finishing.write(made, files, keep_islands=keep_islands if min_component is None else True)
    written = made.without_islands() if out.name in left_out["files"] else made
    left_out = (
        left_out
        if min_component is None
        else {**dropped, "min_extent_m": min_component, "files": [file.name for file in files]}
    )
    figures = {**written.figures, "left_out": left_out, **behind}
    _print_result(out, figures, [*legend, *finishing.legend(made)], json)
    opened_maps.note_lost(lost)


def _refuse_for_server(context: typer.Context) -> None:
    """Raise InvalidConfig for flags that have no effect on a live server's map."""
    options.refuse(context, _OF_A_JOURNAL, "needs a journal: give the state folder of the server")
    options.refuse(
        context, {*options.MAP_OPTIONS, "config", "memory"} - {"min_weight"},
        "has no effect on a live server's map: give it to `tsfusion serve`",
    )  # fmt: skip
    options.refuse(context, ("fill_holes",), "needs the map: give the state folder of the server")


def _refuse_for_files(context: typer.Context, source: str) -> None:
    """Raise InvalidConfig for flags that have no effect on files."""
    options.refuse(
        context, ("control", "key", "server_key"),
        f"has no effect on {source}: only a live server (tcp://…) has one",
    )  # fmt: skip
    if source.endswith(".tsf"):
        options.refuse(
            context, ("map_", *_OF_A_JOURNAL),
            "has no effect on a saved map: give the state folder or the journal that has its keyframes",
        )  # fmt: skip
        options.refuse(
            context, options.MAP_OPTIONS.keys() - options.VIEW_OPTIONS,
            "has no effect on a saved map: give the state folder or the journal to fuse it anew",
        )  # fmt: skip


def _saved_settings(source: str, map_: str | None) -> dict[str, Any]:
    """Return settings of the map that a server saved beside a journal. Flags and a file override them."""
    from tsfusion.cluster.keyframe_sources import saved_beside, settings_of

    is_journal = not source.endswith(".tsf") and Path(source).exists()
    return settings_of(saved_beside(Path(source), map_)) if is_journal else {}


def _of_server(
    address: str,
    map_name: str | None,
    keys: "ClientKeys | None",
    *,
    control: str | None,
    min_weight: float | None,
) -> "tuple[Mesh, dict[str, int]]":
    """Return the mesh of a live map, and how many keyframes and corrections waited at that time."""
    from dataclasses import replace

    from tsfusion.core.config import DEFAULT_MAP
    from tsfusion.core.readable_numbers import count_of
    from tsfusion.geometry.mesh_arrays import Provenance
    from tsfusion.wire.asking.queries import fetch_health, fetch_mesh

    name = map_name or DEFAULT_MAP
    there = fetch_health(address, control=control, keys=keys).maps.get(name)
    made = fetch_mesh(address, control=control, map_name=name, min_weight=min_weight, keys=keys)
    keyframes, corrections = (there.waiting, there.corrections_waiting) if there else (0, 0)
    behind = {"keyframes_waiting": keyframes, "corrections_waiting": corrections}
    if keyframes or corrections:
        waiting = f"{count_of(keyframes, 'keyframe')} and {count_of(corrections, 'corrected pose')}"
        typer.echo(f"note: {waiting} wait to be fused: not all of them are in this mesh", err=True)
    return replace(made, provenance=Provenance(source=f"live map {name}")), behind


def _extracted(volume: "Volume", source: str, fill_holes: int | None, json: bool) -> "Mesh":
    """Return the mesh of a map in memory, with its provenance."""
    from dataclasses import replace

    with _stage(f"closing holes of {source}", json or fill_holes is None):
        made = volume.extract_mesh(fill_holes=fill_holes)
    return replace(made, provenance=volume.provenance(source))


@contextmanager
def _stage(text: str, quiet: bool) -> Iterator[None]:
    from tsfusion.cli import progress

    with progress.shown(quiet=quiet) as display:
        display.stage(text)
        yield


def _textured(
    made: "Mesh",
    source: Path,
    name: str | None,
    found: "JournalMap",
    *,
    size: int | None,
    view: dict[str, Any],
    quiet: bool,
) -> "Mesh":
    from tsfusion.cli import progress
    from tsfusion.journal import state_folder
    from tsfusion.pipelines.maps import journal_fusion
    from tsfusion.tsdf.texture.texturing import TextureSettings

    settings = TextureSettings() if size is None else TextureSettings(size=size)
    place, chosen = state_folder.resolve_map(source, name), {key: view[key] for key in ("until", "only")}
    with progress.shown(quiet=quiet) as display:
        display.stage(f"texture of {source}")
        return journal_fusion.textured(
            made, place, found.volume.config.voxel_size, settings, **chosen,
            reading=partial(display.show_bytes, opened_maps.JOURNAL), watch=display.show_steps,
        )  # fmt: skip


def _write_tiles(
    found: "JournalMap", source: str, out: Path, up: "Up | None", *, min_component: float | None, json: bool
) -> None:
    """Write the mesh part by part, in bounded memory."""
    from tsfusion.cli import progress
    from tsfusion.geometry import mesh_parts

    mesh_parts.check(out)
    with progress.shown(quiet=json) as display:
        display.stage("meshing in tiles")
        parts = found.volume.mesh_parts(out.parent, up=up)
        parts.provenance = found.volume.provenance(source)
        if min_component is not None:
            display.stage("leaving out small pieces")
            parts = parts.without_islands(min_component)
        display.stage("writing")
        files = parts.save(out)
    names = [] if min_component is None else [file.name for file in files]
    figures = {
        **parts.figures,
        "left_out": {**parts.left_out, "files": names},
        "files": list(map(str, files)),
    }
    if min_component is not None:
        figures["left_out"]["min_extent_m"] = min_component
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
    """Return a saved map, or the map of a state folder or a journal. Print what it lacks on stderr."""
    from tsfusion.cli import progress
    from tsfusion.core.config import VIEW_SETTINGS
    from tsfusion.core.errors import DatasetError
    from tsfusion.core.readable_numbers import count_of
    from tsfusion.journal import state_folder
    from tsfusion.pipelines.maps import journal_fusion
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
            display.show_fused(read, fused, total)

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

    colors = [
        f"  {one['color']}  {one['name']}" + (f", {one['keyframes']} keyframes" if "keyframes" in one else "")
        for one in legend
    ]
    words = "\n".join((f"{out}: {summarise(figures)}", *run_summary.mesh_notes(figures), *colors))
    output.result({"path": str(out), **figures, **({"legend": legend} if legend else {})}, words, json=json)
