# SPDX-License-Identifier: MIT
"""`tsfusion report`."""

from pathlib import Path
from typing import Annotated

import typer

from tsfusion.cli import options


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
    from tsfusion.pipelines.report import findings, run_report
    from tsfusion.pipelines.report.page import ENDINGS
    from tsfusion.pipelines.runs.run_files import REPORT

    is_run = findings.is_run(source)
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
    if json:
        output.as_json({"path": str(page), "files": [str(file) for file in files]})
    else:
        typer.echo(f"{page}: {output.size(page.stat().st_size)}, open it in a browser")
