# SPDX-License-Identifier: MIT
"""The `tsfusion` command.

Each verb imports what it needs when it runs, so that `--help` and `status` answer at once.
"""

import os
import signal
import sys
from types import FrameType
from typing import Annotated, NoReturn

import typer

from tsfusion.cli import (
    ate,
    check,
    config,
    datasets,
    doctor,
    download,
    journal,
    keys,
    mesh,
    replay,
    scan,
    serve,
    status,
)
from tsfusion.core.errors import TsfusionError

INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
# Typer's own click or the real one, by version: both name it so.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

app = typer.Typer(
    name="tsfusion",
    help="Depth sensors in, one exact 3-D map out.",
    add_completion=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
app.command()(replay.demo)
app.command()(replay.replay)
app.command()(scan.scan)
app.command()(check.check)
app.command()(serve.serve)
app.command()(mesh.mesh)
app.command()(status.status)
app.command()(ate.ate)
app.command()(doctor.doctor)
app.command()(download.download)
app.add_typer(keys.app, name="keys")
app.add_typer(journal.app, name="journal")
app.add_typer(config.app, name="config")
app.add_typer(datasets.app, name="datasets")


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        from importlib.metadata import version as installed

        typer.echo(f"tsfusion {installed('tsfusion')}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run a command line (default: this process's) and exit.

    Every error raised on purpose becomes one line on stderr and status 1; a wrong flag status 2; Ctrl-C 130;
    SIGTERM 143.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:  # as `__main__` leaves it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminated)
    try:
        code = app(arguments, standalone_mode=False)
    except TsfusionError as error:
        _fail(str(error), 1)
    except _UsageError as error:
        _fail(f"{error.format_message()} (see --help)", 2)  # type: ignore[attr-defined]
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", INTERRUPTED)
    except SystemExit as ended:
        if ended.code == TERMINATED:
            _fail("terminated", TERMINATED)
        raise
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    if code == INTERRUPTED:
        _fail("interrupted", INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"tsfusion: {' '.join(message.split())}", err=True)
    sys.exit(code)


def _terminated(signum: int, frame: FrameType | None) -> NoReturn:
    """Unwind as Ctrl-C does: half-written results are removed, and child processes end."""
    sys.exit(TERMINATED)
