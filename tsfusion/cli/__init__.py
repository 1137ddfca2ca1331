# SPDX-License-Identifier: MIT
"""Define the `tsfusion` command, and run a command line.

Each verb imports what it needs when it runs, so that `--help` and `status` answer at once.
"""

import errno
import os
import signal
import stat
import sys
from contextlib import suppress
from types import FrameType
from typing import Annotated, NoReturn

import typer

from tsfusion import __version__
from tsfusion.cli import (
    ask,
    check,
    datasets,
    doctor,
    fuse,
    journal,
    keys,
    map,
    mesh_verb,
    opened_maps,
    ros2,
    runs,
    serve,
    spool_verb,
    status,
    verbs,
    view,
)
from tsfusion.core.errors import DISK_FULL, TsfusionError, reason_of

INTERRUPTED = 128 + signal.SIGINT
TERMINATED = 128 + signal.SIGTERM
# Typer's own click or the real one, by version: both name it so.
_UsageError: type[Exception] = next(c for c in typer.BadParameter.__mro__ if c.__name__ == "ClickException")

START, OWN, SERVER = "Start here", "Recordings and results", "Server and installation"
SETUP = SERVER  # a title of its own takes two lines of the screen

app = typer.Typer(
    name="tsfusion",
    cls=verbs.Group,
    help="Depth sensors in, one exact 3-D map out.",
    epilog="Flags are environment variables, too: TSFUSION_VOXEL_SIZE for --voxel-size.",
    context_settings={"help_option_names": ["-h", "--help"]},
)
verbs.verb(app, "tsfusion demo", "tsfusion demo --world street --rate 2", panel=START)(runs.demo)
verbs.verb(
    app, "tsfusion scan my-recording --voxel-size 0.02",
    "tsfusion scan realsense --connect tcp://server:5555 --map yard", panel=START,
)(runs.scan)  # fmt: skip
verbs.verb(
    app, "tsfusion replay my-recording --voxel-size 0.02",
    "tsfusion replay kitchen.bag --trajectory slam.txt", panel=START,
)(runs.replay)  # fmt: skip
verbs.verb(
    app, "tsfusion check my-recording", "tsfusion check my-recording --trajectory slam.txt", panel=OWN
)(check.check)
verbs.verb(
    app, "tsfusion report out/latest", "tsfusion report my-maps --map yard --out yard.html", panel=OWN
)(check.report)
verbs.verb(
    app, "tsfusion mesh out/latest/map.tsf room.glb", "tsfusion mesh tcp://server:5555 yard.ply --map yard",
    panel=OWN,
)(mesh_verb.mesh)  # fmt: skip
verbs.verb(
    app, "tsfusion fuse my-maps --voxel-size 0.02 --workers 4 --out fused",
    "tsfusion fuse s3://scans/monday --ray auto --out /shared/monday", panel=OWN,
)(fuse.fuse)  # fmt: skip
verbs.verb(
    app, "tsfusion ask tcp://server:5555 --at 1.2 0 0.5",
    "tsfusion ask out/latest/map.tsf room.pgm --slice 0.1 1.5 --up z", panel=OWN,
)(ask.ask)  # fmt: skip
verbs.verb(
    app, "tsfusion view tcp://server:5555 --map yard", "tsfusion view out/latest --listen 127.0.0.1:0",
    panel=OWN,
)(view.view)  # fmt: skip
app.add_typer(map.app, name="map", rich_help_panel=OWN)
verbs.verb(
    app, "tsfusion ate out/latest/trajectory.txt groundtruth.txt",
    "tsfusion ate estimate.txt my-recording --plot error.png", panel=OWN,
)(check.ate)  # fmt: skip
app.add_typer(datasets.app, name="datasets", rich_help_panel=OWN)
verbs.verb(app, "tsfusion download", "tsfusion download tum-fr1-xyz --to datasets", panel=OWN)(
    datasets.download
)
verbs.verb(
    app, "tsfusion serve --state my-maps --voxel-size 0.02",
    "tsfusion serve --listen tcp://0.0.0.0:5555 --keys tsfusion-keys", panel=SERVER,
)(serve.serve)  # fmt: skip
verbs.verb(
    app, "tsfusion status --watch 1", "tsfusion status --connect tcp://server:5555 --json", panel=SERVER
)(status.status)
app.add_typer(journal.app, name="journal", rich_help_panel=SERVER)
app.add_typer(keys.app, name="keys", rich_help_panel=SERVER)
app.add_typer(spool_verb.app, name="spool", rich_help_panel=SERVER)
app.add_typer(ros2.app, name="ros2", rich_help_panel=SERVER)
verbs.verb(app, "tsfusion doctor", "tsfusion doctor /mnt/maps", panel=SETUP)(doctor.doctor)
app.add_typer(keys.config_app, name="config", rich_help_panel=SETUP)


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False,
) -> None:
    if version:
        typer.echo(f"tsfusion {__version__}")
    elif context.invoked_subcommand is None:
        typer.echo(context.get_help())


# A run writes to many folders. If a disk refuses in any of them, the user can help: no traceback.
_DISK_REFUSES = (*DISK_FULL, errno.EROFS)

# Packages that a robot's light installation does not have.
_NOT_OF_THE_CLIENT = ("matplotlib", "prometheus_client", "pykitti", "taichi")


def main(arguments: list[str] | None = None) -> NoReturn:
    """Run a command line (default: this process's) and exit.

    An error raised on purpose becomes one line on stderr and status 1. A wrong flag gives status 2, Ctrl-C
    130, SIGTERM 143. A terminal that goes away ends the command as SIGTERM does.
    """
    if signal.getsignal(signal.SIGINT) == signal.SIG_DFL:  # as `__main__` leaves it
        signal.signal(signal.SIGINT, signal.default_int_handler)
    signal.signal(signal.SIGTERM, _terminated)
    if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:  # else nohup's
        signal.signal(signal.SIGHUP, _hung_up)
    try:
        opened_maps.begin()
        code = app(arguments, prog_name="tsfusion", standalone_mode=False)
        opened_maps.end()
    except TsfusionError as error:
        _fail(str(error), 1)
    except _UsageError as error:
        _fail(f"{error.format_message()}{_variable(error)} (see --help)", 2)  # type: ignore[attr-defined]
    except (KeyboardInterrupt, typer.Abort):
        _fail("interrupted", INTERRUPTED)
    except SystemExit as ended:
        if ended.code == TERMINATED:
            _fail("terminated", TERMINATED)
        raise
    except BrokenPipeError:  # the reader of our output went away
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
    except ModuleNotFoundError as error:
        if error.name not in _NOT_OF_THE_CLIENT:
            raise
        _fail(f"this needs {error.name}, which tsfusion-client leaves out: pip install . in your clone", 1)
    except MemoryError as error:
        _fail(f"not enough memory: {error}", 1)
    except OSError as error:
        if error.errno not in _DISK_REFUSES:
            raise
        place = f" ({error.filename})" if error.filename else ""
        _fail(f"a disk refuses to be written{place}: {reason_of(error, 'choose another folder')}", 1)
    if code == INTERRUPTED:
        _fail("interrupted", INTERRUPTED)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int) -> NoReturn:
    typer.echo(f"tsfusion: {' '.join(message.split())}", err=True)
    sys.exit(code)


def _variable(error: Exception) -> str:
    """Return words that name the environment variable of a wrong value; empty if the value was typed."""
    context, parameter = getattr(error, "ctx", None), getattr(error, "param", None)
    if context is None or parameter is None:
        return ""
    source = context.get_parameter_source(parameter.name)
    is_set = source is not None and source.name == "ENVIRONMENT"
    return f" (environment variable {parameter.envvar})" if is_set else ""


def _terminated(signum: int, frame: FrameType | None) -> NoReturn:
    """Exit as after Ctrl-C: half-written results are removed, and child processes end."""
    sys.exit(TERMINATED)


def _hung_up(signum: int, frame: FrameType | None) -> None:
    """Redirect the streams of a closed terminal to nowhere, and then end as by SIGTERM.

    Both the shell and the kernel may send SIGHUP. Further ones are ignored, as a second SIGTERM ends a scan.
    """
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    nowhere = os.open(os.devnull, os.O_RDWR)
    for stream in range(3):
        with suppress(OSError):
            mode = os.fstat(stream).st_mode
            if stat.S_ISCHR(mode) or stat.S_ISFIFO(mode):  # a pipe's other end, such as `tee`, goes too
                os.dup2(nowhere, stream)
    os.kill(os.getpid(), signal.SIGTERM)
