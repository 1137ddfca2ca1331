# SPDX-License-Identifier: MIT
"""`tsfusion map align`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, verbs

if TYPE_CHECKING:
    from tsfusion.pipelines.maps.map_alignment import AlignedMap, Alignment

MAP_HELP = "A map (.tsf), a state folder, one map's folder in it, or a journal."
_EXAMPLES = (
    "tsfusion map align my-maps robot2-maps --out both.tsf",
    "tsfusion map align a.tsf b.tsf --json",
)


def register(app: typer.Typer) -> None:
    """Make `align` a verb of `tsfusion map`."""
    verbs.verb(app, *_EXAMPLES)(align)


def align(
    first: Annotated[Path, typer.Argument(metavar="A", help=MAP_HELP)],
    second: Annotated[Path, typer.Argument(metavar="B", help="The same, of another frame.")],
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

    Needs Open3D and scipy, the extra `align` of tsfusion.
    """
    from tsfusion.cli import output, progress
    from tsfusion.core.errors import IncompleteRun
    from tsfusion.core.output_folder import check_writable
    from tsfusion.evaluation.surface_fit import check_installed
    from tsfusion.journal.state_folder import check_no_map_of_a_server
    from tsfusion.pipelines.maps import map_alignment
    from tsfusion.pipelines.report import shortfall

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
    if json:
        output.as_json({"alignment": found, "merged": merged})
    else:
        typer.echo("\n".join(_lines(found, merged)))
    if missed := shortfall.of_damage(sum(one.lost for one in maps)):
        raise IncompleteRun(missed)


def _merge(a: "AlignedMap", b: "AlignedMap", found: "Alignment", out: Path, display: Any) -> dict[str, Any]:
    import numpy as np

    from tsfusion.pipelines.maps import map_alignment

    volume = a.volume
    assert volume is not None  # it was opened here
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
