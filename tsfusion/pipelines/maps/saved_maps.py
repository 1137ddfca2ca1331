# SPDX-License-Identifier: MIT
"""Find, describe, resume and question saved maps: single files, or checkpoints of a state folder."""

import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np
from msgspec import Struct

from tsfusion.core import process
from tsfusion.core.config import ClientConfig, override
from tsfusion.core.durable_files import make_folder, size_of
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, JournalError, OutputError
from tsfusion.core.folder_lock import lock_folder
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.fuser import map_checkpoints
from tsfusion.gateway.maps import moved_maps
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import LOST
from tsfusion.pipelines.maps import settled_maps
from tsfusion.tsdf.files import checkpoint, map_history
from tsfusion.tsdf.files.checkpoint import CUBE
from tsfusion.tsdf.store.growing_array import LAYER_DTYPES
from tsfusion.wire.asking.map_client import Answered
from tsfusion.wire.messages.questions import MapVersion

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume

_EXPANDS = 8  # a map in memory against its file: more than any


class SavedMap(Struct, frozen=True):
    """File of a saved map. `folder` is the map's folder in a state folder, or None for a single file."""

    path: Path
    folder: Path | None = None


class SessionSummary(Struct, frozen=True):
    """A session of a map. `listed` counts the keyframes that the map knows by number and pose."""

    session: str
    client: str
    world: str
    last: int
    listed: int
    unlisted_up_to: int


class MapSummary(Struct, frozen=True):
    """Facts of a saved map, read without opening it.

    Attributes:
        nbytes: bytes of the file; `voxel_bytes` counts its voxels in memory.
        box: x0, y0, z0, x1, y1, z1 of its blocks, metres; None if the map is empty.
        corrections_waiting: keyframes whose newest pose is not fused yet.
        keyframes_after: number of keyframes in the journal after this checkpoint; `corrections_after` counts
            corrections. Both are None without a journal.
        keyframes_lost: number of keyframes (or more) lost to damage in the journal; None without a journal.
    """

    path: str
    nbytes: int
    map_hash: str
    keyframes: int
    blocks: int
    voxels: int
    voxel_bytes: int
    layers: list[str]
    box: list[float] | None
    sessions: list[SessionSummary]
    rejected: dict[str, int]
    corrections_waiting: int
    keyframes_after: int | None
    corrections_after: int | None
    keyframes_lost: int | None
    settings: dict[str, Any]
    meta: dict[str, Any]


def find(path: Path, map_name: str | None = None) -> SavedMap:
    """Return the saved map at a path: a file, a state folder, or the folder of one of its maps.

    Args:
        map_name: name of the map, where the state folder has several.

    Raises:
        CheckpointError: when there is no map. JournalError: when it is unclear which map is meant.
    """
    if not path.exists():
        raise CheckpointError(f"{path} does not exist; expected a map (.tsf) or a state folder", missing=True)
    folder = state_folder.resolve_map(path, map_name)
    if not folder.is_dir():
        return SavedMap(folder)
    file = folder / state_folder.MAP_FILE
    if not file.exists():
        expected = f"no map in {folder}; expected a map (.tsf) or a state folder"
        unsaved = (
            f"{folder} has no {state_folder.MAP_FILE} yet: a server saves it now and then, and at its end"
        )
        is_a_maps = (folder / state_folder.JOURNAL_FOLDER).is_dir()
        raise CheckpointError(unsaved if is_a_maps else expected, missing=True)
    return SavedMap(file, folder)


def memory_for(file: Path, *, maps: int = 1) -> int | None:
    """Return the bytes that a saved map may take in memory (the rest stays in files), or None if all fits.

    Args:
        maps: number of maps that are open at the same time.
    """
    share = process.physical_memory_bytes() // (2 * maps)
    return share if _EXPANDS * size_of(file) > share else None


def missing(header: checkpoint.CheckpointHeader, keyframes: int) -> int:
    """Return how many keyframes of a checkpoint its journal lacks; `keyframes`: all that it ever had."""
    removed = (header.meta.get("poses") or {}).get("removed", 0)
    there: int = header.keyframes + sum(header.meta.get("rejected", {}).values()) + removed
    return max(0, there - keyframes)


def check_journal(path: Path, keyframes: int) -> None:
    """Raise JournalError if a checkpoint has keyframes that its journal, of `keyframes`, does not have."""
    with checkpoint.reading(path) as (header, _):
        absent = missing(header, keyframes)
    if absent:
        raise JournalError(
            f"the map {path} cannot be fused anew: of its {keyframes + absent} keyframes the journal has "
            f"{keyframes} (others were deleted from it, or came with `tsfusion map resume`); leave the map "
            "flags out"
        )


def resume(path: Path, state: Path, map_name: str) -> Path:
    """Copy a saved map into a state folder, as a checkpoint for a server. Return the map's folder.

    No journal comes with the map. So its keyframes of before can be neither moved nor removed.

    Raises:
        OutputError: when that folder holds a map already, or cannot be written.
        JournalError: when a server runs in the state folder.
        InvalidConfig: for an invalid name. CheckpointError: when the map cannot be read or written.
    """
    map_name = override(ClientConfig(), map=map_name).map
    folder = state_folder.map_folder(state, map_name)
    with lock_folder(state, "state", "server"):
        if (where := moved_maps.departed(state, map_name)) is not None:
            raise OutputError(
                f"the map {map_name} of {state} has moved to {where.address}: choose another name (--map); "
                f"if that server is gone for good, delete {moved_maps.path_of(state, map_name)} first"
            )
        if state_folder.holds_a_map(folder):
            raise OutputError(
                f"{folder} holds a map already: choose another name (--map), or merge the two (`tsfusion map "
                "merge`)"
            )
        make_folder(folder)
        checkpoint.copy(path, folder / state_folder.MAP_FILE, _leave_journal)
    return folder


def _leave_journal(header: checkpoint.CheckpointHeader) -> None:
    # A map that no server saved counts as a session with given poses: others of that kind are let in.
    known = header.meta.get("done") or {header.map_hash: (0, "", "")}
    meta = {"rejected": {}, "blocks": {}, **header.meta, "done": known}
    header.meta = map_history.without_journal(meta)


@contextmanager
def opened(
    saved: SavedMap,
    watch: OnProgress = lambda _done, _all: None,
    reading: OnProgress = lambda _done, _all: None,
) -> Iterator[tuple[Path, dict[str, int]]]:
    """Yield the file of a map with all that its journal holds. The file is valid during the block.

    A checkpoint in a state folder lacks records after a crash, or while its server runs. These records are
    then fused into a copy of the map.

    Args:
        watch: gets the number of records fused and of all; `reading` gets bytes of the journal likewise.

    Yields:
        The file, and a dict of reason → number of the journal's keyframes that are not in the map.

    Raises:
        CheckpointError, JournalError: when the map or its journal cannot be read.
    """
    if saved.folder is not None:
        with checkpoint.reading(saved.path) as (header, _):
            check_checkpoint(saved, header)
            histories = map_history.sessions(header.meta)
            tail = settled_maps.records_after(saved.folder, histories, reading)
            lost = _lost(header, tail)
        damage = {LOST: lost} if lost else {}
        if tail.records or any(one.waiting for one in histories):
            most = memory_for(saved.path)
            with settled_maps.settled(saved.folder, header, most, watch) as (path, left_out):
                yield path, left_out | damage
            return
        yield saved.path, damage
        return
    yield saved.path, {}


def check_checkpoint(saved: SavedMap, header: checkpoint.CheckpointHeader) -> None:
    """Raise CheckpointError if the checkpoint in a map's folder belongs to another map."""
    try:
        map_checkpoints.check_journal(saved.path, header.meta)
    except DamagedCheckpoint as error:
        raise CheckpointError(
            f"{error}; a server that starts there sets it aside and builds the map from the journal"
        ) from error


def _lost(header: checkpoint.CheckpointHeader, tail: settled_maps.Tail) -> int:
    """Return the number of keyframes (or more) that damage has destroyed and the checkpoint does not have."""
    return max(0, tail.lost - missing(header, tail.keyframes)) + tail.lost_behind


def summarise(saved: SavedMap, reading: OnProgress = lambda _done, _all: None) -> MapSummary:
    """Describe a saved map. Every byte of the file is checked; the hash is that of its voxels.

    Args:
        reading: gets the number of journal bytes read, and of all.

    Raises:
        CheckpointError: when the file is missing, damaged or of another version.
    """
    from tsfusion.tsdf.files import saved_map_addition  # needs Taichi, which a page lacks

    header, keys = saved_map_addition.checked_keys(saved.path)
    voxel_bytes = sum(np.dtype(LAYER_DTYPES[name]).itemsize for name in header.layers)
    histories = map_history.sessions(header.meta)
    after = lost = None
    if saved.folder is not None:
        check_checkpoint(saved, header)
        tail = settled_maps.records_after(saved.folder, histories, reading)
        after, lost = Counter(one.is_correction for one in tail.records), _lost(header, tail)
    return MapSummary(
        path=str(saved.path),
        nbytes=size_of(saved.path),
        map_hash=header.map_hash,
        keyframes=header.keyframes,
        blocks=header.blocks,
        voxels=CUBE * header.blocks,
        voxel_bytes=CUBE * header.blocks * voxel_bytes,
        layers=header.layers,
        box=_box(keys, 8 * header.config.voxel_size),
        sessions=[
            SessionSummary(one.session, one.client, one.world, one.last, len(one.rows), one.unlisted)
            for one in map_history.of_clients(histories)
        ],
        rejected=header.meta.get("rejected", {}),
        corrections_waiting=sum(one.waiting for one in histories),
        keyframes_after=None if after is None else after[False],
        corrections_after=None if after is None else after[True],
        keyframes_lost=lost,
        settings=msgspec.to_builtins(header.config),
        meta={name: value for name, value in header.meta.items() if name not in _SERVERS},
    )


_SERVERS = ("done", "rejected", "blocks", "poses", "held")  # in a checkpoint's meta


def _box(keys: "np.ndarray[Any, np.dtype[np.int64]]", block_size: float) -> list[float] | None:
    if not len(keys):
        return None
    from tsfusion.tsdf.store.block_store import unpack_keys

    blocks = unpack_keys(keys)
    corners = np.concatenate([blocks.min(axis=0), blocks.max(axis=0) + 1]) * block_size
    return [round(float(metres), 6) for metres in corners]


class SavedMapAnswers:
    """Answers of a map in this process, as `MapClient` gives them; `timeout` and `max_age` have no effect."""

    def __init__(self, volume: "Volume") -> None:
        self._volume = volume

    def __getattr__(self, name: str) -> Callable[..., Answered[Any]]:
        """Return a method of the volume whose result comes in an `Answered`."""
        return partial(self._answered, getattr(self._volume, name))

    def _answered(
        self,
        method: Callable[..., Any],
        *given: Any,
        timeout: float | None = None,
        max_age: float = 0.0,
        **how: Any,
    ) -> Answered[Any]:
        began = time.monotonic()
        result = method(*given, **how)
        took = time.monotonic() - began
        state = MapVersion(keyframes=self._volume.keyframes)
        return Answered(result=result, state=state, delay_s=took, took_s=took)
