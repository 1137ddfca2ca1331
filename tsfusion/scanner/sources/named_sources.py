# SPDX-License-Identifier: MIT
"""Open live sources by name.

Another package adds a source with an entry point of the group `tsfusion.sources`. The entry point is a
function that returns a `Source`. It takes the text after the colon (None without a colon) and keyword
options.
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint, entry_points

from tsfusion.core import plugins
from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.scanner.sources.source import Source

GROUP = "tsfusion.sources"

# Name → module of this package, and class
_BUILT_IN = {
    "realsense": "realsense:RealSense",
    "oak": "depth_cameras:OakD",
    "orbbec": "depth_cameras:Orbbec",
    "camera": "stereo_video:StereoVideo",
    "folder": "watched_folder:WatchedFolder",
    "ros2": "ros2_topics:Ros2Topics",
}
_FORMS = (
    "realsense, realsense:SERIAL, realsense:FILE.db3, oak[:SERIAL|ADDRESS], orbbec[:SERIAL], "
    "camera:NUMBER|DEVICE|URL|FILE, folder:PATH, ros2"
)


def is_live(spec: str) -> bool:
    """Return True if `spec` names a live source of tsfusion or of an installed package, False for a path."""
    name = spec.partition(":")[0]
    return name in _BUILT_IN or name in entry_points(group=GROUP).names


def open_source(spec: str, /, **options: object) -> Source:
    """Open `realsense`, `oak`, `orbbec`, `camera`, `folder`, `ros2` or a package's source: `name[:PLACE]`.

    Args:
        spec: name and address of the source, as for `tsfusion scan`.
        options: keyword arguments of the source's class; None means the default of the class.

    Raises:
        InvalidConfig: there is no such source, or it has no such option, or an option has the wrong type.
        SourceError: the source cannot be opened.
        MissingDependency: the source's optional package is not installed.

    Examples:
        >>> with tsfusion.open_source("folder:incoming", idle=0.1) as source:  # or "realsense", "camera:0"
        ...     kinds = [frame.kind for frame in source]
        >>> kinds
        ['depth']
    """
    name, _, place = spec.partition(":")
    others = entry_points(group=GROUP)
    if name in _BUILT_IN:
        point = EntryPoint(name, f"{__package__}.{_BUILT_IN[name]}", GROUP)
    elif name in others.names:
        point = others[name]
    else:
        there = "".join(f", {other}" for other in sorted(others.names))
        raise InvalidConfig(f"source must be one of {_FORMS}{there}, got {spec!r}")
    if name == "folder" and not place:
        raise SourceError("folder needs the path of one: folder:PATH")
    source: Callable[..., Source] = partial(plugins.load(point, SourceError), place or None)
    return plugins.call(source, options, name=f"source {name}", error=InvalidConfig)
