# SPDX-License-Identifier: MIT
"""`tsfusion check`."""

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer

from tsfusion.cli import options, runs, verbs


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
