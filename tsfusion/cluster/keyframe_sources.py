# SPDX-License-Identifier: MIT
"""List the keyframes of journals (at final poses) and datasets, for other processes to read them."""

import hashlib
import logging
import os
import re
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tsfusion import journal
from tsfusion.cluster.jobs import DatasetKeyframes, JournalKeyframes, KeyframeList
from tsfusion.core.config import VolumeConfig
from tsfusion.core.durable_files import size_of
from tsfusion.core.errors import CheckpointError, DatasetError, InvalidConfig, JournalError, MapError
from tsfusion.core.output_folder import RECORD
from tsfusion.core.readable_numbers import OnProgress, count_of
from tsfusion.datasets import open_dataset
from tsfusion.datasets.cameras import camera_files
from tsfusion.datasets.dataset import Dataset, first_frame, pose_of
from tsfusion.datasets.layout_registry import sweep_doubt
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.keyframe_rows import square
from tsfusion.geometry.origin import world_of
from tsfusion.journal import locations, state_folder
from tsfusion.journal.journaled_keyframes import JournaledKeyframes
from tsfusion.tsdf.files import checkpoint, map_history
from tsfusion.tsdf.files.checkpoint import CheckpointHeader
from tsfusion.wire.records import codec

SYNTHETIC = "synthetic:"
WORK = ".fuse"  # folder of a run's unfinished work, inside its results' folder
_LISTS = (".log", ".json")  # a file of this kind means the recording in its folder
_MEASURED = re.compile(
    r"\.(?:png|jpe?g|tiff?|exr|np[yz]|pgm|bin|pcd|ply|la[sz]|bag|db3|mcap)$", re.IGNORECASE
)  # fmt: skip

log = logging.getLogger(__name__)


class Listed(msgspec.Struct):
    """Keyframes to be fused.

    Attributes:
        keyframes: keyframes of each source, in order.
        names: names of the sources.
        saved: settings of the saved map beside the first journal; empty without such a map.
        sensor: sensor of the first dataset; None without a dataset.
        usual: settings that are usual for the first dataset.
        left_out: reason → number of records without a readable header, or of frames of a dataset.
        lost: number of keyframes (or more) that damage in the journals has destroyed.
        absent: number of keyframes of saved maps that the journals beside them no longer have.
    """

    keyframes: list[KeyframeList] = []
    names: list[str] = []
    saved: dict[str, Any] = {}
    sensor: str | None = None
    usual: dict[str, Any] = {}
    left_out: dict[str, int] = {}
    lost: int = 0
    absent: int = 0
    worlds: frozenset[str] = frozenset()

    @property
    def world(self) -> str:
        """Name of the coordinate frame of all sources; empty for given poses or several frames."""
        return next(iter(self.worlds)) if len(self.worlds) == 1 else ""

    @property
    def count(self) -> int:
        """Number of keyframes of all sources together."""
        return sum(map(len, self.keyframes))

    def shares(self, count: int) -> list[list[KeyframeList]]:
        """Return all keyframes in `count` runs of about the same length: neighbours see the same blocks."""
        ends = np.cumsum([len(one) for one in self.keyframes]).tolist()
        borders = np.linspace(0, self.count, count + 1).round().astype(int).tolist()
        found = []
        for first, stop in pairwise(borders):
            parts = []
            for one, end in zip(self.keyframes, ends, strict=True):
                begin = end - len(one)
                if max(first, begin) < min(stop, end):
                    parts.append(one.part(max(first, begin) - begin, min(stop, end) - begin))
            found.append(parts)
        return found

    def fingerprint(self, config: VolumeConfig, sensor: str | None) -> str:
        """Return a digest of keyframes, their poses, settings and `sensor` (the preset for all)."""
        digest = hashlib.blake2b(digest_size=16)
        digest.update(msgspec.msgpack.encode((config, sensor, self.keyframes)))
        for one in self.keyframes:
            if isinstance(one, JournalKeyframes):
                digest.update(repr([size_of(locations.location(name)) for name in one.files]).encode())
        return digest.hexdigest()


def listed(
    sources: Sequence[str],
    *,
    map_name: str | None = None,
    same_frame: bool = False,
    options: dict[str, Any] | None = None,
    watch: OnProgress = lambda _done, _all: None,
) -> Listed:
    """List the keyframes of state folders, journals and datasets that are in one coordinate frame.

    Args:
        map_name: name of the map, where a state folder has several.
        same_frame: the user declares one frame, even if each scan found its poses by itself.
        options: options of the datasets.
        watch: gets the number of bytes read of a journal, and of all.

    Raises:
        JournalError, DatasetError: when a source cannot be read, or has no keyframe.
        InvalidConfig: for options without a dataset.
        MapError: when keyframes would count twice, or it is not known that the frames are the same.
    """
    found, left_out = Listed(), Counter[str]()
    seen = dict[tuple[bytes, int], str]()
    worlds: set[str] | None = None
    _check_once(sources)
    for source in sources:
        if source.startswith(SYNTHETIC) or not _is_journal(source):
            here, skipped = _add_dataset(found, source, options or {})
            left_out.update(skipped)
        else:
            keyframes = _journal(found, source, map_name, watch)
            if len(sources) > 1:
                _check_distinct(seen, keyframes, source)
            left_out.update(keyframes.unreadable)
            here = keyframes.worlds or {""}
        map_history.check_worlds(worlds or here, here, same_frame=same_frame, name=source)
        worlds = here | (worlds or set())
        found.worlds = frozenset(worlds)
        found.names.append(source)
    if not found.count:
        lost = f"; {found.lost} or more are damaged or cannot be read (see above)" if found.lost else ""
        raise JournalError(f"no keyframes in {', '.join(sources)}{lost}")
    if options and found.sensor is None:
        raise InvalidConfig("--option has no effect on a journal: leave it out")
    if len(sources) > 1 and not same_frame and "" in (worlds or ()):  # poses that were given
        log.warning(
            "the poses of these %d sources are taken to be in one coordinate frame "
            "(--same-frame says that they are)",
            len(sources),
        )
    found.left_out = dict(left_out)
    return found


def _is_journal(source: str) -> bool:
    return state_folder.is_journal(locations.location(source))


def _journal(found: Listed, source: str, map_name: str | None, watch: OnProgress) -> JournaledKeyframes:
    path = locations.location(source)
    saved = saved_beside(path, map_name)  # before the journal, which may grow meanwhile
    keyframes = JournaledKeyframes(state_folder.find_journal(path, map_name), watch=watch)
    files, rows = [locations.absolute(str(path)) for path in keyframes.files], keyframes.rows
    found.keyframes.append(
        JournalKeyframes(files, rows.segments.tolist(), rows.offsets.tolist(), rows.poses.tobytes())
    )
    found.lost += keyframes.lost
    found.saved = found.saved or settings_of(saved)
    found.absent += absent(saved, keyframes)
    return keyframes


def saved_beside(path: Path, map_name: str | None) -> CheckpointHeader | None:
    """Return the header of the saved map beside a journal, or None. Warn if the map cannot be read."""
    if locations.is_url(path):
        return None
    folder = state_folder.resolve_map(path, map_name).absolute()
    if folder.is_file():
        folder = folder.parent
    if folder.name == state_folder.JOURNAL_FOLDER:
        folder = folder.parent
    try:
        with checkpoint.reading(folder / state_folder.MAP_FILE) as (header, _):
            return header
    except CheckpointError as error:
        if (folder / state_folder.MAP_FILE).exists():
            log.warning("%s; its settings are not used", error)
        elif (folder / state_folder.JOURNAL_FOLDER).is_dir():
            log.warning("no map with its settings is saved in %s yet: flags and defaults are used", folder)
        return None


def settings_of(header: CheckpointHeader | None) -> dict[str, Any]:
    """Return the settings of a saved map without those of its sensor's preset; empty without a map."""
    saved = {} if header is None else msgspec.structs.asdict(header.config)
    # None = the preset's value; the number of threads is no property of a map
    return {name: value for name, value in saved.items() if value is not None and name != "threads"}


def absent(header: CheckpointHeader | None, keyframes: JournaledKeyframes) -> int:
    """Return how many of a saved map's keyframes its journal no longer has, without those lost to damage.

    Return 0 for a single segment, and for a map that may not belong to the journal.
    """
    if header is None or "done" not in header.meta or journal.is_segment(Path(keyframes.name)):
        return 0
    there, listed = {*keyframes.rows, *keyframes.left_out}, {*map_history.rows(header.meta)}
    last_unlisted = {bytes.fromhex(one.session): one.unlisted for one in map_history.sessions(header.meta)}
    found = sum(seq <= last_unlisted.get(session, 0) for session, seq in there)
    unlisted: int = header.keyframes - len(listed) - found
    return max(0, len(listed - there) + max(0, unlisted) - keyframes.lost)


def _check_once(sources: Sequence[str]) -> None:
    """Refuse a source given twice: by a link, as a local URL, or a dataset inside another one.

    Journals are compared by their records in `_check_distinct`, wherever they are stored.
    """
    places = [_place(one) for one in sources]
    for place, times in Counter(places).items():
        if times > 1:
            raise MapError(f"{place} is given {times} times: its keyframes would count as often")
    folders = {
        place: source
        for place, source in zip(places, sources, strict=True)
        if os.path.isabs(place) and len(sources) > 1 and not _is_journal(source)
    }
    for place, source in folders.items():
        whole = next((str(one) for one in Path(place).parents if str(one) in folders), None)
        if whole is not None:
            raise MapError(
                f"{source} lies in {folders[whole]}: its keyframes would count twice; give one of them, or "
                "move what is no part of the other elsewhere"
            )


def _place(source: str) -> str:
    """Return one name for all ways to write a source: an absolute path without links for local files."""
    if source.startswith(SYNTHETIC):
        return source
    path = source.removeprefix("file://")
    if "://" in path:
        return path.rstrip("/")
    return os.path.realpath(os.path.expanduser(path))


def _check_distinct(seen: dict[tuple[bytes, int], str], keyframes: JournaledKeyframes, source: str) -> None:
    shared = 0
    for keyframe in keyframes.rows:
        before = seen.setdefault(keyframe, source)
        shared += before != source
        other = before if before != source else source
    if shared:
        raise MapError(
            f"{source} and {other} both hold {count_of(shared, 'keyframe')} of the same session: they would "
            "count twice"
        )


def _add_dataset(found: Listed, source: str, options: dict[str, Any]) -> tuple[set[str], dict[str, int]]:
    """Add a dataset to what was found. Return its world, and reason → number of frames left out."""
    dataset = open_dataset(source, **options)
    skipped = dict(dataset.skipped)  # workers count unreadable frames themselves
    path = source if source.startswith(SYNTHETIC) else str(Path(source).expanduser().absolute())
    found.keyframes.append(DatasetKeyframes(path, options, 0, len(dataset), _state(dataset, path, options)))
    if found.sensor is None:
        found.sensor = dataset.sensor
        found.usual = getattr(dataset, "usual", {})
    if uncolored := getattr(dataset, "uncolored", 0):
        log.warning("%s: %s without colour in time", source, count_of(uncolored, "frame"))
    return {world_of(dataset)}, skipped


def _state(dataset: Dataset, path: str, options: dict[str, Any]) -> str:
    """Return a digest of a dataset's poses and camera, and of its files' names, sizes and times, or an empty
    text for a synthetic dataset."""
    if path.startswith(SYNTHETIC):
        return ""
    digest = hashlib.blake2b(str(getattr(dataset, "camera", "")).encode(), digest_size=16)
    with suppress(DatasetError):  # the worker that reads that frame reports it
        first = first_frame(dataset)
        digest.update(f"{first.intrinsics} {first.baseline_fx} {first.depth_scale} {first.motion}".encode())
        if doubt := sweep_doubt(first):
            log.warning("%s: %s", path, doubt)
    if hasattr(dataset, "pose"):  # else poses are part of the frames, and so in the files
        for index in range(len(dataset)):
            digest.update(np.asarray(pose_of(dataset, index), np.float64).tobytes())
    for file in _files(dataset, Path(path), options):
        with suppress(OSError, ValueError):  # gone meanwhile; no path at all
            found = file.stat()
            digest.update(f"{file} {found.st_size} {found.st_mtime_ns}\n".encode(errors="replace"))
    return digest.hexdigest()


def _files(dataset: Dataset, path: Path, options: dict[str, Any]) -> Iterator[Path]:
    """Yield the files that a dataset consists of: of measurements, camera and options, also in linked
    folders; none of a run's results."""
    yield from (Path(value) for value in options.values() if isinstance(value, str | Path))
    if path.is_file():
        yield path
    root = Path(getattr(dataset, "root", path.parent if path.suffix in _LISTS else path))
    if not root.is_dir():
        return
    for place in (root, root.parent):
        with suppress(DatasetError, OSError):
            yield from camera_files(place)
    linked = [child for child in _children(root) if child.is_symlink() and child.is_dir()]
    for place in (root, *linked):
        for folder, names, files in os.walk(place):
            if WORK in names or RECORD in files:
                names.clear()
                continue
            names.sort()
            yield from (Path(folder, name) for name in sorted(files) if _MEASURED.search(name))


def _children(folder: Path) -> list[Path]:
    with suppress(OSError):
        return sorted(folder.iterdir())
    return []


# --- reading ---


def reading(keyframes: Sequence[KeyframeList]) -> Iterator[Callable[[], Keyframe]]:
    """Yield a function for each keyframe, in order, that reads it.

    The function raises JournalError or DatasetError when the keyframe cannot be read. It raises DecodeError
    or InvalidKeyframe for a keyframe that a server would not take either.
    """
    for one in keyframes:
        if isinstance(one, JournalKeyframes):
            yield from _of_journal(one)
        else:
            dataset = open_dataset(one.path, **one.options)
            yield from (partial(dataset.__getitem__, index) for index in range(one.first, one.stop))


def _of_journal(one: JournalKeyframes) -> Iterator[Callable[[], Keyframe]]:
    with journal.SegmentReader() as records:
        for file, offset, T in zip(one.file, one.offsets, square(one.rows()), strict=True):

            def read(file: int = file, offset: int = offset, T: Any = T) -> Keyframe:
                path = locations.location(one.files[file])
                found = codec.decode_keyframe(records.at(path, offset).frames)
                return replace(found, T_world_camera=T)

            yield read
