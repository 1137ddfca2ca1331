# SPDX-License-Identifier: MIT
"""`tsfusion ate`."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options

if TYPE_CHECKING:
    from tsfusion.datasets import Dataset
    from tsfusion.evaluation.trajectory_error import TrajectoryError

_OTHER_AXES = 20  # degrees; no odometry is so far off on average
_FORMATS = "TUM, KITTI or Redwood .log."


def ate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help=f"A trajectory file: {_FORMATS}")],
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="The true one: such a file, or a dataset with poses.")
    ],
    *,
    max_difference: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.0, help="Largest time between two matching poses.")
    ] = 0.01,
    align: Annotated[
        bool, typer.Option("--align/--no-align", help="First move the estimate onto the truth (rigidly).")
    ] = True,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE.png", help="Draw the trajectory, coloured by its error.")
    ] = None,
    option: options.DatasetOptions = None,
    json: options.Json = False,
) -> None:
    """Print the absolute trajectory error (ATE) of an estimate."""
    from tsfusion.cli import output
    from tsfusion.core.output_folder import check_writable
    from tsfusion.evaluation import trajectory_error

    if plot is not None:
        check_writable(plot, (".png", ".pdf", ".svg"))
    truth = _truth(reference, options.dataset_options(option))
    a, b = trajectory_error.paired(estimate, truth, max_difference_s=max_difference)
    error = trajectory_error.absolute_error(a, b, align=align)
    if plot is not None:
        from tsfusion.evaluation.trajectory_error import draw

        draw(a, b, plot, align=align)
    if json:
        output.as_json(error)
        return
    typer.echo(table([("ATE", error)]))
    if error.rotation_deg > _OTHER_AXES:
        typer.echo(
            f"the orientations differ by {error.rotation_deg:.0f}° on average: are the poses of different "
            "axes (camera, LiDAR, body)? drift is then meaningless"
        )


def _truth(reference: Path, given: dict[str, Any]) -> "Path | Dataset":
    """A trajectory file as it is, or a dataset with all its frames: those without a pose count too."""
    if reference.is_file() and not given:
        return reference
    from tsfusion.cli.runs import open_recording

    return open_recording(reference, **{"posed": False} | given)


def table(rows: "list[tuple[str, TrajectoryError]]") -> str:
    """The usual table of trajectory errors, a line a trajectory."""
    head = ("min", "max", "mean", "median", "std", "RMSE")
    width = max(len(name) for name, _ in rows)
    lines = [" " * width + "".join(f"{name:>10}" for name in head) + "   poses      length       drift"]
    for name, error in rows:
        figures = (error.min, error.max, error.mean, error.median, error.std, error.rmse)
        lines.append(
            f"{name:<{width}}" + "".join(f"{_metres(value):>10}" for value in figures)
            + f"{error.count:>8}{error.length:>10.1f} m{error.drift_percent:>10.2f} %"
        )  # fmt: skip
    return "\n".join(lines)


def _metres(value: float) -> str:
    return f"{1000 * value:.1f} mm" if value < 1 else f"{value:.2f} m"
