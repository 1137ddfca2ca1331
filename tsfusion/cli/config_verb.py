# SPDX-License-Identifier: MIT
"""`tsfusion config dump`."""

import typer

from tsfusion.cli import options, verbs

app = typer.Typer(cls=verbs.Group, help="The settings and their defaults.")


@app.callback()
def _group() -> None:
    """Keep `dump` a verb of its own while it is the only one."""


@verbs.verb(app, "tsfusion config dump > tsfusion.toml", "tsfusion config dump --config tsfusion.toml --json")
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
