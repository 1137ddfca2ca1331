# SPDX-License-Identifier: MIT
"""Saved maps and their differences in words."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from tsfusion.cli import options
from tsfusion.core.readable_numbers import count_of

if TYPE_CHECKING:
    from tsfusion.pipelines.maps.saved_maps import MapSummary, SessionSummary
    from tsfusion.tsdf.sums.map_difference import MapDifference
    from tsfusion.tsdf.volume import Volume

_MOST_LINES = 20  # printed of one kind; --json has all


def figures(volume: "Volume") -> dict[str, Any]:
    """Figures of a map that was written, for a program."""
    stats = volume.stats()
    return {"map_hash": volume.map_hash(), "keyframes": stats.keyframes, "blocks": stats.blocks}


def line(out: Path, volume: "Volume") -> str:
    """A line on a map that was written, for a person."""
    from tsfusion.cli.output import size

    stats = volume.stats()
    nbytes = sum(one.stat().st_size for one in (out, *out.rglob("*")) if one.is_file())  # of a folder, too
    return (
        f"{out}: {count_of(stats.keyframes, 'keyframe')}, {count_of(stats.blocks, 'block')}, "
        f"{size(nbytes)}, hash {volume.map_hash()}"
    )


def serve_flags(settings: dict[str, Any]) -> list[str]:
    """Flags of `serve` for settings that are not the usual ones; those without a flag in a comment."""
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
    """Describe what is different between two maps."""
    from tsfusion.cli.output import grouped

    lines = [f"{kind.replace('_', ' '):<15} {area:9.3f} m²" for kind, area in found.area_m2.items()]
    for name, counts in (("voxels", found.voxels), ("blocks", found.blocks)):
        words = [f"{grouped(count)} {kind.replace('_', ' in the ')}" for kind, count in counts.items()]
        lines.append(f"{name:<15} {', '.join(words)}")
    return "\n".join([*lines, "the maps are the same"] if found.is_same else lines)


def summary(found: "MapSummary") -> str:
    """Describe a saved map."""
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
            + _poses(one.world)
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


def _poses(world: str) -> str:
    """Where a session's poses come from, by its world."""
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
    """Records of the journal that the map lacks, counted; empty = it has all."""
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
    cure = "only the state folder that it was saved in has what it takes to fuse them"
    if found.keyframes_after is not None:
        cure = "a server saves the map with all of it at its end, and the other verbs of `map` fuse it first"
    return f"this checkpoint is without {' and '.join(words)}; {cure}"
