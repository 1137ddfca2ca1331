# SPDX-License-Identifier: MIT
"""Define what all verbs share: short help, examples, environment variables, renamed flags."""

import math
import re
from collections.abc import Callable, Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

from tsfusion.viewer import FOXGLOVE, LISTEN

PREFIX = "TSFUSION_"
RENAMED = {"--max-keyframes": "--max-frames", "--poses": "--trajectory"}  # understood until version 0.3
LOCAL = "local"  # value of --ray: a cluster of the run's own
_HOST_PORT = r"(?:\[[\da-fA-F:.]+\]|localhost|\*|[\w-]+(?:\.[\w-]+)+):\d{1,5}"
_PLACES = {  # flags whose address may be left out: its pattern, and the default
    "--view": (re.compile(_HOST_PORT, re.ASCII), LISTEN),
    "--foxglove": (re.compile(_HOST_PORT, re.ASCII), FOXGLOVE),
    "--ray": (re.compile(rf"auto|local|ray://\S+|{_HOST_PORT}", re.ASCII), LOCAL),
}
_SHORTER = {"--show-completion": "Print what that would install."}  # Typer's own takes two lines
_ALL = "tsfusion.help_all"  # key in `context.meta`: --help-all was given

_Verb = TypeVar("_Verb", bound=Callable[..., Any])


class _ShortHelp:
    """Help in few lines: without types of switches, second names of flags, environment variables."""

    def get_params(self, ctx: Any) -> Any:
        params = super().get_params(ctx)  # type: ignore[misc]
        for param in params:
            if param.param_type_name == "option":
                param.show_envvar = False
                param.metavar = "" if param.is_flag else param.metavar
                param.help = _SHORTER.get(param.opts[0], param.help)
        return params

    def format_help(self, ctx: Any, formatter: Any) -> None:
        if _ALL not in ctx.meta:
            for param in self.get_params(ctx):  # a column of second names would take room from every line
                param.opts, param.secondary_opts = [max(param.opts, key=len)], []
        super().format_help(ctx, formatter)  # type: ignore[misc]


class Group(_ShortHelp, TyperGroup):
    """A command that has verbs."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        rest: list[str] = super().parse_args(ctx, ["--help"] if args == ["--help-all"] else args)
        return rest


class Verb(_ShortHelp, TyperCommand):
    """A verb; each of its flags `--some-flag` can be set by the variable `TSFUSION_SOME_FLAG` too."""

    def get_params(self, ctx: Any) -> Any:
        params = super().get_params(ctx)
        for param in params:
            if param.param_type_name == "option" and not param.is_eager and param.help and not param.envvar:
                param.envvar = variable(param.opts[0])
        return params

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        _refuse_empty(ctx, args)
        if not any("--help-all" in param.opts for param in self.params):  # a verb without rare flags
            args = ["--help" if word == "--help-all" else word for word in args]
        words = [new for old in args for new in _renamed(old)]
        for flag, (place, usual) in _PLACES.items():
            if any(param.opts == [flag] and param.nargs == 1 for param in self.params):
                words = _with_places(words, flag, place, usual)
        rest = super().parse_args(ctx, words)
        for param in self.params:  # a range accepts nan, which is neither below nor above
            value = ctx.params.get(param.name)
            if param.param_type_name == "argument":
                _refuse_pipes(ctx, param, value if isinstance(value, (list, tuple)) else [value or ""])
            is_ranged = hasattr(param.type, "min") or hasattr(param.type, "max")
            if is_ranged and isinstance(value, float) and math.isnan(value):
                raise typer.BadParameter("a number is expected, got nan", ctx=ctx, param=param)
        return rest


def variable(flag: str) -> str:
    """Return the name of a flag's environment variable."""
    return PREFIX + flag.strip("-").replace("-", "_").upper()


def examples(*lines: str) -> str:
    """Return the examples at the end of a verb's help."""
    return "\n".join(["Examples:", *(f"$ {line}" for line in lines)])


def verb(
    app: typer.Typer, *lines: str, panel: str | None = None, name: str | None = None
) -> Callable[[_Verb], _Verb]:
    """Decorate a function that becomes a verb of `app`.

    Args:
        lines: two examples.
        panel: title under which the verb is listed.
    """
    return app.command(name, cls=Verb, rich_help_panel=panel, epilog=examples(*lines))


def _show_all(context: typer.Context, wanted: bool) -> None:
    if not wanted:
        return
    context.meta[_ALL] = True
    for param in context.command.params:
        if getattr(param, "help", None):
            param.hidden = False  # type: ignore[attr-defined]
    typer.echo(context.get_help())
    raise typer.Exit


# Flag of verbs with rare flags: hidden ones that have a help text.
HelpAll = Annotated[
    bool | None,
    typer.Option("--help-all", is_eager=True, callback=_show_all, help="Show the rare flags, too, and exit."),
]


def _refuse_empty(context: Any, words: list[str]) -> None:
    """Refuse an empty word: as a path it would mean the current folder."""
    for word in words:
        flag, equals, value = word.partition("=")
        if not word or (flag.startswith("--") and equals and not value):
            where = f"{flag} is" if word else "an argument is"
            raise typer.BadParameter(f'{where} empty (""): is a variable of the shell not set?', ctx=context)


def _refuse_pipes(context: Any, param: Any, places: Iterable[object]) -> None:
    """Refuse a named pipe, which would be waited for without end; that of a shell's `<(…)` has a writer."""
    for place in map(Path, map(str, places)):
        with suppress(OSError):
            if place.is_fifo() and not place.is_relative_to("/dev"):
                raise typer.BadParameter(f"{place} is a pipe, not a file", ctx=context, param=param)


def _with_places(words: list[str], flag: str, place: re.Pattern[str], usual: str) -> list[str]:
    """Give each `flag` of a command line its address: the next word if it is an address, else the default.

    In `--view PATH` the word is a path, and in `--view camera:0` a camera.
    """
    found: list[str] = []
    for word in words:
        if found and found[-1] == flag and place.fullmatch(word):
            found[-1] = f"{flag}={word}"
        else:
            found.append(word)
    return [f"{flag}={usual}" if word == flag else word for word in found]


def _renamed(word: str) -> list[str]:
    """Replace old names of flags in a word of the command line; `scan --source X` becomes `scan X`."""
    flag, equals, value = word.partition("=")
    if flag == "--source":
        return [value] if equals else []
    return [RENAMED.get(flag, flag) + equals + value]
