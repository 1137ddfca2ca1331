# SPDX-License-Identifier: MIT
"""`tsfusion map`: describe, compare, merge, crop, convert and align saved maps; move live ones."""

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import forget, map_view, opened_maps, options, verbs
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.pipelines.maps.map_alignment import AlignedMap, Alignment
    from tsfusion.tsdf.volume import Volume

_STAYS = "give the state folder, whose journal can move what was corrected"
_TWICE = "a recording that was sent twice counts twice"

MapArgument = Annotated[
    Path, typer.Argument(metavar="MAP", help="A .tsf file, a state folder, or a map's folder in it.")
]
MapOutFlag = Annotated[Path, typer.Option("--out", metavar="FILE", help="The map to write (.tsf).")]
StateMapFlag = Annotated[
    str | None, typer.Option("--map", metavar="NAME", help="Map of the folder, if it has several.")
]

app = typer.Typer(
    cls=verbs.Group,
    help="Describe, align, merge, crop, convert maps; forget keyframes.\n\n"
    "A saved map is a file (.tsf), or that of a server: its state folder, or the folder of one map in it. "
    "All of this works while the server runs; only `forget` changes what it reads.",
)
MAP_HELP = "A map (.tsf), a state folder, one map's folder in it, or a journal."
forget.register(app)


@verbs.verb(
    app,
    "tsfusion map move yard --from tcp://one:5555 --to tcp://two:5555",
    "tsfusion map move default --from tcp://one:5555 --to tcp://two:5555 --json",
)
def move(
    name: Annotated[str, typer.Argument(metavar="NAME", help="Name of the map.")],
    *,
    source: Annotated[
        str, typer.Option("--from", metavar="ADDRESS", help="The server that has it: tcp://HOST:PORT.")
    ],
    to: Annotated[str, typer.Option("--to", metavar="ADDRESS", help="The new server: tcp://HOST:PORT.")],
    timeout: Annotated[float, typer.Option(metavar="SECONDS", help="Longest wait for the move.")] = 3600.0,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Move a live map from one server to another, while scanners send into it.

    The map is copied while it grows; then it stands still for a moment, and
    scanners go on at the other server, where every keyframe is once. What
    the first server had stays in its state folder, under moved/. Servers
    with keys must have the same pair; this key needs `tsfusion keys allow
    NAME --forget`. Without an answer in time the move goes on.
    """
    import msgspec

    from tsfusion.cli import output
    from tsfusion.wire.asking import queries
    from tsfusion.wire.sockets.curve import client_keys

    moved = queries.move_map(name, source, to, timeout=timeout, keys=client_keys(key, server_key))
    words = (
        f"map {name} is at {moved.address}: {moved.nbytes / 1e6:.1f} MB in {moved.seconds:.1f} s; it "
        f"took no keyframes for {moved.frozen_s:.2f} s of them"
    )
    output.result({"map": name, **msgspec.structs.asdict(moved)}, words, json=json)


@verbs.verb(app, "tsfusion map info out/latest/map.tsf", "tsfusion map info my-maps --map yard --json")
def info(path: MapArgument, map_: StateMapFlag = None, json: options.Json = False) -> None:
    """Describe a saved map: size, hash, extent, whose keyframes it holds, and its settings.

    Each byte of the file is checked. Of a state folder this is the last
    checkpoint; what the journal has beyond it is counted, and what damage in
    the journal has cost the map.
    """
    from tsfusion.cli import output, progress
    from tsfusion.pipelines.maps import saved_maps

    with progress.reading(opened_maps.JOURNAL, quiet=json) as watch:
        found = saved_maps.summarise(saved_maps.find(path, map_), watch)
    output.result(found, map_view.summary(found), json=json)
    opened_maps.note_lost(found.keyframes_lost or 0)


@verbs.verb(app, "tsfusion map hash out/latest/map.tsf", "tsfusion map hash my-maps --map yard", name="hash")
def hash_(path: MapArgument, map_: StateMapFlag = None, json: options.Json = False) -> None:
    """Print the hash of a map: equal for the same keyframes at the same poses.

    Neither their order nor how often the server was restarted changes it;
    colour is not part of it. Of a state folder it is the hash with all that
    the journal holds: what its checkpoint lacks is fused first.
    """
    from tsfusion.cli import output
    from tsfusion.pipelines.maps import saved_maps

    with opened_maps.opened(path, map_, quiet=json) as file:
        found = saved_maps.summarise(saved_maps.SavedMap(file))
    figures = {"path": str(path), "map_hash": found.map_hash, "keyframes": found.keyframes}
    output.result(figures, found.map_hash, json=json)


@verbs.verb(
    app, "tsfusion map merge hall.tsf kitchen.tsf --out ground-floor.tsf",
    "tsfusion map merge monday-maps tuesday.tsf --out both.tsf --same-frame",
)  # fmt: skip
def merge(
    maps: Annotated[
        list[Path], typer.Argument(metavar="MAP MAP…", help="Files (.tsf), state folders, maps' folders.")
    ],
    *,
    out: MapOutFlag,
    same_frame: Annotated[
        bool, typer.Option("--same-frame", help="The maps are in one frame; this is not checked.")
    ] = False,
    overwrite: options.OverwriteMap = False,
    json: options.Json = False,
) -> None:
    """Add maps of one coordinate frame: the map of all their keyframes, to the last bit.

    Voxel size and layers must be the same. Refused: maps that hold the same
    keyframes, as far as a server wrote down which, and, unless --same-frame,
    maps of scans that found their poses themselves, and maps of given poses
    that contradict each other or share too little to tell. A recording that
    was sent twice counts twice; equal poses are noted.

    What is lost: journals stay where they are. In the merged map keyframes
    can be neither corrected nor removed, and mesh --until and --only know
    nothing of them. It takes new ones: `tsfusion map resume`.
    """
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.journal.state_folder import check_no_map_of_a_server
    from tsfusion.pipelines.maps import map_alignment
    from tsfusion.tsdf.files import map_history
    from tsfusion.tsdf.sums import map_crop

    check_no_map_of_a_server(out)
    check_writable(out, (".tsf",), overwrite=overwrite)
    if len(maps) < 2:
        raise InvalidConfig(f"merging takes two maps or more, got {len(maps)}")
    merged = _load(maps[0], quiet=json)
    poses = map_history.poses(merged.meta)
    for path in maps[1:]:
        other = _load(path, quiet=json)
        theirs = map_history.poses(other.meta)
        is_part = map_crop.PART_OF in merged.meta and map_crop.PART_OF in other.meta
        if not (same_frame or is_part) and map_history.are_given(merged.meta, other.meta):
            map_alignment.check_one_frame(merged, other, (maps[0], path))
        merged.merge(other, same_frame=same_frame)
        if count := len(poses & theirs):
            have = count_of(count, "keyframe has", "keyframes have")
            typer.echo(f"note: {path}: {have} a pose of the other maps; {_TWICE}", err=True)
        poses |= theirs
        del other
    merged.save(out)
    map_view.tell_written([out], merged, json=json)


@verbs.verb(
    app, "tsfusion map crop out/latest/map.tsf --box -2 -2 -0.5 2 2 2.5 --out desk.tsf",
    "tsfusion map crop my-maps --map yard --box 0 0 -1 40 25 10 --out yard.tsf",
)  # fmt: skip
def crop(
    path: MapArgument,
    *,
    box: Annotated[
        tuple[float, float, float, float, float, float],
        typer.Option(metavar="X0 Y0 Z0 X1 Y1 Z1", help="Two corners, metres in the map's frame."),
    ],
    out: MapOutFlag,
    map_: StateMapFlag = None,
    overwrite: options.OverwriteMap = False,
    json: options.Json = False,
) -> None:
    """Write the part of a map that lies in a box, as a map.

    Kept are the voxels whose centres lie in the box; one on its upper side
    does not, so that boxes side by side share none. `tsfusion map info` has
    the box of a whole map. Keyframes that were cut can be neither corrected
    nor removed; new ones are taken, anywhere (`tsfusion map resume`).
    """
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.journal.state_folder import check_no_map_of_a_server

    check_no_map_of_a_server(out)
    check_writable(out, (".tsf",), overwrite=overwrite)
    cropped = _load(path, map_, quiet=json).crop(box)
    if not cropped.stats().blocks:
        raise InvalidConfig("nothing of the map lies in this box; `tsfusion map info` has the map's own")
    cropped.save(out)
    map_view.tell_written([out], cropped, json=json)


@verbs.verb(
    app, "tsfusion map diff monday.tsf tuesday.tsf",
    "tsfusion map diff monday.tsf tuesday.tsf --out changes.glb --tolerance 0.05",
)  # fmt: skip
def diff(
    earlier: Annotated[Path, typer.Argument(metavar="EARLIER", help="A map: file or state folder.")],
    later: Annotated[Path, typer.Argument(metavar="LATER", help="A later map of the same place and frame.")],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="FILE", help="A coloured mesh: .ply, .glb, .obj, or .png.")
    ] = None,
    tolerance: Annotated[
        float | None, typer.Option(metavar="METRES", help="Distance of equal surfaces; default 2 voxels.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Show what is different between two maps of one place.

    In square metres of surface, and in FILE by colour:
    unchanged       grey, in both
    appeared        green, where the earlier scan saw free space
    gone            red, where the later scan saw free space
    new             blue, where the earlier scan saw nothing
    not seen again  yellow, where the later scan saw nothing

    Maps made with --space-carving know all the free space that was seen,
    others that near surfaces alone. Equal maps: `tsfusion map hash`.
    """
    from tsfusion.cli import output
    from tsfusion.core.output_folder import check_writable
    from tsfusion.geometry.mesh import FORMATS
    from tsfusion.pipelines.maps import mesh_finishing

    if out is not None:
        check_writable(out, (*FORMATS, mesh_finishing.PICTURE))
    found = _load(earlier, quiet=json).diff(_load(later, quiet=json), tolerance=tolerance)
    if out is not None:
        mesh_finishing.write(found.mesh, [out], keep_islands=True)
    figures = {
        "same": found.is_same,
        "blocks": found.blocks,
        "voxels": found.voxels,
        "area_m2": found.area_m2,
    }
    figures["path"] = None if out is None else str(out)
    output.result(figures, map_view.difference(found), json=json)


@verbs.verb(app, *map_view.EXAMPLES)
def convert(
    path: MapArgument,
    out: map_view.OutFile,
    *,
    dense: map_view.Dense = False,
    field: map_view.FieldFlag = None,
    max_distance: map_view.MaxDistance = None,
    heights: map_view.Heights = None,
    above_floor: map_view.AboveFloor = False,
    box: map_view.SliceBox = None,
    up: options.UpDirection = None,
    resolution: map_view.Resolution = None,
    map_: StateMapFlag = None,
    overwrite: options.OverwriteMap = False,
    json: options.Json = False,
) -> None:
    """Write a map as voxels, as a slice, as a mesh, or as a file of its own.

    .npz and .zarr hold blocks of 8³ voxels, or with --dense one array around
    the map: docs/maps.md. .vdb is for OpenVDB. --heights: free, occupied or
    unseen cells as ROS's map_server reads them (.yaml and .pgm), or a picture
    (.png); with --field distance how far the next obstacle is. .tsf: of a
    state folder, with all that its journal holds. Meshes: `tsfusion mesh` has
    more choices.
    """
    from tsfusion.cli import progress
    from tsfusion.pipelines.maps import mesh_finishing

    suffix, files = out.suffix.lower(), [out]
    given = {"heights": heights, "above_floor": above_floor, "box": box, "up": up, "resolution": resolution}
    map_view.check(out, dense=dense, field=field, max_distance=max_distance, given=given, overwrite=overwrite)
    volume = _load(path, map_, quiet=json)
    if heights is not None:
        files = map_view.write_slice(volume, out, field, max_distance, given)
    elif suffix == ".tsf":
        volume.save(out)
    elif suffix in (".npz", ".zarr", ".vdb"):
        chosen = {} if max_distance is None else {"max_distance": max_distance}
        with progress.reading(f"writing {out}", quiet=json) as watch:
            volume.save_voxels(out, dense=dense, field=field or "tsdf", watch=watch, **chosen)
    else:
        mesh_finishing.write(volume.extract_mesh(), [out])
    map_view.tell_written(files, volume, json=json, path=out)


@verbs.verb(
    app, "tsfusion map resume out/latest/map.tsf --state my-maps",
    "tsfusion map resume house.tsf --state my-maps --map house",
)  # fmt: skip
def resume(
    path: MapArgument,
    *,
    state: Annotated[Path, typer.Option(metavar="DIR", help="Server's state folder; made if missing.")],
    map_: Annotated[
        str, typer.Option("--map", metavar="NAME", help="Name of the map in it; not yet in use.")
    ] = "default",
    json: options.Json = False,
) -> None:
    """Let a saved map take keyframes again: put it into a server's state folder.

    `tsfusion serve`, `scan` and `replay` go on with it with --state DIR and
    --map NAME; new scans that find their poses themselves need --same-frame.
    Its journal stays where it is: keyframes that are in the map already can
    be neither corrected nor removed. End a server that runs there first.
    """
    from tsfusion.cli import output
    from tsfusion.pipelines.maps import saved_maps

    with opened_maps.opened(path, quiet=json) as file:
        folder = saved_maps.resume(file, state, map_)
        found = saved_maps.summarise(saved_maps.SavedMap(file))
    flags = map_view.serve_flags(found.settings)
    command = " ".join(["tsfusion", "serve", "--state", shlex.quote(str(state)), *flags])
    figures = {"path": str(folder), "map_hash": found.map_hash, "keyframes": found.keyframes}
    words = f"{folder}: {count_of(found.keyframes, 'keyframe')}, hash {found.map_hash}"
    output.result({**figures, "command": command}, f"{words}\ngo on with: {command}", json=json)


def _load(path: Path, map_name: str | None = None, *, quiet: bool) -> "Volume":
    """Load a map with all that its journal holds beyond the checkpoint."""
    from tsfusion.tsdf.files import map_history
    from tsfusion.tsdf.volume import Volume

    with opened_maps.opened(path, map_name, quiet=quiet) as file:
        volume = Volume.load(file, memory_bytes=opened_maps.memory_for(file, maps=2))
    if waiting := sum(one.waiting for one in map_history.sessions(volume.meta)):
        stay = count_of(waiting, "keyframe stays", "keyframes stay")
        typer.echo(f"note: {path}: {stay} where fused, though corrected: {_STAYS}", err=True)
    return volume


@verbs.verb(
    app, "tsfusion map align my-maps robot2-maps --out both.tsf", "tsfusion map align a.tsf b.tsf --json"
)
def align(
    first: Annotated[Path, typer.Argument(metavar="A", help=MAP_HELP)],
    second: Annotated[Path, typer.Argument(metavar="B", help="Another map (B), in another frame.")],
    *,
    out: Annotated[
        Path | None, typer.Option(metavar="C.tsf", help="Write both as one map, in the frame of A.")
    ] = None,
    overwrite: options.OverwriteMap = False,
    json: options.Json = False,
) -> None:
    """Find where map B lies in map A, without a first guess, and merge both.

    Features of the two surfaces are matched (FPFH, RANSAC), then ICP. The
    answer counts only where enough of the surfaces lies on each other, no
    sensor looked through the surface that the other map has there, and no
    other answer is as good. Otherwise it is refused: one line, status 1.

    T_a_b takes points of B to A. With --out the keyframes of B are fused from
    its journal at their new poses, which is exact: the hash is that of all
    keyframes fused together. A map without a journal is resampled: only its
    surface is added.

    Needs scipy, the extra `align` of tsfusion.
    """
    from tsfusion.cli import output, progress
    from tsfusion.core.output_folder import check_writable
    from tsfusion.evaluation.surface_fit import check_installed
    from tsfusion.journal.state_folder import check_no_map_of_a_server
    from tsfusion.pipelines.maps import map_alignment

    if out is not None:
        check_no_map_of_a_server(out)
        check_writable(out, (".tsf",), overwrite=overwrite)
    check_installed()
    with progress.shown(quiet=json) as display:
        maps = []
        for source in (first, second):
            display.stage(f"opening {source}")
            maps.append(map_alignment.open_map(source, watch=display.show_fused))
        display.stage(f"aligning {second} with {first}")
        found = map_alignment.align(*maps)
        merged: dict[str, Any] | None = None
        if out is not None:
            display.stage(f"merging into {out}")
            merged = _merge(maps[0], maps[1], found, out, display)
    output.result({"alignment": found, "merged": merged}, "\n".join(_lines(found, merged)), json=json)
    opened_maps.note_lost(sum(one.lost for one in maps))


def _merge(a: "AlignedMap", b: "AlignedMap", found: "Alignment", out: Path, display: Any) -> dict[str, Any]:
    import numpy as np

    from tsfusion.pipelines.maps import map_alignment

    volume = a.volume
    assert volume is not None  # `open_map` sets it
    done = map_alignment.merge(volume, b, np.array(found.T_a_b), watch=display.show_fused)
    volume.save(out)
    return {
        "path": str(out),
        "exact": not done.not_exact,
        "not_exact": done.not_exact,
        "keyframes": volume.keyframes,
        "left_out": done.left_out,
        "blocks": volume.stats().blocks,
        "map_hash": volume.map_hash(),
    }


def _lines(found: "Alignment", merged: dict[str, Any] | None) -> list[str]:
    tilt = "" if found.tilt_deg is None else f"; their up directions differ by {found.tilt_deg:.1f}°"
    rows = [" ".join(f"{number:10.6f}" for number in row) for row in found.T_a_b]
    lines = [
        f"T_a_b      {rows[0]}",
        *(f"           {row}" for row in rows[1:]),
        f"error      up to {found.error_mm:.0f} mm: so far apart parts of the common surface want B",
        f"overlap    {found.overlap:.1%} of the smaller surface, {found.rmse_mm:.1f} mm apart (RMSE)",
        f"against it {found.contradicted:.1%} of {found.looks} looks went through the other's surface, and "
        f"{found.contradicted_alone:.1%} through its own{tilt}",
    ]
    if merged is not None:
        how = "exact" if merged["exact"] else merged["not_exact"]
        lines.append(
            f"{merged['path']}: {merged['keyframes']} keyframes, {merged['blocks']} blocks, "
            f"hash {merged['map_hash']} ({how})"
        )
        lines += [f"left out   {count} × {reason}" for reason, count in merged["left_out"].items()]
    return lines
