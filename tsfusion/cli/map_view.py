# SPDX-License-Identifier: MIT
"""Describe saved maps and their differences in words, and write files for `tsfusion map convert`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tsfusion.cli import options
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.pipelines.maps.saved_maps import MapSummary, SessionSummary
    from tsfusion.tsdf.sums.map_difference import MapDifference
    from tsfusion.tsdf.volume import Volume

EXAMPLES = (
    "tsfusion map convert out/latest/map.tsf field.vdb --field distance",
    "tsfusion map convert my-maps yard.yaml --heights 0.1 1.8 --above-floor",
)
_FORMATS = ".npz .zarr .vdb .tsf .ply .glb .obj .stl; slice: .yaml .pgm .png .npz"
OutFile = Annotated[
    Path,
    typer.Argument(metavar="OUT", help=_FORMATS),
]
Dense = Annotated[bool, typer.Option("--dense", help="One array, not blocks (.npz, .zarr).")]
FieldFlag = Annotated[
    Literal["tsdf", "distance"] | None,
    typer.Option(help="TSDF, or Euclidean distance, metres."),
]
MaxDistance = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Largest distance: 0.5; of a slice 2."),
]
Heights = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LOW HIGH", help="A slice between two heights, metres."),
]
SliceBox = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option("--box", metavar="U0 V0 U1 V1", help="Corners of the slice; default: all."),
]
AboveFloor = Annotated[bool, typer.Option("--above-floor", help="Heights count from the floor.")]
Resolution = Annotated[float | None, typer.Option(metavar="METRES", help="Cell size of a slice; else voxel.")]


def tell_written(files: list[Path], volume: "Volume", *, json: bool, path: Path | None = None) -> None:
    """Print the figures of a map that was written to files. `path`: the one that the user named."""
    from tsfusion.cli import output

    stats, map_hash = volume.stats(), volume.map_hash()
    listed = {} if path is None else {"files": [str(file) for file in files]}
    figures = {"map_hash": map_hash, "keyframes": stats.keyframes, "blocks": stats.blocks}
    what = f"{count_of(stats.keyframes, 'keyframe')}, {count_of(stats.blocks, 'block')}"
    lines = [f"{file}: {what}, {output.size(_size_of(file))}, hash {map_hash}" for file in files]
    output.result({"path": str(path or files[0]), **listed, **figures}, "\n".join(lines), json=json)


def _size_of(file: Path) -> int:
    return sum(one.stat().st_size for one in (file, *file.rglob("*")) if one.is_file())  # .zarr is a folder


def serve_flags(settings: dict[str, Any]) -> list[str]:
    """Return flags of `serve` for unusual settings. Settings without a flag are in a comment at the end."""
    from msgspec import to_builtins

    from tsfusion.core.config import LIMIT_SETTINGS, RUN_SETTINGS, VIEW_SETTINGS, VolumeConfig

    usual = to_builtins(VolumeConfig())
    changed = {
        name: value
        for name, value in settings.items()
        if value != usual[name] and name not in (*RUN_SETTINGS, *LIMIT_SETTINGS, *VIEW_SETTINGS)
    }
    flags = []
    for name in [name for name in changed if name in options.MAP_OPTIONS]:
        flag, value = "--" + name.replace("_", "-"), changed.pop(name)
        flags += [flag] if value is True else [flag, f"{value}"]
    if changed:
        rest = ", ".join(f"{name} = {value}" for name, value in changed.items())
        flags.append(f"--config FILE  # with {rest}")
    return flags


def difference(found: "MapDifference") -> str:
    """Return in words the difference between two maps."""
    from tsfusion.cli.output import grouped

    lines = [f"{kind.replace('_', ' '):<15} {area:9.3f} m²" for kind, area in found.area_m2.items()]
    for name, counts in (("voxels", found.voxels), ("blocks", found.blocks)):
        words = [f"{grouped(count)} {kind.replace('_', ' in the ')}" for kind, count in counts.items()]
        lines.append(f"{name:<15} {', '.join(words)}")
    return "\n".join([*lines, "the maps are the same"] if found.is_same else lines)


def summary(found: "MapSummary") -> str:
    """Return a description of a saved map."""
    from msgspec import to_builtins

    from tsfusion.cli.output import counted, first_of, grouped, size
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
        *first_of([
            f"  {one.session[:8]}  {one.client or 'no key':<12} up to number {one.last}, {_listed(one)}, "
            + _poses(one.world)
            for one in found.sessions
        ]),
    ]  # fmt: skip
    if found.rejected:
        lines.append(f"rejected   {counted(found.rejected)}")
    if note := _behind(found):
        lines.append(f"note       {note}")
    defaults = to_builtins(VolumeConfig())
    changed = [f"{name} {value}" for name, value in config.items() if value != defaults[name]]
    return "\n".join([*lines, f"settings   {', '.join(changed) or 'defaults'}"])


def _poses(world: str) -> str:
    """Return in words where a session's poses come from, by its world."""
    from tsfusion.geometry.origin import Origin

    if origin := Origin.of_world(world):
        return f"poses given, from the origin {origin}"
    return f"world {world[:8]}" if world else "poses given"


def _box(box: list[float] | None) -> str:
    if box is None:
        return "empty"
    return " ".join(f"{metres:g}" for metres in box) + " m (x0 y0 z0 x1 y1 z1)"


def _listed(one: "SessionSummary") -> str:
    if not one.unlisted_up_to:
        return count_of(one.listed, "keyframe")
    return f"those up to {one.unlisted_up_to} not listed" + (f", {one.listed} more" if one.listed else "")


def _behind(found: "MapSummary") -> str:
    """Return in words how many records of the journal the map lacks; empty if it has all."""
    words = [
        count_of(count, noun) + where
        for count, noun, where in (
            (found.keyframes_after, "keyframe", " of the journal"),
            (found.corrections_after, "correction", " of the journal"),
            (found.corrections_waiting, "corrected pose", ""),
        )
        if count
    ]
    if not words:
        return ""
    cure = "only the state folder that it was saved in has what it takes to fuse them"
    if found.keyframes_after is not None:
        cure = "a server saves the map with all of it at its end, and the other verbs of `map` fuse it first"
    return f"this checkpoint is without {' and '.join(words)}; {cure}"


def check(
    out: Path,
    *,
    dense: bool,
    field: str | None,
    max_distance: float | None,
    given: dict[str, Any],
    overwrite: bool,
) -> None:
    """Refuse files that cannot be written and flags without effect, before the map is read.

    Args:
        given: flags that only concern a slice, `heights` included.
    """
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.geometry.map_grids import SLICE_FORMATS
    from tsfusion.geometry.mesh import FORMATS
    from tsfusion.journal.state_folder import check_no_map_of_a_server
    from tsfusion.tsdf.files.voxel_arrays import FORMATS as VOXELS

    suffix, is_slice = out.suffix.lower(), given["heights"] is not None
    if not (suffix == ".zarr" and any((out / one).exists() for one in ("zarr.json", ".zgroup"))):  # replaced
        check_no_map_of_a_server(out)
        endings = SLICE_FORMATS if is_slice else (*VOXELS, ".tsf", *FORMATS)
        check_writable(out, endings, overwrite=overwrite)
    if dense and (is_slice or suffix not in (".npz", ".zarr")):
        raise InvalidConfig(
            f"--dense has no effect on {out}: only a .npz or .zarr file has arrays of the map"
        )
    if field is not None and not is_slice and suffix not in VOXELS:
        raise InvalidConfig(f"--field has no effect on {out}: only {', '.join(VOXELS)} files have a field")
    if field == "distance" and suffix in (".yaml", ".pgm"):
        raise InvalidConfig(f"{out} would be a map of what is occupied: write distances to .png or .npz")
    if max_distance is not None and field != "distance":
        raise InvalidConfig("--max-distance goes with --field distance")
    for name, value in given.items():
        if value not in (None, False) and not is_slice:
            flag = name.replace("_", "-")
            raise InvalidConfig(f"--{flag} goes with --heights LOW HIGH: it is of a slice")


def write_slice(
    volume: "Volume", out: Path, field: str | None, max_distance: float | None, given: dict[str, Any]
) -> list[Path]:
    """Write a slice. Return the files."""
    from tsfusion.core.errors import OutputError

    how = {name: given[name] for name in ("box", "resolution", "above_floor")}
    how["up"] = options.up_direction(given["up"])
    if field == "distance" and max_distance is not None:
        how["max_distance"] = max_distance
    found = volume.current_slice(*given["heights"], **how)
    floor = found.grid.floor
    low, high = (one - (floor or 0.0) for one in found.extent)
    bottom, top = given["heights"]
    if bottom >= high or top <= low:
        where = "its origin" if floor is None else "its floor"
        raise OutputError(
            f"nothing of the map lies between {bottom:g} and {top:g} m above {where}; it lies between "
            f"{low:.2f} and {high:.2f} m: give other --heights"
        )
    where = "the map's origin" if floor is None else f"the floor, {found.grid.floor_in_words}"
    notes = [f"heights count from {where}; the map lies between {low:.2f} and {high:.2f} m"]
    if field != "distance" and not volume.knows_free_space:
        notes.append(
            "no keyframe of the map looks through a whole block: it knows free space near surfaces alone"
        )
    for note in notes:
        typer.echo(f"note: {note}", err=True)
    return (found.distances() if field == "distance" else found.occupancy()).save(out)
