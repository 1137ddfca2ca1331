# SPDX-License-Identifier: MIT
"""The live page of a run: `--view` of demo, replay and scan."""

from typing import TYPE_CHECKING

import typer

if TYPE_CHECKING:
    from tsfusion.cli.progress import Quiet
    from tsfusion.pipelines.viewer_child import ViewerChild


def beside(view: str | None, display: "Quiet", *, truth: str | None = None) -> "ViewerChild | None":
    """The page, whose address is shown where the run's progress is.

    Args:
        view: HOST:PORT; None = no page.
        truth: known surface of the map; see `ViewerChild`.

    Raises:
        MissingDependency, InvalidConfig, TransportError: when it cannot be shown.
    """
    if view is None:
        return None
    from tsfusion.pipelines.viewer_child import ViewerChild

    return ViewerChild(view, lambda url: display.say(f"page {url}"), truth=truth)


def print_again(view: str | None, folder: str, connect: str | None) -> None:
    """Say how the map of a run that had a page is seen again.

    Args:
        folder: of the run's results.
        connect: address of the server elsewhere that has the map; None = the folder has it.
    """
    if view is not None:
        typer.echo(f"page       tsfusion view {connect or folder}")
