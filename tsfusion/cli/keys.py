# SPDX-License-Identifier: MIT
"""`tsfusion keys new|list|allow|revoke`: manage keys; and `tsfusion config dump`."""

import shlex
from pathlib import Path
from typing import Annotated

import typer

from tsfusion.cli import options, verbs

app = typer.Typer(
    cls=verbs.Group,
    help="""Make keys, and choose who may connect to a server.

    Three steps let a scanner in, and nobody else:

    1. on the server: `tsfusion keys new server`

    2. on the scanner: `tsfusion keys new robot1`

    3. on the server: `tsfusion keys allow robot1 KEY`, with the key that step 2 printed

    Then `tsfusion serve --keys tsfusion-keys --listen tcp://0.0.0.0:5555` on the server, and on the scanner
    `--key tsfusion-keys/robot1.key_secret --server-key KEY`, with the key that step 1 printed.

    A secret key never leaves the machine that made it.
    """,
)
KeysFlag = Annotated[
    Path,
    typer.Option(
        "--dir", metavar="DIR", envvar="TSFUSION_KEYS", help="The folder of keys; only its owner may read it."
    ),
]
Name = Annotated[str, typer.Argument(metavar="NAME", help="Name of keys: 1 to 32 letters, digits and . _ -")]
_FOLDER = Path("tsfusion-keys")
config_app = typer.Typer(cls=verbs.Group, help="The settings and their defaults.")


@verbs.verb(app, "tsfusion keys new server", "tsfusion keys new robot1 --dir robot-keys")
def new(
    name: Name,
    *,
    folder: KeysFlag = _FOLDER,
    force: Annotated[bool, typer.Option("--force", help="Replace the pair that this name has.")] = False,
) -> None:
    """Make a pair of keys: NAME.key_secret stays here, NAME.key is for the other side.

    The name `server` is for the server's own pair.
    """
    from tsfusion.wire.keys import key_folder
    from tsfusion.wire.sockets import curve

    made = key_folder.create_pair(folder, name, force=force)
    typer.echo(f"public key of {name}: {made.public}")
    if name == curve.SERVER:
        place = shlex.quote(str(folder))
        at = "" if folder == _FOLDER else f" --dir {place}"
        typer.echo(
            f"next, for each scanner: tsfusion keys allow NAME KEY{at}\n"
            f"then: tsfusion serve --keys {place} --listen tcp://0.0.0.0:5555\n"
            f"scanners connect with: --key NAME{curve.SECRET} --server-key {shlex.quote(made.public)}"
        )
    else:
        typer.echo(f"next, on the server: tsfusion keys allow {name} {shlex.quote(made.public)}")


@verbs.verb(
    app,
    "tsfusion keys allow robot1 robot1.key",
    "tsfusion keys allow robot1 --maps 'house,yard-*'",
)
def allow(
    name: Name,
    key: Annotated[
        str | None,
        typer.Argument(
            metavar="[KEY|FILE]",
            help="A public key: 40 characters, or a .key file. Not needed if NAME is allowed already.",
        ),
    ] = None,
    *,
    maps: Annotated[
        str | None,
        typer.Option(
            metavar="NAMES",
            help="Maps it may send into, ask about and watch, with commas; yard-* = all that begin so, '*' = "
            "every map. Else as before; a new name may use every map.",
        ),
    ] = None,
    forget: Annotated[
        bool | None,
        typer.Option(
            "--forget/--no-forget",
            help="It may make the server forget keyframes of others, too (`tsfusion map forget`).",
        ),
    ] = None,
    folder: KeysFlag = _FOLDER,
) -> None:
    """Let a scanner connect; a running server lets it in at once.

    A name has one key: a new one replaces the old, and the name keeps its sessions and its maps. KEY may hold
    characters that mean something to a shell: put it in single quotes, with -- before it if it begins with a
    dash.
    """
    from tsfusion.wire.keys import key_folder

    patterns = None if maps is None else [one.strip() for one in maps.split(",")]
    earlier = key_folder.allow(folder, name, key, maps=patterns, forget=forget)
    client = key_folder.read_allow_list(folder).clients[name]
    typer.echo(
        f"{name} may connect"
        + ("" if client.limits is None else f", and use these maps: {', '.join(client.limits)}")
        + ("; it may forget keyframes of others, too" if client.forget else "")
    )
    if earlier is not None:
        typer.echo(f"its earlier key no longer may: {earlier}")


@verbs.verb(app, "tsfusion keys revoke robot1", "tsfusion keys revoke robot1 --dir /etc/tsfusion/keys")
def revoke(name: Name, *, folder: KeysFlag = _FOLDER) -> None:
    """Keep a scanner out; a running server closes its connections at once."""
    from tsfusion.wire.keys import key_folder

    key = key_folder.revoke(folder, name)
    typer.echo(f"{name} may no longer connect: {key}")


@verbs.verb(app, "tsfusion keys list", "tsfusion keys list --json", name="list")
def list_(*, folder: KeysFlag = _FOLDER, json: options.Json = False) -> None:
    """List the folder's own public keys, and on a server who is allowed and who was revoked."""
    from tsfusion.wire.keys import key_folder

    own = key_folder.list_pairs(folder)
    listed = key_folder.read_allow_list(folder) if key_folder.has_allow_list(folder) else key_folder.Allowed()
    clients = dict(sorted(listed.clients.items()))
    if json:
        from tsfusion.cli import output

        output.as_json(
            {
                "own": {pair.name: pair.public for pair in own},
                "allowed": {name: one.key for name, one in clients.items()},
                "revoked": listed.revoked,
                "maps": {name: one.limits for name, one in clients.items() if one.limits is not None},
                "forget": [name for name, one in clients.items() if one.forget],
            }
        )
        return
    rows: list[tuple[str, str, str]] = [("own", pair.name, pair.public) for pair in own]
    rows += [("allowed", name, one.key) for name, one in clients.items()]
    rows += [("revoked", name, key) for key, name in listed.revoked.items()]
    if not rows:
        made = "`tsfusion keys new server` makes a server's, `tsfusion keys new NAME` a scanner's"
        typer.echo(f"no keys in {folder}: {made} (--dir names the folder)", err=True)
    width = max((len(name) for _, name, _ in rows), default=0)
    for state, name, key in rows:
        client = clients[name] if state == "allowed" else key_folder.AllowedClient(key)
        maps = "" if client.limits is None else f"  maps: {', '.join(client.limits)}"
        forgets = "  forgets others'" if client.forget else ""
        typer.echo(f"{state:<8} {name:<{width}}  {key}{maps}{forgets}")


@config_app.callback()
def _group() -> None:
    """Keep `dump` a verb of its own while it is the only one."""


@verbs.verb(
    config_app, "tsfusion config dump > tsfusion.toml", "tsfusion config dump --config tsfusion.toml --json"
)
def dump(config: options.ConfigFile = None, json: options.Json = False) -> None:
    """Print every setting as commented TOML: the defaults, or with --config those of FILE."""
    from tsfusion.core import config as settings

    loaded = settings.load(config)
    if json:
        from tsfusion.cli import output

        output.as_json(loaded)
    else:
        variable = verbs.variable("--voxel-size")
        typer.echo(f"# Flags beat variables ({variable} is --voxel-size), and these beat this file.")
        typer.echo(settings.to_toml(loaded), nl=False)
