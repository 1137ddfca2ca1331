# SPDX-License-Identifier: MIT
"""`tsfusion map move`."""

from typing import Annotated

import typer

from tsfusion.cli import options, verbs

_EXAMPLES = (
    "tsfusion map move yard --from tcp://one:5555 --to tcp://two:5555",
    "tsfusion map move default --from tcp://one:5555 --to tcp://two:5555 --json",
)


def register(app: typer.Typer) -> None:
    """Make `move` a verb of `tsfusion map`."""
    verbs.verb(app, *_EXAMPLES)(move)


def move(
    name: Annotated[str, typer.Argument(metavar="NAME", help="The map.")],
    *,
    source: Annotated[
        str, typer.Option("--from", metavar="ADDRESS", help="The server that has it: tcp://HOST:PORT.")
    ],
    to: Annotated[str, typer.Option("--to", metavar="ADDRESS", help="The server that is to have it.")],
    timeout: Annotated[float, typer.Option(metavar="SECONDS", help="Longest wait for the end.")] = 3600.0,
    key: options.Key = None,
    server_key: options.ServerKey = None,
    json: options.Json = False,
    help_all: verbs.HelpAll = None,
) -> None:
    """Move a live map from one server to another, while scanners send into it.

    The map is copied while it grows; then it stands still for a moment, and
    scanners go on at the other server, where every keyframe is once. What
    the first server had stays in its state folder, under moved/. Servers
    with keys must have the same pair; this key needs `tsfusion keys allow
    NAME --forget`. Without an answer in time the move goes on.
    """
    import msgspec

    from tsfusion.cli import output
    from tsfusion.wire import queries
    from tsfusion.wire.curve import client_keys

    moved = queries.move_map(name, source, to, timeout=timeout, keys=client_keys(key, server_key))
    if json:
        output.as_json({"map": name, **msgspec.structs.asdict(moved)})
    else:
        typer.echo(
            f"map {name} is at {moved.address}: {moved.nbytes / 1e6:.1f} MB in {moved.seconds:.1f} s; it "
            f"took no keyframes for {moved.frozen_s:.2f} s of them"
        )
