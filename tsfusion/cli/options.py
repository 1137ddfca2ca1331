# SPDX-License-Identifier: MIT
"""Define flags that several verbs share, and make the configuration from flags and files.

A flag beats its environment variable, which beats the file, which beats the
default in `tsfusion.core.config`.
"""

import functools
import inspect
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from tsfusion.cli import output, verbs

if TYPE_CHECKING:
    from tsfusion.core.config import ClientConfig, Config, ServerConfig, VolumeConfig
    from tsfusion.geometry.up_direction import Up


def option(
    flag: str, metavar: str | None, help_: str, *, panel: str | None = None, rare: bool = False, **more: Any
) -> Any:
    """Define a flag. Only `--help-all` shows a rare flag."""
    return typer.Option(flag, metavar=metavar, rich_help_panel=panel, help=help_, hidden=rare, **more)


_map_option = functools.partial(option, panel="Map")

# By name: a setting of the `volume` table, or a flag that `configuration` turns into such settings.
MAP_OPTIONS: dict[str, Any] = {
    "voxel_size": Annotated[float | None, _map_option(
        "--voxel-size", "METRES", "Edge of a voxel (0.02; LiDAR, street 0.1).")],
    "sensor": Annotated[str | None, _map_option(
        "--sensor", "NAME", "kinect/tof/realsense/stereo/lidar/scanner.",
        autocompletion=lambda: ["kinect", "tof", "realsense", "stereo", "lidar", "scanner"])],
    "max_range": Annotated[float | None, _map_option(
        "--max-range", "METRES", "Leave out measurements farther away.")],
    "min_weight": Annotated[float | None, _map_option(
        "--min-weight", "COUNT", "Full-confidence samples that mesh a voxel.")],
    "space_carving": Annotated[bool | None, _map_option(
        "--space-carving/--no-space-carving", None, "Clear voxels that rays pass: no ghosts.")],
    "regularizer": Annotated[str | None, _map_option(
        "--regularizer", "MODE", "Smoothing along each ray: off, paper (as published) or ray.", rare=True)],
    "surface": Annotated[str | None, _map_option(
        "--surface", "MODE", "Surface to mesh: raw, or smoothed: normal, field.", rare=True)],
    "lambda_": Annotated[float | None, _map_option(
        "--lambda", "NUMBER", "Strength of the smoothing along rays and of the field; 0 = none.", rare=True)],
    "truncation": Annotated[float | None, _map_option(
        "--truncation", "VOXELS", "Half-width of every ray's band, instead of 3 sigma of its noise.",
        rare=True)],
    "support": Annotated[str | None, _map_option(
        "--support", "LEAST:MOST", "Voxels that a ray reaches before its end, at least and at most, such "
        "as 3:6; a third number: at least behind its end (::16 sets that alone).", rare=True)],
    "arch": Annotated[str | None, _map_option(
        "--arch", "NAME", "Fuse on cpu, cuda or vulkan; on the CPU where that is missing.", rare=True,
        autocompletion=lambda: ["cpu", "cuda", "vulkan", "metal"])],
    "threads": Annotated[int | None, _map_option(
        "--threads", "N", "Threads of the kernels; default: all cores. Results do not depend on it.",
        rare=True)],
}  # fmt: skip
VIEW_OPTIONS = ("min_weight", "surface", "lambda_", "threads")  # flags that do not change the stored map


def takes_map_settings(verb: Callable[..., Any], also: dict[str, Any] | None = None) -> Callable[..., Any]:
    """Add each of `MAP_OPTIONS` and `also` as a flag for Typer to a verb that ends with `**settings`."""
    signature = inspect.signature(verb)
    own = [p for p in signature.parameters.values() if p.kind is not p.VAR_KEYWORD]
    added = {**(also or {}), **MAP_OPTIONS, "help_all": verbs.HelpAll}
    shared = [
        inspect.Parameter(
            name, inspect.Parameter.KEYWORD_ONLY, default=_DEFAULTS.get(name), annotation=option
        )
        for name, option in added.items()
    ]
    verb.__signature__ = signature.replace(parameters=[*own, *shared])  # type: ignore[attr-defined]
    verb.__annotations__ |= added
    return verb


ConfigFile = Annotated[Path | None, option("--config", "FILE", "Settings in TOML (`tsfusion config dump`).")]
OutFlag = Annotated[
    Path | None,
    option("--out", "DIR", "Folder of results; default: a dated one."),
]
Overwrite = Annotated[
    bool, option("--overwrite", None, "Replace the results that --out holds already.", rare=True)
]
OverwriteMap = Annotated[bool, option("--overwrite", None, "Replace the map of that name.")]
StateFlag = Annotated[Path | None, option("--state", "DIR", "Keep the journal and the map here.")]
Connect = Annotated[str | None, option("--connect", "ADDRESS", "Send to this server; default: start one.")]
Control = Annotated[
    str | None,
    option("--control", "ADDRESS", "The server's control address; default: the next port.", rare=True),
]
Map = Annotated[str | None, option("--map", "NAME", "Name of the map; without it: default.")]
NewMap = Annotated[
    str | None,
    option("--map", "NAME", "Name of the map; auto = a new one."),
]
SameFrame = Annotated[
    bool, option("--same-frame", None, "The poses are in the frame of the existing map.", rare=True)
]
KeyFlag = Annotated[
    str | None,
    option("--key", "FILE", "This client's secret key, for a server with keys (`tsfusion keys`).", rare=True),
]
ServerKey = Annotated[
    str | None,
    option("--server-key", "FILE|KEY", "The server's public key: a file, or the 40 characters.", rare=True),
]
Json = Annotated[bool, option("--json", None, "Print JSON for a program to read.")]
ViewFlag = Annotated[
    str | None, option("--view", "[HOST:PORT]", "Show the map in a browser, while it grows.")
]
FoxgloveFlag = Annotated[
    str | None, option("--foxglove", "[HOST:PORT]", "Show the map in Foxglove, while it grows.")
]
RunJson = Annotated[bool, option("--json", None, "Print run.json, for a program to read.", rare=True)]

_rare_option = functools.partial(option, panel="Source", rare=True)

MaxFrames = Annotated[int | None, option("--max-frames", "N", "Stop after so many frames.", min=1)]
Start = Annotated[int, _rare_option("--start", "N", "Skip so many frames at the start.", min=0)]
Stride = Annotated[int, _rare_option("--stride", "N", "Take only every N-th frame.", min=1)]
Rate = Annotated[
    float | None,
    _rare_option("--rate", "HZ", "Play so many frames a second; default: as fast as possible.", min=1e-3),
]
TrajectoryFlag = Annotated[
    Path | None, option("--trajectory", "FILE", "Poses of another SLAM, as TUM or KITTI.")
]
OriginFlag = Annotated[
    str | None, _rare_option("--origin", "X,Y,Z|auto", "Whole metres to subtract from UTM or grid positions.")
]
Sequence = Annotated[str | None, _rare_option("--sequence", "NN", "KITTI: which sequence.")]
ModalityFlag = Annotated[str | None, _rare_option("--modality", "KIND", "KITTI: stereo or lidar.")]
DatasetOptions = Annotated[
    list[str] | None,
    option("--option", "KEY=VALUE", "Setting of a layout: depth_topic=/depth."),
]
Calibration = Annotated[
    Path | None, option("--calibration", "FILE", "Camera file, instead of the recording's.")
]
IntrinsicsFlag = Annotated[
    str | None, option("--intrinsics", "FX,FY,CX,CY", "Camera in pixels, not the recording's.")
]
Unpack = Annotated[bool, _rare_option("--unpack", None, "Unpack an archive beside itself.")]
UpDirection = Annotated[str | None, _map_option("--up", "AXIS", "Which way is up: z, -y, … or X,Y,Z.")]
KeepIslands = Annotated[
    bool | None,
    _map_option(
        "--keep-islands/--drop-islands", None,
        "Small loose pieces of the mesh; default: kept in PLY and OBJ, left out of GLB and pictures.",
        rare=True,
    ),
]  # fmt: skip

# By name: flags of a run's results, of a run, and of the recording that it takes
RESULT_OPTIONS: dict[str, Any] = {
    "out": OutFlag, "overwrite": Overwrite, "config": ConfigFile, "view": ViewFlag, "json": RunJson,
}  # fmt: skip
RECORDING_OPTIONS: dict[str, Any] = {
    "origin": OriginFlag, "sequence": Sequence, "modality": ModalityFlag, "calibration": Calibration,
    "intrinsics": IntrinsicsFlag, "option": DatasetOptions, "unpack": Unpack,
}  # fmt: skip
RUN_OPTIONS: dict[str, Any] = {
    **RESULT_OPTIONS, "state": StateFlag, "connect": Connect, "map_": NewMap, "same_frame": SameFrame,
    "control": Control, "key": KeyFlag, "server_key": ServerKey, **RECORDING_OPTIONS, "rate": Rate,
    "max_frames": MaxFrames, "start": Start, "stride": Stride, "up": UpDirection,
    "keep_islands": KeepIslands,
}  # fmt: skip
_DEFAULTS = dict.fromkeys(("overwrite", "json", "same_frame", "unpack"), False) | {"start": 0, "stride": 1}


def settings(flags: Mapping[str, Any]) -> dict[str, Any]:
    """Return the flags of a run that are also settings of a configuration file."""
    return {name: value for name, value in flags.items() if name not in RUN_OPTIONS or name == "origin"}


def recording_options(flags: Mapping[str, Any], **more: Any) -> dict[str, Any]:
    """Return the settings of a dataset that flags and `--option` give."""
    names = ("unpack", "sequence", "modality", "origin")
    given = {name: flags[name] for name in names} | more
    return dataset_options(flags["option"], **given, **camera(flags["intrinsics"], flags["calibration"]))


def is_typed(context: typer.Context, name: str) -> bool:
    """True if a parameter was typed; False for its default or an environment variable."""
    source = context.get_parameter_source(name)
    return source is not None and source.name == "COMMANDLINE"


def refuse(context: typer.Context, names: Collection[str], reason: str) -> None:
    """Raise InvalidConfig if one of these parameters was typed, because it would be ignored.

    A value from an environment variable is no error: it may be meant for other commands.
    """
    from tsfusion.core.errors import InvalidConfig

    for parameter in context.command.params:
        if parameter.name in names and is_typed(context, parameter.name or ""):
            raise InvalidConfig(f"{parameter.opts[0]} {reason}")


def configuration(file: Path | None, *, preset: dict[str, Any] | None = None, **flags: Any) -> "Config":
    """Return the file's settings (or the defaults), overridden by the flags that were given.

    Args:
        preset: settings of the `volume` table that override only the defaults.
        flags: settings of the `volume`, `server` and `scan` tables by name; None = not given.

    Raises:
        InvalidConfig: for a bad file or value.
    """
    from msgspec.structs import replace

    from tsfusion.core import config

    loaded = config.load(file, **(preset or {}))
    changed = {name: _with_flags(getattr(loaded, name), flags) for name in ("volume", "server", "scan")}
    changed["volume"].checked_model()
    return replace(loaded, **changed)


def _with_flags(table: Any, flags: Mapping[str, Any]) -> Any:
    """Return a table of settings, overridden by those flags that belong to it and are not None."""
    from tsfusion.core import config

    settings = {**flags, **_band(flags.get("truncation"), flags.get("support"))}
    if (smoothness := flags.get("lambda_")) is not None:
        settings |= {"smoothness": smoothness, "field_smoothness": smoothness}
    own = {key: value for key, value in settings.items() if key in table.__struct_fields__}
    return config.override(table, **own)


def configuration_for(
    recorded: str | None,
    file: Path | None,
    /,
    *,
    usual: Mapping[str, Any] | None = None,
    tell: bool = False,
    preset: dict[str, Any] | None = None,
    **flags: Any,
) -> "Config":
    """Return the configuration for a recording, which may name its sensor and other usual settings.

    Without such settings the voxel size is the usual one of the sensor.

    Args:
        recorded: name of the recording's sensor; None if the recording names none.
        usual: the recording's settings for the `volume` table; empty or None without any.
        tell: print a line if these settings or the sensor decide the voxel size.
        preset: see `configuration`; overrides the recording.
    """
    from tsfusion.core.config import USUAL_VOXEL_SIZES

    sensor, preset = ({} if recorded is None else {"sensor": recorded}), preset or {}
    plain, of = configuration(file, preset=sensor | preset, **flags), "this recording"
    if not usual and plain.volume.sensor in USUAL_VOXEL_SIZES:
        usual, of = {"voxel_size": USUAL_VOXEL_SIZES[plain.volume.sensor]}, f"a {plain.volume.sensor}"
    if not usual:
        return plain
    chosen = configuration(file, preset={**sensor, **usual, **preset}, **flags)
    if tell and chosen.volume.voxel_size != plain.volume.voxel_size:
        text = f"voxels: {chosen.volume.voxel_size:g} m, usual for {of} (--voxel-size gives others)"
        output.text(text, err=True, indent=8)
    return chosen


def own_volume(chosen: "Config", client: "ClientConfig", flags: Mapping[str, Any]) -> "VolumeConfig":
    """Return settings of the map of a run's own server: those of `[maps.NAME]`, if there are any.

    Args:
        flags: flags of the command line, which override them.
    """
    own = chosen.volumes().get(client.map)
    return chosen.volume if own is None else cast("VolumeConfig", _with_flags(own, flags))


def byte_count(text: str | None) -> int | None:
    """Return the number of bytes of `2GB`, `512MiB` or a plain number, or None for None.

    Raises:
        InvalidConfig: for anything else.
    """
    import re

    from tsfusion.core.errors import InvalidConfig

    if text is None:
        return None
    found = re.fullmatch(r"(\d+(?:\.\d+)?) ?(?:([kMGT])(i?)B?|B)?", text.strip(), re.IGNORECASE)
    if found is None:
        raise InvalidConfig(f"expected a number of bytes such as 2GB, 512MiB or 2000000000, got {text!r}")
    number, prefix, binary = found.groups()
    power = " kmgt".index(prefix.lower()) if prefix else 0
    return int(float(number) * (1024 if binary else 1000) ** power)


def up_direction(text: str | None) -> "Up | None":
    """Return the direction of --up, or None. Raise InvalidConfig for a bad value."""
    from tsfusion.geometry import up_direction

    return None if text is None else up_direction.parse(text)


def dataset_options(given: list[str] | None, **flags: Any) -> dict[str, Any]:
    """Return `flags` together with the `KEY=VALUE` settings of `--option`.

    A VALUE is a number, true, false or a list as in JSON; anything else is text.

    Args:
        flags: settings of the same dataset or source from other flags; None and False = not given.

    Raises:
        InvalidConfig: for a setting that is not `KEY=VALUE`, or is given by its flag, too.
    """
    import json

    from tsfusion.core.errors import InvalidConfig

    found: dict[str, Any] = {}
    for each in given or ():
        key, equals, value = each.partition("=")
        if not key.isidentifier() or not equals:
            raise InvalidConfig(f"--option must be KEY=VALUE, such as time_offset_s=0.02, got {each!r}")
        if flags.get(key) not in (None, False):
            raise InvalidConfig(f"--{key} and --option {key}=… exclude each other: give one of them")
        try:
            found[key] = json.loads(value)
        except (ValueError, RecursionError):
            found[key] = value
    return flags | {key: value for key, value in found.items() if value is not None}


def camera(intrinsics: str | None, calibration: Path | None) -> dict[str, Any]:
    """Return the camera's options of a dataset or a live source; None = not given.

    Raises:
        InvalidConfig: when these are not four numbers, or both are given.
    """
    from tsfusion.core.errors import InvalidConfig, InvalidKeyframe
    from tsfusion.geometry.keyframe import Intrinsics, check_intrinsics

    if intrinsics is None:
        return {"intrinsics": None, "calibration": calibration}
    if calibration is not None:
        raise InvalidConfig("--intrinsics and --calibration exclude each other: give one of them")
    try:
        numbers = [float(word) for word in intrinsics.replace(",", " ").split()]
        return {"intrinsics": check_intrinsics(Intrinsics(*numbers)), "calibration": None}
    except (ValueError, TypeError, InvalidKeyframe) as error:
        raise InvalidConfig(
            f"--intrinsics must be fx,fy,cx,cy in pixels, such as 585,585,320,240, got {intrinsics!r}"
        ) from error


def client_settings(config: "Config", connect: str | None = None, **flags: str | None) -> "ClientConfig":
    """Return the client's settings, overridden by flags. They have no keys for a run's own server."""
    from msgspec.structs import replace

    from tsfusion.core.config import override

    client = override(config.client, **flags)
    return client if connect is not None else replace(client, key=None, server_key=None)


# Settings that delete keyframes, or are for a disk that fills.
_OF_KEPT_MAPS = (
    "keep_seconds", "keep_keyframes", "keep_radius", "journal_bytes", "min_free_bytes", "cache",
)  # fmt: skip


def own_server(config: "Config", state: Path | None) -> "ServerConfig":
    """Return settings of a run's own server: only this machine reaches it, and its errors are shown here.

    Args:
        state: folder for its journals and maps; None to throw them away.
    """
    from msgspec.structs import replace

    from tsfusion.core.config import ServerConfig
    from tsfusion.pipelines.runs.target_server import MAPS, THROWN_AWAY

    server = config.server
    if state is None:  # a map made for this run keeps all of the recording
        usual = ServerConfig()
        server = replace(server, **{name: getattr(usual, name) for name in _OF_KEPT_MAPS})
    return replace(
        server, listen="tcp://127.0.0.1:0", state=THROWN_AWAY if state is None else str(state),
        max_maps=max(MAPS, config.server.max_maps), log_format="text",
        control=None, keys=None, metrics=None, directory=None, advertise=None,
    )  # fmt: skip


def only_for_kept_maps(state: Path | None) -> set[str]:
    """Return the parameters that have no effect on a run's own server if its maps are new."""
    return set() if state is not None else {"same_frame"}


def check_target_flags(
    context: typer.Context, connect: str | None, *, own: Collection[str], remote: Collection[str]
) -> None:
    """Raise InvalidConfig for a typed flag that would be ignored.

    Args:
        connect: address of a server elsewhere; None if the run starts its own.
        own: parameters for a run's own server.
        remote: parameters for a server elsewhere, besides those of the connection.
    """
    if connect is None:
        refuse(context, {"control", "key", "server_key", *remote}, "has no effect without --connect")
    else:
        reason = "has no effect with --connect: give it to the `tsfusion serve` that listens there"
        refuse(context, own, reason)


def _band(truncation: float | None, support: str | None) -> dict[str, float]:
    """Return the settings that --truncation or --support set."""
    from tsfusion.core.errors import InvalidConfig

    if truncation is not None and support is not None:
        raise InvalidConfig(
            "--truncation and --support exclude each other (the band is fixed, or bounded): give one of them"
        )
    if truncation is not None:
        if not 1 <= truncation <= 16:
            raise InvalidConfig(f"--truncation must be from 1 to 16 voxels, got {truncation:g}")
        return {"min_support": truncation, "max_support": truncation, "min_behind": truncation}
    if support is None:
        return {}
    names = "min_support", "max_support", "min_behind"
    try:
        numbers = support.split(":")
        if len(numbers) == 3 and any(numbers):  # an empty number leaves its setting unchanged
            return {name: float(number) for name, number in zip(names, numbers, strict=True) if number}
        return dict(zip(names[:2], map(float, numbers), strict=True))
    except ValueError as error:
        raise InvalidConfig(
            f"--support must be LEAST:MOST or LEAST:MOST:BEHIND a surface, voxels, as 3:6, got {support!r}"
        ) from error
