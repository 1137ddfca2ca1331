# SPDX-License-Identifier: MIT
"""Flags that several verbs share, and the configuration they make.

A flag beats its environment variable, which beats the file, which beats the default in `tsfusion.config`.
"""

from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from tsfusion.config import Config

_MAP = "Map"
MAP_FLAGS = ("voxel_size", "sensor", "regularizer", "smoothness", "max_range")

ConfigFile = Annotated[
    Path | None,
    typer.Option(
        "--config", metavar="FILE", envvar="TSFUSION_CONFIG", help="TOML; `tsfusion config dump` writes one."
    ),
]
VoxelSize = Annotated[
    float | None,
    typer.Option(
        "--voxel-size", metavar="METRES", envvar="TSFUSION_VOXEL_SIZE", rich_help_panel=_MAP,
        help="Edge of a voxel.",
    ),
]  # fmt: skip
Sensor = Annotated[
    str | None,
    typer.Option(
        "--sensor", metavar="NAME", envvar="TSFUSION_SENSOR", rich_help_panel=_MAP,
        help="Noise model: kinect, tof, realsense, stereo, lidar or scanner.",
    ),
]  # fmt: skip
Regularizer = Annotated[
    str | None,
    typer.Option(
        "--regularizer", metavar="MODE", envvar="TSFUSION_REGULARIZER", rich_help_panel=_MAP,
        help="Smoothing along rays: off, paper or ray; else the sensor's.",
    ),
]  # fmt: skip
Smoothness = Annotated[
    float | None,
    typer.Option(
        "--lambda", metavar="NUMBER", envvar="TSFUSION_LAMBDA", rich_help_panel=_MAP,
        help="Strength of the smoothing; else the sensor's.",
    ),
]  # fmt: skip
MaxRange = Annotated[
    float | None,
    typer.Option(
        "--max-range", metavar="METRES", envvar="TSFUSION_MAX_RANGE", rich_help_panel=_MAP,
        help="Measurements beyond it are left out; else the sensor's.",
    ),
]  # fmt: skip
Threads = Annotated[
    int | None,
    typer.Option(
        "--threads", metavar="N", envvar="TSFUSION_THREADS", rich_help_panel=_MAP,
        help="Kernel threads; else all cores. Results do not depend on it.",
    ),
]  # fmt: skip
MinWeight = Annotated[
    float | None,
    typer.Option(
        "--min-weight",
        metavar="SAMPLES",
        help="Full-confidence samples a voxel needs to be meshed; else the sensor's.",
    ),
]
Connect = Annotated[
    str | None,
    typer.Option(
        "--connect", metavar="ADDRESS", envvar="TSFUSION_CONNECT", help="A running server's address."
    ),
]
Control = Annotated[
    str | None,
    typer.Option(
        "--control", metavar="ADDRESS", envvar="TSFUSION_CONTROL",
        help="Its control address; else the port after the other.",
    ),
]  # fmt: skip
Json = Annotated[bool, typer.Option("--json", help="Print JSON for a program to read.")]


def refuse(context: typer.Context, names: Collection[str], reason: str) -> None:
    """Raise InvalidConfig when one of these parameters was typed: it would be ignored.

    One that the environment sets may be meant for other commands.
    """
    from tsfusion.errors import InvalidConfig

    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if parameter.name in names and source is not None and source.name == "COMMANDLINE":
            raise InvalidConfig(f"{parameter.opts[0]} {reason}")


def configuration(file: Path | None, *, preset: dict[str, Any] | None = None, **flags: Any) -> "Config":
    """The file's settings (or the defaults) with every flag that was given on top.

    Args:
        preset: settings of the `volume` table that beat the defaults, and nothing else.
        flags: settings of the `volume` and `server` tables by name; None = not given.

    Raises:
        InvalidConfig: for a bad file or value.
    """
    from tsfusion import config

    loaded = config.load(file, **(preset or {}))
    volume, server = (
        {key: value for key, value in flags.items() if key in struct.__struct_fields__}
        for struct in (config.VolumeConfig, config.ServerConfig)
    )
    return config.Config(
        volume=config.override(loaded.volume, **volume),
        server=config.override(loaded.server, **server),
        client=loaded.client,
    )
