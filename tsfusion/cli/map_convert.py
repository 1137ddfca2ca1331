# SPDX-License-Identifier: MIT
"""`tsfusion map convert`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
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
    typer.Option(help="As fused, or Euclidean distances."),
]
MaxDistance = Annotated[
    float | None,
    typer.Option(metavar="METRES", help="Of distances: 0.5, of a slice 2."),
]
Heights = Annotated[
    tuple[float, float] | None,
    typer.Option(metavar="LOW HIGH", help="A slice between two heights, metres."),
]
SliceBox = Annotated[
    tuple[float, float, float, float] | None,
    typer.Option("--box", metavar="U0 V0 U1 V1", help="Of a slice, metres; default: all."),
]
AboveFloor = Annotated[bool, typer.Option("--above-floor", help="Heights above the floor.")]
Resolution = Annotated[float | None, typer.Option(metavar="METRES", help="Cell of a slice; default a voxel.")]


def check(
    out: Path,
    *,
    dense: bool,
    field: str | None,
    max_distance: float | None,
    given: dict[str, Any],
    overwrite: bool,
) -> None:
    """Refuse what cannot be written, and flags without effect, before the map is read.

    Args:
        given: flags that are of a slice alone, `heights` among them.
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
    """Write a slice; returns the files."""
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
