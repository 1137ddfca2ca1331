# SPDX-License-Identifier: MIT
"""Live sources by name.

Another package adds its own with an entry point of the group `tsfusion.sources`: a function that takes what
follows the colon (None without one) and keyword options, and returns a `Source`.
"""

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from tsfusion.core.errors import InvalidConfig, SourceError
from tsfusion.scanner.sources.source import Source

GROUP = "tsfusion.sources"

_FORMS = "realsense, realsense:SERIAL, realsense:FILE.db3, camera:NUMBER|DEVICE|URL|FILE, folder:PATH"


def is_live(spec: str) -> bool:
    """Whether `spec` names a live source, of tsfusion or an installed package; otherwise it is a path."""
    name = spec.partition(":")[0]
    return name in _OWN or name in _others()


def open_source(spec: str, **options: Any) -> Source:
    """Open `realsense[:SERIAL|FILE]`, `camera:PLACE`, `folder:PATH` or an installed package's `name[:…]`.

    Args:
        options: as the source's class takes them; those that are None are left to it.

    Raises:
        InvalidConfig: no such source, or it takes no such option.
        SourceError: it cannot be opened.
        MissingDependency: its optional package is not installed.
    """
    name, _, rest = spec.partition(":")
    others = _others()
    if name in _OWN:
        opener = _OWN[name]()
    elif name in others:
        opener = _loaded(others[name])
    else:
        there = "".join(f", {other}" for other in sorted(others))
        raise InvalidConfig(f"source must be one of {_FORMS}{there}, got {spec!r}")
    given = {key: value for key, value in options.items() if value is not None}
    takes = inspect.signature(opener).parameters.values()
    names = [each.name for each in takes if each.kind is each.KEYWORD_ONLY]
    unknown = [key for key in given if key not in names]
    if unknown and not any(each.kind is each.VAR_KEYWORD for each in takes):
        raise InvalidConfig(f"source {name} takes no {', '.join(unknown)}; it takes {', '.join(names)}")
    source: Source = opener(rest or None, **given)
    return source


def _realsense() -> Callable[..., Source]:
    from tsfusion.scanner.sources.realsense import RECORDINGS, RealSense

    def opener(rest: str | None, **options: Any) -> Source:
        if rest is not None and rest.endswith(RECORDINGS):
            return RealSense(recording=rest, **options)
        return RealSense(rest, **options)

    return _like(opener, RealSense)


def _camera() -> Callable[..., Source]:
    from tsfusion.scanner.sources.stereo_video import StereoVideo

    return _like(lambda rest, **options: StereoVideo("0" if rest is None else rest, **options), StereoVideo)


def _folder() -> Callable[..., Source]:
    from tsfusion.scanner.sources.watched_folder import WatchedFolder

    def opener(rest: str | None, **options: Any) -> Source:
        if rest is None:
            raise SourceError("folder needs the path of one: folder:PATH")
        return WatchedFolder(rest, **options)

    return _like(opener, WatchedFolder)


_OWN: dict[str, Callable[[], Callable[..., Source]]] = {
    "realsense": _realsense,
    "camera": _camera,
    "folder": _folder,
}


def _like(opener: Callable[..., Source], source: Callable[..., Any]) -> Callable[..., Source]:
    """Give an opener the signature of the source's class, whose options it takes."""
    opener.__signature__ = inspect.signature(source)  # type: ignore[attr-defined]
    return opener


def _others() -> dict[str, EntryPoint]:
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def _loaded(entry: EntryPoint) -> Callable[..., Source]:
    try:
        opener: Callable[..., Source] = entry.load()
    except (ImportError, AttributeError) as error:
        raise SourceError(f"source {entry.name} ({entry.value}) cannot be loaded: {error}") from error
    return opener
