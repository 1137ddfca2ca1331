# SPDX-License-Identifier: MIT
"""`tsfusion check`, `ate` and `report`: judge a recording, a trajectory, and a run or a map."""

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from tsfusion.cli import options, runs, verbs

if TYPE_CHECKING:
    from tsfusion.datasets import Dataset
    from tsfusion.evaluation.trajectory_error import TrajectoryError


_OTHER_AXES = 20  # degrees; no odometry is so far off on average
_FORMATS = "TUM, KITTI, 4×4, EuRoC's CSV, g2o or Redwood .log."


def check(
    path: Annotated[
        Path, typer.Argument(metavar="PATH", help="A dataset or a journal, as `tsfusion replay` takes it.")
    ],
    *,
    trajectory: options.TrajectoryFlag = None,
    origin: options.OriginFlag = None,
    sequence: options.Sequence = None,
    modality: options.ModalityFlag = None,
    calibration: options.Calibration = None,
    intrinsics: options.IntrinsicsFlag = None,
    option: options.DatasetOptions = None,
    unpack: options.Unpack = False,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Check that poses, camera and depth agree, and say what is wrong.

    Exit status 1 when they disagree, or the clock steps back; 0 when they agree, and when nobody can tell.
    """
    from tsfusion.cli import output
    from tsfusion.core.errors import IncompleteRun
    from tsfusion.datasets.cameras import camera_line
    from tsfusion.evaluation import pose_check
    from tsfusion.pipelines.report import shortfall

    dataset = runs.open_recording(
        path,
        **options.dataset_options(
            option, unpack=unpack, sequence=sequence, modality=modality, trajectory=trajectory,
            origin=origin,
            **options.camera(intrinsics, calibration),
        ),
    )  # fmt: skip
    report = pose_check.check(dataset)
    if json:
        output.as_json({"name": dataset.name, "camera": camera_line(dataset), **asdict(report)})
    else:
        typer.echo(f"{dataset.name}: {report.text}")
        if report.fit is not None:
            typer.echo(f"{report.pairs} pairs of frames; fit as given {report.fit:.2f}, "
                       f"after small corrections {report.best_fit:.2f} (1 = exact)")  # fmt: skip
            if report.focal_px is not None:
                used, fitted, sigma = report.focal_px
                typer.echo(f"focal length {used:.4g} px used, {fitted:.0f} ± {sigma:.0f} fits best")
            for name, fit in sorted(report.tried.items(), key=lambda item: -item[1]):
                typer.echo(f"  if {name:<16} {fit:.2f}")
    if late := shortfall.of_clock(dataset.skipped):
        raise IncompleteRun(late)
    if report.verdict == "disagree":
        raise typer.Exit(1)


def ate(
    estimate: Annotated[Path, typer.Argument(metavar="ESTIMATE", help=f"A trajectory file: {_FORMATS}")],
    reference: Annotated[
        Path, typer.Argument(metavar="REFERENCE", help="The true trajectory: such a file, or a dataset.")
    ],
    *,
    max_difference: Annotated[
        float, typer.Option(metavar="SECONDS", min=0.0, help="Largest time between matching poses, s.")
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
    """Return a trajectory file, or a dataset with all its frames, also frames without a pose."""
    if reference.is_file() and not given:
        return reference
    from tsfusion.cli.runs import open_recording

    return open_recording(reference, **{"posed": False} | given)


def table(rows: "list[tuple[str, TrajectoryError]]") -> str:
    """Return the usual table of trajectory errors, with a line for each trajectory."""
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


def report(
    source: Annotated[
        Path,
        typer.Argument(metavar="OUT|STATE", help="A run's folder, a state folder, or a map (.tsf)."),
    ],
    *,
    out: Annotated[
        Path | None,
        typer.Option("--out", metavar="FILE.html", help="The page; default: report.html in a run's folder."),
    ] = None,
    map_: options.Map = None,
    json: options.Json = False,
) -> None:
    """Show a run, or a saved map, as one page that needs no network.

    The mesh from four sides and in 3-D, delay, trajectory, and the error where
    the truth is known. The pictures are beside the page as PNG, too. Demo,
    replay and scan leave it as report.html.
    """
    from tsfusion.cli import opened_maps, output, progress
    from tsfusion.core.errors import InvalidConfig
    from tsfusion.core.output_folder import check_writable
    from tsfusion.pipelines.report import run_record, run_report
    from tsfusion.pipelines.report.page import ENDINGS
    from tsfusion.pipelines.runs.run_files import REPORT

    is_run = run_record.is_run(source)
    if is_run and map_ is not None:
        raise InvalidConfig(f"--map has no effect on {source}: a run's report has all its maps")
    page = out or (source / REPORT if is_run else Path(REPORT))
    check_writable(page, ENDINGS)
    if is_run:
        with progress.shown(quiet=json) as display:
            display.stage(f"drawing {source}")
            files = run_report.write(source, page)
    else:
        from tsfusion.pipelines.report import map_report

        with progress.reading(opened_maps.JOURNAL, quiet=json) as watch:
            about = map_report.read(source, map_, watch)
        with opened_maps.opened(source, map_, quiet=json) as file:
            files = map_report.write(about, file, page, memory_bytes=opened_maps.memory_for(file))
    words = f"{page}: {output.size(page.stat().st_size)}, open it in a browser"
    output.result({"path": str(page), "files": [str(file) for file in files]}, words, json=json)
