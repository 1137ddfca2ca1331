# SPDX-License-Identifier: MIT
"""`tsfusion map`: saved maps, described and compared without a server."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tsfusion.cli import options, verbs
from tsfusion.core.counts import count_of

if TYPE_CHECKING:
    from tsfusion.pipelines.saved_maps import MapSummary, SessionSummary

_MOST_LINES = 20  # printed of one kind; --json has all

app = typer.Typer(
    cls=verbs.Group,
    help="Describe and compare saved maps.\n\n"
    "A saved map is a file (.tsf), or the last checkpoint of a server: its state folder, or the folder of "
    "one map in it. All of this works while the server runs, and changes nothing of what it reads.",
)

Where = Annotated[
    Path, typer.Argument(metavar="MAP", help="A .tsf file, a state folder, or a map's folder in it.")
]
Map = Annotated[
    str | None, typer.Option("--map", metavar="NAME", help="Which map of a state folder with several.")
]


@verbs.verb(app, "tsfusion map info out/latest/map.tsf", "tsfusion map info my-maps --map yard --json")
def info(path: Where, map_: Map = None, json: options.Json = False) -> None:
    """Describe a saved map: size, hash, extent, whose keyframes it holds, and its settings.

    Each byte of the file is checked. Of a state folder this is the last
    checkpoint; what the journal has beyond it is counted.
    """
    from tsfusion.cli import output
    from tsfusion.pipelines import saved_maps

    found = saved_maps.summarise(saved_maps.find(path, map_))
    if json:
        output.as_json(found)
    else:
        typer.echo(_describe(found))


@verbs.verb(app, "tsfusion map hash out/latest/map.tsf", "tsfusion map hash my-maps --map yard", name="hash")
def hash_(path: Where, map_: Map = None, json: options.Json = False) -> None:
    """Print the hash of a map: equal for the same keyframes at the same poses.

    Neither their order nor how often the server was restarted changes it;
    colour is not part of it. Of a state folder it is the hash with all that
    the journal holds: what its checkpoint lacks is fused first.
    """
    from tsfusion.cli import output
    from tsfusion.pipelines import saved_maps

    with _opened(path, map_, quiet=json) as file:
        found = saved_maps.summarise(saved_maps.SavedMap(file))
    if json:
        output.as_json({"path": str(path), "map_hash": found.map_hash, "keyframes": found.keyframes})
    else:
        typer.echo(found.map_hash)


@contextmanager
def _opened(path: Path, map_name: str | None = None, *, quiet: bool) -> Iterator[Path]:
    """The file of a map; one of a state folder is brought up to date in a copy, with progress on stderr."""
    from tsfusion.cli import progress
    from tsfusion.pipelines import saved_maps

    with progress.shown(quiet=quiet) as display:

        def watch(done: int, total: int) -> None:
            if done == 1:
                display.stage(f"fusing what the checkpoint of {path} lacks")
            display.update(done, done, total)

        with saved_maps.opened(saved_maps.find(path, map_name), watch) as (file, left_out):
            for reason, count in left_out.items():
                typer.echo(f"left out {count_of(count, 'keyframe')}: {reason}", err=True)
            yield file


def _describe(found: "MapSummary") -> str:
    from msgspec import to_builtins

    from tsfusion.cli.output import counted, grouped, size
    from tsfusion.core.config import VolumeConfig

    config = found.settings
    lines = [
        f"map        {found.path}, {size(found.nbytes)}",
        f"hash       {found.map_hash}",
        f"keyframes  {found.keyframes}",
        f"voxels     {grouped(found.voxels)} of {config['voxel_size']:g} m in {grouped(found.blocks)} blocks",
        f"memory     {size(found.voxel_bytes)} ({', '.join(found.layers)})",
        f"box        {_box(found.box)}",
        f"sessions   {len(found.sessions)}",
        *(
            f"  {one.session[:8]}  {one.client or 'no key':<12} up to number {one.last}, {_listed(one)}, "
            + (f"world {one.world[:8]}" if one.world else "poses given")
            for one in found.sessions[:_MOST_LINES]
        ),
    ]
    if len(found.sessions) > _MOST_LINES:
        lines.append(f"  … and {len(found.sessions) - _MOST_LINES} more: --json lists all")
    if found.rejected:
        lines.append(f"rejected   {counted(found.rejected)}")
    if note := _behind(found):
        lines.append(f"note       {note}")
    defaults = to_builtins(VolumeConfig())
    changed = [f"{name} {value}" for name, value in config.items() if value != defaults[name]]
    return "\n".join([*lines, f"settings   {', '.join(changed) or 'defaults'}"])


def _box(box: list[float] | None) -> str:
    if box is None:
        return "empty"
    return " ".join(f"{metres:g}" for metres in box) + " m (x0 y0 z0 x1 y1 z1)"


def _listed(one: "SessionSummary") -> str:
    count = count_of(one.listed, "keyframe")
    return f"{count} and those up to {one.unlisted_up_to}" if one.unlisted_up_to else count


def _behind(found: "MapSummary") -> str:
    """What the map does not have yet; empty = it has all."""
    words = [
        count_of(count, noun)
        for count, noun in (
            (found.keyframes_after, "keyframe of the journal"),
            (found.corrections_after, "correction of the journal"),
            (found.corrections_waiting, "corrected pose"),
        )
        if count
    ]
    if not words:
        return ""
    return (
        f"this checkpoint is without {' and '.join(words)}; a server saves the map with all of it when it is "
        "told to end, and the other verbs of `tsfusion map` fuse it first"
    )
