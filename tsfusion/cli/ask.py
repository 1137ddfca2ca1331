# SPDX-License-Identifier: MIT
"""`tsfusion ask`: ask a map for distances, a view or a slice."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from tsfusion.cli import options, verbs

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from tsfusion.geometry.map_answers import Samples
    from tsfusion.wire.asking.map_client import Answered

SurfaceName = Literal["raw", "normal", "field"]

Point = tuple[float, float, float]
PoseFlag = tuple[float, float, float, float, float, float, float]


def ask(
    context: typer.Context,
    where: Annotated[
        str, typer.Argument(metavar="WHERE", help="A .tsf file, a state folder, or tcp://HOST:PORT.")
    ],
    out: Annotated[Path | None, typer.Argument(metavar="[OUT]", help="File to write the answer to.")] = None,
    *,
    at: Annotated[
        Point | None, typer.Option(metavar="X Y Z", help="Distance from this point to the surface.")
    ] = None,
    points: Annotated[
        str | None, typer.Option(metavar="FILE", help="Points in a .csv, .npy or .ply; - = stdin.")
    ] = None,
    view: Annotated[
        PoseFlag | None,
        typer.Option(metavar="X…QW", help="View of a camera at X Y Z QX QY QZ QW."),
    ] = None,
    slice_: Annotated[
        tuple[float, float] | None,
        typer.Option("--slice", metavar="LOW HIGH", help="Obstacles between two heights, metres."),
    ] = None,
    distances: Annotated[
        bool, typer.Option("--distances", help="With --slice: distances to obstacles, too.")
    ] = False,
    unseen_is_free: Annotated[
        bool,
        options.option("--unseen-is-free", None, "Unseen space is free; default: distance 0.", rare=True),
    ] = False,
    box: Annotated[
        tuple[float, float, float, float] | None,
        typer.Option(metavar="U V U V", help="Corners of the slice; default: whole map."),
    ] = None,
    resolution: Annotated[
        float | None, typer.Option(metavar="METRES", help="Cell size of the slice; default: a voxel.")
    ] = None,
    above_floor: Annotated[
        bool, typer.Option("--above-floor", help="Heights count from the floor (saved maps).")
    ] = False,
    up: Annotated[
        str | None, typer.Option(metavar="AXIS", help="Which way is up: z, -y, … or X,Y,Z.")
    ] = None,
    size: Annotated[str, options.option("--size", "WxH", "Pixels of the view.", rare=True)] = "640x480",
    intrinsics: Annotated[
        str | None,
        options.option("--intrinsics", "FX,FY,CX,CY", "Camera of the view, in pixels.", rare=True),
    ] = None,
    surface: Annotated[
        SurfaceName,
        options.option("--surface", "MODE", "raw: as fused; normal, field: smoothed, slower.", rare=True),
    ] = "raw",
    min_weight: Annotated[
        float | None,
        options.option("--min-weight", "COUNT", "Full-confidence samples that a voxel needs.", rare=True),
    ] = None,
    timeout: Annotated[float, typer.Option(metavar="SECONDS", help="Longest wait for a live answer.")] = 5.0,
    map_: options.Map = None,
    control: options.Control = None,
    key: options.KeyFlag = None,
    server_key: options.ServerKey = None,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Ask a map how far its surface is, or what a camera sees of it.

    A live server answers between two keyframes, or status is 1 after --timeout.
    Metres of the map; a distance is positive before a surface. nan = unseen, or
    farther than these distances reach: nobody knows whether that is free.

    Points: a table on stdout, or OUT (.csv, .npz; .npy: distances alone).
    A view: OUT .png, or .npz with its depth. A slice: .pgm and .yaml for ROS's
    map_server, .png, .npz; a live one needs --up.
    """
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.geometry.map_grids import SLICE_FORMATS
    from tsfusion.pipelines.maps.answer_files import VIEWS

    if sum(one is not None for one in (at, points, view, slice_)) != 1:
        raise InvalidConfig(
            "ask one thing: --at X Y Z, --points FILE, --view X Y Z QX QY QZ QW or --slice LOW HIGH"
        )
    if "://" not in where:
        options.refuse(
            context, ("control", "key", "server_key", "timeout"),
            f"has no effect on {where}: only a live server (tcp://…) has one",
        )  # fmt: skip
    link = {"control": control, "key": key, "server_key": server_key, "timeout": timeout}
    if view is None:
        options.refuse(context, ("size", "intrinsics"), "has no effect without --view")
    if slice_ is None:
        options.refuse(
            context, ("distances", "box", "resolution", "above_floor", "up"), "has no effect without --slice"
        )
    else:
        options.refuse(context, ("surface",), "has no effect on a slice: it is of the map as it was fused")
    if not distances:
        options.refuse(context, ("unseen_is_free",), "has no effect without --slice and --distances")
    how: dict[str, Any] = {"min_weight": min_weight}
    if slice_ is not None:
        file = _checked(out, "a slice", (".png", ".npz") if distances else SLICE_FORMATS)
        if up is None and "://" in where:
            raise InvalidConfig("say which way is up in a live map, such as --up z or --up -y")
        how |= {"box": box, "resolution": resolution, "up": options.up_direction(up)}
        if above_floor and "://" in where:
            raise InvalidConfig(
                "--above-floor needs a saved map, as the floor is looked for in all of it: ask the server's "
                "state folder, which says where the floor is; add that height to LOW and HIGH here"
            )
        how |= {"above_floor": True} if above_floor else {}
        how |= {"unseen_is_free": True} if unseen_is_free else {}
        with _map(where, map_, link, quiet=json) as asked:
            question = asked.distance_slice if distances else asked.occupancy_slice
            _write_slice(question(*slice_, **how), file, json=json)
        return
    how["surface"] = surface
    if view is not None:
        file, camera = _checked(out, "a view", VIEWS), _camera(view, size, intrinsics)
        with _map(where, map_, link, quiet=json) as asked:
            _write_view(asked.raycast(*camera, **how), file, json=json)
        return
    _ask_points(where, map_, link, how, at=at, points=points, out=out, json=json)


def _ask_points(
    where: str,
    map_: str | None,
    link: dict[str, Any],
    how: dict[str, Any],
    *,
    at: Point | None,
    points: str | None,
    out: Path | None,
    json: bool,
) -> None:
    """Sample the map at points, and write or print the result."""
    import numpy as np

    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.pipelines.maps import answer_files

    if out is not None:
        check_writable(out, answer_files.SAMPLES)
    chosen = np.array([at], np.float64) if points is None else answer_files.read(points)
    if not np.isfinite(chosen).all():
        raise InvalidConfig("--at must be three finite numbers")
    with _map(where, map_, link, quiet=json) as asked:
        answers = _in_parts(asked, chosen, how)
    found = _joined(answers)
    if out is not None:
        answer_files.write_samples(out, chosen, found)
    if json:
        _print_json(answers, chosen, found, out)
    elif out is not None:
        typer.echo(f"{out}: {_counts(found)}; {_state(answers)}")
    elif points is not None:
        typer.echo(answer_files.csv_text(chosen, found), nl=False)
        typer.echo(f"{_counts(found)}; {_state(answers)}", err=True)
    else:
        kind = f"distances as fused, {_reach(found)}"
        typer.echo("\n".join([*_sentences(chosen, found), f"{kind}; {_state(answers)}"]))


def _in_parts(asked: Any, chosen: "NDArray[np.float64]", how: dict[str, Any]) -> "list[Answered[Samples]]":
    """Sample the points in questions of at most `MOST_POINTS` each, and return all answers."""
    from tsfusion.geometry.map_questions import MOST_POINTS

    return [asked.sample(chosen[i : i + MOST_POINTS], **how) for i in range(0, len(chosen), MOST_POINTS)]


def _joined(answers: "list[Answered[Samples]]") -> "Samples":
    import numpy as np

    from tsfusion.geometry.map_answers import Samples

    names = ("distance", "weight", "gradient")
    parts = {name: np.concatenate([getattr(one.result, name) for one in answers]) for name in names}
    return Samples(**parts, reach=answers[-1].result.reach)


@contextmanager
def _map(where: str, map_: str | None, link: dict[str, Any], *, quiet: bool) -> Iterator[Any]:
    """Open a live or a saved map. Both have the same methods for questions."""
    if "://" in where:
        from tsfusion.core.config import DEFAULT_MAP
        from tsfusion.wire.asking.map_client import MapClient
        from tsfusion.wire.sockets.curve import client_keys

        keys = client_keys(link["key"], link["server_key"])
        with MapClient(
            where, map_ or DEFAULT_MAP, control=link["control"], timeout=link["timeout"], keys=keys
        ) as client:
            yield client
        return
    from tsfusion.cli import opened_maps
    from tsfusion.pipelines.maps.saved_maps import SavedMapAnswers
    from tsfusion.tsdf.volume import Volume

    with opened_maps.opened(Path(where), map_, quiet=quiet) as file:
        yield SavedMapAnswers(Volume.load(file, memory_bytes=opened_maps.memory_for(file)))


# --- pictures ---


def _checked(out: Path | None, what: str, suffixes: tuple[str, ...]) -> Path:
    """Return the file for an answer that a terminal cannot show. Raise InvalidConfig without one."""
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable

    if out is None:
        raise InvalidConfig(f"{what} needs a file: give OUT, such as out.png")
    check_writable(out, suffixes)
    return out


def _write_slice(answer: "Answered[Any]", out: Path, *, json: bool) -> None:
    """Write a slice of either kind, and print what it shows."""
    from tsfusion.cli import output
    from tsfusion.geometry.map_grids import FREE, OCCUPIED, UNSEEN

    found = answer.result
    files = found.save(out)
    rows, columns = found.cells.shape
    names = {"free": FREE, "occupied": OCCUPIED, "unseen": UNSEEN}
    shares = {name: float((found.cells == state).mean()) for name, state in names.items()}
    figures = {"rows": rows, "columns": columns, "resolution_m": found.grid.resolution, **shares}
    said = ", ".join(f"{100 * share:.0f} % {name}" for name, share in shares.items())
    if not getattr(found, "knows_free_space", True):
        said += " (free space is known near surfaces alone)"
    if hasattr(found, "reach"):
        figures |= {"distances": "horizontal", "reach_m": found.reach}
        said += f", horizontal distances up to {found.reach:g} m"
    cells = f"{columns}×{rows} cells of {found.grid.resolution:g} m"
    if found.grid.floor is not None:
        figures["floor_m"] = found.grid.floor
        cells += f" between {found.grid.heights_in_words}"
    words = f"{' and '.join(map(str, files))}: {cells}, {said}; {_state([answer])}"
    output.result({"files": list(map(str, files)), **figures, **_figures([answer])}, words, json=json)


def _camera(view: PoseFlag, size: str, intrinsics: str | None) -> tuple[Any, Any, tuple[int, int]]:
    """Return intrinsics, pose and (height, width) of the camera."""
    import re

    import numpy as np

    from tsfusion.core.errors import InvalidConfig
    from tsfusion.geometry.keyframe import Intrinsics
    from tsfusion.geometry.map_answers import checked_camera
    from tsfusion.geometry.trajectory import rigid

    sides = re.fullmatch(r"([0-9]{1,5})[x×]([0-9]{1,5})", size)
    if sides is None:
        raise InvalidConfig(f"--size must be WIDTHxHEIGHT in pixels, such as 640x480, got {size!r}")
    width, height = map(int, sides.groups())
    quaternion = np.array(view[3:])
    if not abs(np.linalg.norm(quaternion) - 1) < 0.01:
        raise InvalidConfig(
            "--view must be a line of trajectory.txt without its time: x y z, and a quaternion qx qy qz qw "
            f"of length 1; got length {np.linalg.norm(quaternion):.3g}"
        )
    given = options.camera(intrinsics, None)["intrinsics"]
    usual = Intrinsics(0.9 * width, 0.9 * width, (width - 1) / 2, (height - 1) / 2)
    pose = rigid(quaternion / np.linalg.norm(quaternion), np.array(view[:3]))
    return checked_camera(given or usual, pose, (height, width))


def _write_view(answer: "Answered[Any]", out: Path, *, json: bool) -> None:
    from tsfusion.cli import output
    from tsfusion.pipelines.maps import answer_files

    found = answer.result
    answer_files.write_view(out, found)
    height, width = found.depth.shape
    hit = found.depth[found.depth > 0]
    share = float(len(hit) / found.depth.size)
    nearest = float(hit.min()) if len(hit) else None
    figures = {"width": width, "height": height, "hit": share, "nearest_m": nearest}
    seen = f"the surface in {100 * share:.0f} % of it" if len(hit) else "no surface"
    near = "" if nearest is None else f", at {nearest:.2f} m and more"
    words = f"{out}: {width}×{height} pixels, {seen}{near}; {_state([answer])}"
    output.result({"path": str(out), **figures, **_figures([answer])}, words, json=json)


# --- words ---


def _sentences(points: "NDArray[np.float64]", found: "Samples") -> list[str]:
    import numpy as np

    lines = []
    for point, distance, weight in zip(points.tolist(), found.distance, found.weight, strict=True):
        place = " ".join(f"{one:g}" for one in point)
        if np.isnan(distance):
            lines.append(f"{place}: unseen, or farther from a surface than that: not known to be free")
        else:
            side = "in front of" if distance >= 0 else "behind"
            lines.append(f"{place}: {abs(distance):.4f} m {side} the surface, weight {weight:.1f}")
    return lines


def _counts(found: "Samples") -> str:
    import numpy as np

    seen = int(np.isfinite(found.distance).sum())
    return (
        f"{len(found.distance)} points, of which the map has seen {seen}; distances as fused, {_reach(found)}"
    )


def _reach(found: "Samples") -> str:
    return f"known up to {found.reach:.3g} m before a surface" if found.reach else "known near surfaces"


def _state(answers: "list[Answered[Any]]") -> str:
    """Return in words the state of the map that answered, and how long the answer took."""
    last = answers[-1]
    took = sum(one.delay_s for one in answers)
    words = f"a map of {last.state.keyframes} keyframes, answered in {1e3 * took:.1f} ms"
    if len({one.state for one in answers}) > 1:
        words += "; keyframes came between the parts of the answer, which are of different states of the map"
    return words


def _figures(answers: "list[Answered[Any]]") -> dict[str, Any]:
    from msgspec.structs import asdict

    states = list(dict.fromkeys(one.state for one in answers))
    return {
        "states": [asdict(one) for one in states],
        "delay_ms": round(1e3 * sum(one.delay_s for one in answers), 3),
        "waited_ms": round(1e3 * sum(one.waited_s for one in answers), 3),
        "took_ms": round(1e3 * sum(one.took_s for one in answers), 3),
    }


def _print_json(
    answers: "list[Answered[Samples]]", points: "NDArray[np.float64]", found: "Samples", out: Path | None
) -> None:
    """Print the samples as JSON. A distance is null if it is unseen or beyond the known reach."""
    import numpy as np

    from tsfusion.cli import output

    figures: dict[str, Any] = {"points": len(points), "seen": int(np.isfinite(found.distance).sum())}
    figures |= {"distances": "as fused", "reach_m": found.reach}
    if out is None:
        figures["samples"] = [
            {
                "point": point,
                "distance": None if np.isnan(distance) else float(distance),
                "weight": float(weight),
                "gradient": None if np.isnan(gradient).any() else gradient.tolist(),
            }
            for point, distance, weight, gradient in zip(
                points.tolist(), found.distance, found.weight, found.gradient, strict=True
            )
        ]
    else:
        figures["path"] = str(out)
    output.as_json({**figures, **_figures(answers)})
