# SPDX-License-Identifier: MIT
"""Open live sources by name.

Another package adds a source with an entry point of the group `tsfusion.sources`. The entry point is a
function that returns a `Source`. It takes the text after the colon (None without a colon) and keyword
options.
"""

from collections.abc import Callable
from functools import partial
from importlib.metadata import entry_points

from tsfusion.core import plugins
from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.scanner.sources.source import Source

GROUP = "tsfusion.sources"

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
        source = _BUILT_IN[name](place or None)
    elif name in others.names:
        source = partial(plugins.load(others[name], SourceError), place or None)
    else:
        there = "".join(f", {other}" for other in sorted(others.names))
        raise InvalidConfig(f"source must be one of {_FORMS}{there}, got {spec!r}")
    return plugins.call(source, options, name=f"source {name}", error=InvalidConfig)


def _realsense(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.realsense import RECORDINGS, RealSense

    is_recording = place is not None and place.endswith(RECORDINGS)
    return partial(RealSense, None, recording=place) if is_recording else partial(RealSense, place)


def _oak(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.depth_cameras import OakD

    return partial(OakD, place)


def _orbbec(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.depth_cameras import Orbbec

    return partial(Orbbec, place)


def _camera(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.stereo_video import StereoVideo

    return partial(StereoVideo, "0" if place is None else place)


def _folder(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.watched_folder import WatchedFolder

    if place is None:
        raise SourceError("folder needs the path of one: folder:PATH")
    return partial(WatchedFolder, place)


def _ros2(place: str | None) -> Callable[..., Source]:
    from tsfusion.scanner.sources.ros2_topics import Ros2Topics

    return partial(Ros2Topics, place)


_BUILT_IN: dict[str, Callable[[str | None], Callable[..., Source]]] = {
    "realsense": _realsense,
    "oak": _oak,
    "orbbec": _orbbec,
    "camera": _camera,
    "folder": _folder,
    "ros2": _ros2,
}
