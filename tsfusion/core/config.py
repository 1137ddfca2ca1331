# SPDX-License-Identifier: MIT
"""Define every setting with its default, unit and bounds, and read settings from TOML files.

Nothing else in the package holds a default. A TOML file has one table for each struct (`[volume]`,
`[server]`, `[client]`, `[scan]`); unknown keys are errors.
"""

import inspect
import json
import math
import re
import sys
from collections.abc import Iterable
from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, TypedDict, TypeVar

import msgspec
import numpy as np
from msgspec import Meta, Struct

from tsfusion.core.errors import InvalidConfig, errors_as, refusals_as

if sys.version_info >= (3, 11):
    import tomllib
else:  # pragma: no cover
    import tomli as tomllib

Regularizer = Literal["off", "paper", "ray"]
Surface = Literal["raw", "normal", "field"]
Arch = Literal["cpu", "cuda", "vulkan", "metal"]
SensorName = Literal["kinect", "tof", "realsense", "stereo", "lidar", "scanner"]
Positive = Annotated[float, Meta(gt=0)]
NonNegative = Annotated[float, Meta(ge=0)]
Smoothness = Annotated[float, Meta(ge=0, le=1e9)]
LocalizerName = Literal["auto", "rgbd", "stereo", "lidar", "given", "trajectory", "feed"]
Policy = Literal["thin", "block", "drop_oldest", "spool_all"]
LogFormat = Literal["text", "json"]
LogLevel = Literal["debug", "info", "warning", "error"]
DEFAULT_MAP = "default"
SERVER_SESSION = b"tsfusion forgets"  # of the records in which a server forgets keyframes
MAP_NAME_LENGTH = 32
MAP_NAME = rf"[a-z0-9][a-z0-9_-]{{0,{MAP_NAME_LENGTH - 1}}}"
# Becomes a folder's name, so it is no path: \A and \Z, because `$` would let a newline through.
MapName = Annotated[str, Meta(pattern=rf"\A{MAP_NAME}\Z")]
# Of a key in the allow-list: a map, or all whose names begin so
MapPattern = Annotated[str, Meta(pattern=rf"\A({MAP_NAME}|({MAP_NAME})?\*)\Z")]
# A voxel nearly as large as the sensor's range shows nothing: so many must fit into it.
LEAST_VOXELS = 10
MOST_SAMPLES = 1 << 22  # full-confidence ones that a voxel can count
LEAST_VOXEL_SIZE = 0.00001  # metres: finer than any sensor
SYMMETRIC = 16.0  # `min_behind`, voxels: a ray reaches as far behind its end as before it
ClientName = Annotated[str, Meta(pattern=r"\A[A-Za-z0-9][A-Za-z0-9_.-]{0,31}\Z")]
Bytes = Annotated[int, Meta(ge=1 << 20)]
_INVERSE = "T_world_camera, its inverse: T_world_camera=np.linalg.inv({name})"
_POSE = "T_world_camera, which takes a point of the camera to the world"
OTHER_NAMES_OF_KEYFRAME = {
    **dict.fromkeys(("T_camera_world", "extrinsic", "extrinsics", "w2c", "world_to_camera"), _INVERSE),
    **dict.fromkeys(("pose", "T", "c2w", "camera_to_world", "transform", "T_world_sensor"), _POSE),
    **dict.fromkeys(("intrinsic", "K", "camera_matrix"), "intrinsics"),
    **dict.fromkeys(("rgb", "image", "colors"), "color, uint8 in the order BGR: color=rgb[..., ::-1]"),
    **dict.fromkeys(("scan", "cloud", "xyz"), "points, in the sensor's frame"),
    **dict.fromkeys(("timestamp", "stamp"), "timestamp_ns, an integer of nanoseconds"),
    **dict.fromkeys(("depth_max", "depth_trunc"), "max_range, a setting of Volume"),
}
_BAND = "min_support=N, max_support=N with N = sdf_trunc / voxel_size; by default the sensor's noise decides"
OTHER_NAMES_OF_SETTINGS = {
    **dict.fromkeys(("sdf_trunc", "truncation", "trunc_voxel_multiplier"), _BAND),
    **dict.fromkeys(("voxel_length", "resolution"), "voxel_size, in metres"),
    **dict.fromkeys(("depth_max", "depth_trunc"), "max_range, in metres"),
    **dict.fromkeys(("color_type", "attr_names"), "color=True or color=False"),
    **dict.fromkeys(("block_count", "block_resolution"), "nothing: blocks are added by need"),
    "device": "arch: cpu, cuda or vulkan",
}
_MESH = "extract_mesh(), whose result has vertices, faces and save('room.glb')"
OTHER_NAMES_OF_VOLUME = {
    **dict.fromkeys(("extract_triangle_mesh", "extract_surface_mesh", "get_mesh"), _MESH),
    **dict.fromkeys(("extract_point_cloud", "extract_voxel_point_cloud"), "extract_mesh().vertices"),
    **dict.fromkeys(("extract_vdb_grids", "write", "dump"), "save('map.tsf')"),
    **dict.fromkeys(("fuse", "add", "update", "insert", "push"), "integrate(keyframe)"),
    "prune": "extract_mesh(min_weight=…)",
    "reset": "a new Volume",
    "voxel_size": "config.voxel_size",
}


class Settings(Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Base of all settings: no infinity and no NaN, though both are legal TOML."""

    def __post_init__(self) -> None:
        for key in self.__struct_fields__:
            value = getattr(self, key)
            if isinstance(value, float) and not math.isfinite(value):
                raise ValueError(f"{key} must be finite, got {value}")


class SensorModel(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Depth noise of a sensor, and the settings that suit it.

    σ(z) = sigma_floor + sigma_slope · (z − sigma_z0)², metres; z = depth along the optical axis
    (ray length for points). With a known baseline·fx, `disparity_sigma` px replaces the slope:
    σ(z) = sigma_floor + disparity_sigma · z² / baseline_fx.
    A ray begins `3 σ(z)` before its end, held between `min_support` and `max_support` voxels: its support. It
    reaches `3 σ(z)` behind it, at least `min_behind` voxels and at most its support.
    """

    sigma_floor: NonNegative
    sigma_slope: NonNegative = 0.0
    sigma_z0: float = 0.0
    disparity_sigma: NonNegative = 0.0
    min_range: NonNegative = 0.1
    max_range: Positive = 10.0
    min_support: Annotated[float, Meta(ge=1, le=16)] = 3.0
    max_support: Annotated[float, Meta(ge=1, le=16)] = 6.0
    min_behind: Annotated[float, Meta(ge=1, le=16)] = 1.5
    regularizer: Regularizer = "off"
    smoothness: Smoothness = 1.0
    feedback: bool = False
    min_weight: NonNegative = 0.25
    surface: Surface = "field"
    field_smoothness: Smoothness = 30.0
    field_edge: Positive = 0.05
    field_reweightings: Annotated[int, Meta(ge=0, le=16)] = 3


# Kinect v1: Nguyen, Izadi and Lovell 2012 (axial noise). Stereo: Δz = z² Δd / (b·f). Streets are seen at
# grazing angles, where a band along the ray is thin across the surface: stereo and LiDAR need longer ones
# (KITTI 06 at 15 cm: with 3 voxels the road has slits, with 6 it has none).
SENSORS: dict[str, SensorModel] = {
    "kinect": SensorModel(sigma_floor=0.0012, sigma_slope=0.0019, sigma_z0=0.4, max_range=5.0),
    "tof": SensorModel(sigma_floor=0.0015, sigma_slope=0.0005, max_range=8.0),
    "realsense": SensorModel(sigma_floor=0.001, sigma_slope=0.0025, disparity_sigma=0.08, max_range=6.0),
    "stereo": SensorModel(
        sigma_floor=0.005,
        sigma_slope=0.0026,
        disparity_sigma=0.5,
        min_range=0.3,
        max_range=30.0,
        min_support=6.0,
        max_support=10.0,
        smoothness=10.0,
        feedback=True,
        min_weight=0.5,
        field_smoothness=1000.0,
        field_reweightings=4,
    ),
    "lidar": SensorModel(
        sigma_floor=0.02, min_range=1.0, max_range=100.0, min_support=4.0, min_behind=SYMMETRIC
    ),
    "scanner": SensorModel(sigma_floor=0.0002, min_range=0.0, max_range=100.0),
}
# Metres, of the maps that commands make where nobody says; with another sensor `VolumeConfig`'s. Points of a
# LiDAR are decimetres apart: between them, voxels of 2 cm are unseen, and a map of them has no surface.
USUAL_VOXEL_SIZES = {"lidar": 0.1}


class VolumeConfig(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """The map and how keyframes enter it. None = what the sensor preset says.

    `tsfusion config dump` and the page of settings have every field with its unit, default and bounds.

    Examples:
        >>> config = tsfusion.VolumeConfig(voxel_size=0.05, sensor="lidar", max_range=40.0)
        >>> tsfusion.Volume(config).config.voxel_size
        0.05
    """

    voxel_size: Positive = 0.02  # metres
    sensor: SensorName = "kinect"
    regularizer: Regularizer | None = None
    smoothness: Smoothness | None = None  # λ of eq. 3
    min_support: Annotated[float, Meta(ge=1, le=16)] | None = None  # voxels
    max_support: Annotated[float, Meta(ge=1, le=16)] | None = None  # voxels
    min_behind: Annotated[float, Meta(ge=1, le=16)] | None = None  # voxels; 16 = as far as min_support says
    min_range: NonNegative | None = None  # metres
    max_range: Positive | None = None  # metres
    min_weight: Annotated[float, Meta(ge=0, le=MOST_SAMPLES)] | None = (
        None  # full-confidence samples a voxel needs to be meshed
    )
    feedback: bool | None = None  # smooth the smoothed values again (recursion) or the raw ones
    surface: Surface | None = None  # what is meshed: values as fused, smoothed along normals, or the field
    field_smoothness: Smoothness | None = None  # λ of the field, against full-confidence samples
    field_edge: Positive | None = None  # voxels; a field that bends more than this counts as an edge
    field_reweightings: Annotated[int, Meta(ge=0, le=16)] | None = None
    bundle: bool = True  # rays of a neighbourhood that end in one voxel become one
    outlier_filter: bool = True  # drop pixels that no neighbour supports: flying pixels, speckle
    space_carving: bool = False  # the free space before the band gets votes, too
    color: bool = True
    threads: Annotated[int, Meta(ge=1, le=256)] | None = None  # None = all cores
    arch: Arch = "cpu"  # where keyframes are fused: on a device, and on the CPU where that is not there
    max_blocks: Annotated[int, Meta(ge=1, le=4_000_000)] = 4_000_000
    max_blocks_per_keyframe: Annotated[int, Meta(ge=1, le=1 << 19)] = 1 << 17

    @property
    def counts_hits(self) -> bool:
        """True if a voxel counts the rays that end in it, even those without a colour.

        Otherwise many rays that pass a thin object would give its voxel the mean distance of free space.
        """
        return self.space_carving or self.sensor == "lidar"

    def model(self, sensor: str | None = None) -> SensorModel:
        """Return the sensor model of a keyframe, changed by the settings of this config.

        `sensor`: name of the keyframe's sensor preset; None = the map's. Raises InvalidConfig for an unknown
        name.
        """
        name = sensor or self.sensor
        if name not in SENSORS:
            raise InvalidConfig(f"sensor must be one of {', '.join(SENSORS)}, got {name!r}")
        chosen = {
            key: value
            for key in SensorModel.__struct_fields__
            if (value := getattr(self, key, None)) is not None
        }
        return msgspec.structs.replace(SENSORS[name], **chosen)

    def checked_model(self) -> SensorModel:
        """Return the sensor model of the map, after a check that the settings fit each other.

        Raises InvalidConfig for ranges in the wrong order, or for too large voxels.
        """
        model = self.model()
        if model.min_range >= model.max_range:
            raise InvalidConfig(
                f"max_range must be larger than min_range, {model.min_range:g} m, got {model.max_range:g} m"
            )
        if model.min_support > model.max_support:
            raise InvalidConfig(
                f"max_support must be at least min_support, {model.min_support:g} voxels, got "
                f"{model.max_support:g}"
            )
        if self.voxel_size < LEAST_VOXEL_SIZE:
            raise InvalidConfig(
                f"voxel_size must be at least {LEAST_VOXEL_SIZE} m, got {self.voxel_size:g}: it is in metres"
            )
        if self.voxel_size * LEAST_VOXELS > model.max_range:
            raise InvalidConfig(
                f"voxel_size {self.voxel_size:g} m is too large for max_range {model.max_range:g} m: at "
                f"least {LEAST_VOXELS} voxels must fit into it; 0.02 m suits a room, 0.1 m a street"
            )
        return model


# Settings of a map that change nothing stored in it (smoothness: unless it smooths along rays): a saved one
# can be read with others.
VIEW_SETTINGS = (
    "min_weight",
    "surface",
    "smoothness",
    "field_smoothness",
    "field_edge",
    "field_reweightings",
)
# Settings of how keyframes are fused that change nothing stored: a saved map goes on with others.
RUN_SETTINGS = ("threads", "arch")
# Settings of a map that limit how it grows: a saved one goes on with others.
LIMIT_SETTINGS = ("max_blocks", "max_blocks_per_keyframe")


class LoadSettings(TypedDict, total=False):
    """Names and types of the settings that may change when a saved map is opened, for type checkers."""

    min_weight: float | None
    surface: Surface | None
    smoothness: float | None
    field_smoothness: float | None
    field_edge: float | None
    field_reweightings: int | None
    arch: str
    max_blocks: int
    max_blocks_per_keyframe: int


class VolumeSettings(LoadSettings, total=False):
    """Names and types of all settings of `VolumeConfig`, for type checkers."""

    voxel_size: float
    sensor: str  # as of a `Dataset`
    regularizer: Regularizer | None
    min_support: float | None
    max_support: float | None
    min_behind: float | None
    min_range: float | None
    max_range: float | None
    feedback: bool | None
    bundle: bool
    outlier_filter: bool
    space_carving: bool
    color: bool
    threads: int | None


class CacheConfig(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the files that hold a map's blocks if not all of them fit into memory."""

    folder: str  # on a disk; the files have no names there
    disk_bytes: Bytes = 1 << 50  # that the blocks may take
    min_free_bytes: Annotated[int, Meta(ge=0)] = 64 << 20  # left free on the disk


class ServerConfig(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of the server daemon."""

    is_private: ClassVar[bool] = False  # it serves one verb
    listen: str = "tcp://127.0.0.1:5555"
    control: str | None = None  # None = the port after `listen`'s
    state: str = "tsfusion-state"  # folder: maps/NAME/journal/, maps/NAME/map.tsf
    keys: str | None = None  # folder of `tsfusion keys`; None = no keys, reachable from this machine only
    max_maps: Annotated[int, Meta(ge=1, le=64)] = 4  # open at the same time; each has a fuser process
    spare_fusers: Annotated[int, Meta(ge=0, le=16)] = (
        0  # that wait for maps, some 200 MB each; they open at once
    )
    directory: str | None = None  # SQLite file in which servers write who has which map; None = one server
    advertise: str | None = None  # address by which clients reach this server; None = `listen`'s
    metrics: str | None = None  # loopback address of Prometheus' page and health checks: 127.0.0.1:9464
    max_frame_bytes: Annotated[int, Meta(ge=1024, le=32 << 20)] = 32 << 20  # the fuser takes no larger one
    segment_bytes: Annotated[int, Meta(ge=1 << 16)] = 256 << 20
    window_keyframes: Annotated[int, Meta(ge=1, le=1024)] = 8  # credit: unacknowledged keyframes a client
    window_bytes: Annotated[int, Meta(ge=1 << 16)] = 16 << 20
    checkpoint_every: Annotated[int, Meta(ge=0)] = 500  # keyframes; 0 = only at shutdown
    mesh_interval: NonNegative = 0.2  # seconds between two meshes for viewers while busy
    journal_bytes: Bytes | None = None  # per map; the oldest keyframes are deleted first; None = keep all
    # Of each map, against its newest keyframe, whoever sent it; what is beyond is forgotten. None = keep all
    keep_seconds: Positive | None = None  # from a keyframe's coming to the newest one's
    keep_keyframes: Annotated[int, Meta(ge=1)] | None = None  # the newest ones
    keep_radius: Positive | None = None  # metres from the sensor of the newest one
    min_free_bytes: Annotated[int, Meta(ge=0)] = 64 << 20  # left free on the disk; keyframes wait for that
    quarantine_bytes: Bytes = 256 << 20  # per map; keyframes that could not be fused, the newest ones
    memory_bytes: Bytes = 512 << 20  # of the gateway; near it, connections are cut off, then all of them
    fuser_memory_bytes: Annotated[int, Meta(ge=1 << 28)] | None = (
        None  # of each fuser; None = three quarters of the machine's
    )
    fuser_disk_bytes: Bytes | None = (
        None  # of each map's blocks that may wait on the disk beyond that; None = none, the map is full then
    )
    cache: str | None = None  # folder where they wait, on a disk of this machine; None = the map's own
    fuser_timeout: Positive = 60.0  # seconds on one keyframe before a fuser counts as stuck
    quota_bytes: Bytes = 256 << 20  # a second, of each client
    quota_keyframes: Positive = 1000.0  # a second, of each client
    quota_points: Annotated[int, Meta(ge=1)] = 8 << 20  # points or pixels a keyframe
    quota_questions: Positive = 200.0  # to the map, a second, of each client
    # What the rays of a keyframe may cost, in voxels that they cross; five times those of a ray away from the
    # one before it. Six times what the densest recordings need, a second and a half of one core
    quota_cost: Annotated[int, Meta(ge=1)] = 50_000_000
    quota_map: Annotated[float, Meta(gt=0, le=1)] = 0.75  # share of a map's room for each client with a key
    quota_extent: Positive = 100_000.0  # metres from the map's origin to a sensor
    log_format: LogFormat = "text"  # on stderr: lines of text, or one JSON object a line
    log_level: LogLevel = "info"  # less important lines are left out


class ClientConfig(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a client: how a scanner sends its keyframes to a server."""

    address: str = "tcp://127.0.0.1:5555"
    control: str | None = None
    map: MapName = DEFAULT_MAP
    key: str | None = None  # own secret key, a file of `tsfusion keys new`; None = no keys
    server_key: str | None = None  # the server's public key: a file, or the 40 characters
    policy: Policy = "thin"  # when keyframes come faster than the server takes them
    catch_up: Positive = 120.0  # seconds that the map may be behind before `thin` leaves keyframes out
    backlog: Annotated[int, Meta(ge=1, le=10_000)] = 8  # keyframes behind: `block` waits, `drop_oldest` drops
    spool_bytes: Bytes = 8 << 30  # on the disk; when they are full, keyframes are skipped and counted
    min_free_bytes: Annotated[int, Meta(ge=0)] = 64 << 20  # left free on the spool's disk
    jpeg_quality: Annotated[int, Meta(ge=1, le=100)] = 90
    segment_bytes: Annotated[int, Meta(ge=1 << 16)] = 64 << 20
    connect_timeout: Positive = 10.0  # seconds
    stall_timeout: Positive = 2.0  # seconds without progress before everything unacknowledged is resent


class ScanConfig(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """Settings of a scanner: how it finds poses, and which frames become keyframes."""

    localizer: LocalizerName = "auto"  # auto: by what the source gives
    trajectory: str | None = None  # for the localizer `trajectory`: a TUM or KITTI file
    origin: str | None = None  # what is taken off positions in a national grid: X,Y,Z; None = as needed
    feed: str | None = None  # for the localizer `feed`: address where another process publishes poses
    max_gap: Positive = 0.2  # seconds between two given poses; across a longer gap there is none
    time_offset: float = 0.0  # seconds to add to a frame's time before its pose is looked up
    loop_closure: bool = True  # recognise places seen before, and correct the poses since then
    min_overlap: Annotated[float, Meta(ge=0, le=1)] = 0.8  # with the last keyframe; with less: a new one
    distance: Positive | None = None  # metres to the next keyframe; None = 0.1, for stereo and LiDAR 2
    angle: Positive = 10.0  # degrees to the next keyframe
    max_rate: Positive | None = None  # keyframes a second, at most
    patience: NonNegative = 1.0  # seconds lost before a new submap begins


class Config(Settings, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """A whole configuration file: `volume`, `server`, `client`, `scan`, and `maps` by name.

    Examples:
        >>> from tsfusion.core import config
        >>> everything = config.load(None)  # or a file; None gives the defaults
        >>> everything.volume.voxel_size  # metres
        0.02
    """

    volume: VolumeConfig = VolumeConfig()
    server: ServerConfig = ServerConfig()
    client: ClientConfig = ClientConfig()
    scan: ScanConfig = ScanConfig()
    maps: dict[MapName, dict[str, Any]] = {}  # [maps.NAME]: what differs there from [volume]

    def volumes(self) -> dict[str, VolumeConfig]:
        """Return the settings of each map that has a `[maps.NAME]` table. Raises InvalidConfig, naming it."""
        found = {}
        for name, settings in self.maps.items():
            with errors_as(InvalidConfig, f"[maps.{name}]", InvalidConfig):
                found[name] = override(self.volume, **settings)
        return found


# --- settings from names and values ---

AnyStruct = TypeVar("AnyStruct", bound=Struct)


def make_settings(struct: type[AnyStruct], settings: dict[str, Any]) -> AnyStruct:
    """Build a config struct after checks of names, types and bounds. Raises InvalidConfig, naming the key."""
    plain = {key: v.item() if isinstance(v, np.generic) else v for key, v in settings.items()}
    try:
        return msgspec.convert(plain, struct)
    except msgspec.ValidationError as error:
        raise InvalidConfig(_message(struct, plain, str(error))) from error


def override(config: AnyStruct, **changes: Any) -> AnyStruct:
    """Return the settings with the new values that are not None, checked as in `make_settings`."""
    settings = msgspec.structs.asdict(config)
    settings.update({key: value for key, value in changes.items() if value is not None})
    return make_settings(type(config), settings)


_KINDS = {
    "float": "a number",
    "int": "a whole number",
    "str": "text",
    "bool": "true or false",
    "object": "a table",
}
_NAME = "1 to 32 of a-z, 0-9, - and _, a letter or digit first"  # MapName, the one pattern in a configuration


def _message(struct: type[Struct], settings: dict[str, Any], problem: str) -> str:
    """Return an error of msgspec in plain words: `volume.voxel_size must be > 0, got -0.05`."""
    if "at `key` in `$.maps`" in problem:
        name = next(name for name in settings["maps"] if not re.fullmatch(MAP_NAME, name))
        return f"maps: a map's name must be {_NAME}, got {name!r}"
    problem, _, place = problem.partition(" - at `$.")
    *tables, key = place.rstrip("`").split(".")
    if unknown := re.search(r"unknown field `(.+)`", problem):
        where = place.rstrip("`")
        for table in filter(None, where.split(".")):
            struct = struct.__annotations__[table]
        known = struct.__struct_fields__
        hint = instead(unknown[1], OTHER_NAMES_OF_SETTINGS, known)
        hint = hint or f"; known are {', '.join(known)}"
        return f"unknown setting {'.'.join(filter(None, (where, unknown[1])))}{hint}"
    wanted = re.match(
        r"Expected `(\w+)[^`]*`(?: ([<>]=? \S+?)(?:\.0)?)?(?:,|$)|Invalid enum|.* matching regex", problem
    )
    if wanted is None:
        return problem
    value: Any = settings
    for table in tables:
        struct, value = struct.__annotations__[table], value[table]
    words = ", ".join(re.findall(r"(?<!class )'(\w+)'", str(struct.__annotations__[key])))
    must_be = f"one of {words}" if words else wanted[2] or _KINDS.get(wanted[1], wanted[1]) or _NAME
    return f"{'.'.join((*tables, key))} must be {must_be}, got {value[key]!r}"


# --- TOML ---


def load(path: str | Path | None, **volume: Any) -> Config:
    """Read a TOML file; None gives the defaults. `volume`: settings of the map that apply if the file does
    not name them.

    Raises InvalidConfig for a missing file, bad TOML, an unknown key or a bad value.
    """
    if path is None:
        return Config(volume=make_settings(VolumeConfig, volume))
    advice = "`tsfusion config dump` writes one"
    with refusals_as(InvalidConfig, f"cannot read the configuration {path}", advice):
        content = Path(path).read_bytes()
    try:
        tables = tomllib.loads(content.decode("utf-8-sig"))
    except (ValueError, RecursionError) as error:  # also too many digits, or too deep
        raise InvalidConfig(
            f"{path} is not TOML: {error}; `tsfusion config dump` shows what one looks like"
        ) from error
    if isinstance(given := tables.get("volume", {}), dict):
        tables["volume"] = {**volume, **given}
    with errors_as(InvalidConfig, path, InvalidConfig, RecursionError):
        made = make_settings(Config, tables)
        made.volumes()
        return made


def to_toml(config: Config) -> str:
    """Return TOML that `load` reads back as an equal Config; settings at None are commented out."""
    tables = [_toml_table(name, getattr(config, name)) for name in ("volume", "server", "client", "scan")]
    for name, settings in config.maps.items():
        lines = (f"{key} = {_toml_value(value)}\n" for key, value in settings.items())
        tables.append("".join((f"[maps.{name}]\n", *lines)))
    return "\n".join(tables)


def _toml_table(name: str, struct: Struct) -> str:
    """Return one `[name]` table: a line for each setting, with its bounds and meaning."""
    summary = inspect.cleandoc(type(struct).__doc__ or "").splitlines()[0]
    lines = [f"# {summary}", f"[{name}]"]
    comments = _field_comments(type(struct))
    for field in msgspec.inspect.type_info(type(struct)).fields:  # type: ignore[attr-defined]
        value = getattr(struct, field.name)
        setting = f"# {field.name} =" if value is None else f"{field.name} = {_toml_value(value)}"
        notes = [note for note in (_bounds(field.type), comments.get(field.name)) if note]
        lines.append(setting + (f"  # {'; '.join(notes)}" if notes else ""))
    return "\n".join(lines) + "\n"


def _toml_value(value: Any) -> str:
    if isinstance(value, float):
        return repr(value)
    return json.dumps(value, ensure_ascii=False)  # booleans, integers and strings are written alike


def _bounds(kind: msgspec.inspect.Type) -> str:
    if isinstance(kind, msgspec.inspect.UnionType):
        return "; ".join(note for note in map(_bounds, kind.types) if note)
    if isinstance(kind, msgspec.inspect.LiteralType):
        return " | ".join(map(str, kind.values))
    signs = {"gt": ">", "ge": "≥", "lt": "<", "le": "≤"}
    bounds = [
        f"{sign} {getattr(kind, name)}"
        for name, sign in signs.items()
        if getattr(kind, name, None) is not None
    ]
    return ", ".join(bounds)


# A long line as the formatter breaks it: the value and its comment in brackets of their own.
_WRAPPED_FIELD = re.compile(r"= \(\n +(.+)\n +\)$", re.MULTILINE)
_FIELD = re.compile(r"^    (\w+): .*?(?:  # (?P<comment>.+))?$")


def _field_comments(struct: type[Struct]) -> dict[str, str]:
    """Return the comment beside each field in the source of a struct: `to_toml` explains settings by it."""
    try:
        source = inspect.getsource(struct)
    except OSError:  # installed without sources
        return {}
    matches = filter(None, map(_FIELD.match, _WRAPPED_FIELD.sub(r"= \1", source).splitlines()))
    return {match[1]: match["comment"] for match in matches if match["comment"]}


def instead(name: str, others: dict[str, str], known: Iterable[str]) -> str:
    """Return a hint that ends an error about an unknown name: the name to write, or empty if none is near."""
    if name in others:
        return f": write {others[name].format(name=name)}"
    close = get_close_matches(name, known, n=1)
    return f": did you mean {close[0]}?" if close else ""
