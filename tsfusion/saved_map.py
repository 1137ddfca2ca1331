# SPDX-License-Identifier: MIT
"""A map on a server's disk: its last checkpoint, the one before, and how far each session was in it."""

import fcntl
import logging
import os
import time
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING

from tsfusion import disk, maps
from tsfusion.config import VIEW_SETTINGS, VolumeConfig
from tsfusion.errors import CheckpointError, DamagedCheckpoint, InvalidConfig, MapError, TsfusionError
from tsfusion.transport.work import Progress

if TYPE_CHECKING:
    from tsfusion.volume import Volume

# Settings that may differ between a map and the server that goes on with it: none changes the sums.
_FREE_SETTINGS = ("threads", "max_blocks", "max_blocks_per_keyframe", *VIEW_SETTINGS)
_NEW_FILE = "map.new.tsf"
_LOCK_FILE = "fuser.lock"
_PATIENCE = 60.0  # seconds for another fuser to end: it may be reading a large map

log = logging.getLogger(__name__)


def hold(folder: Path) -> int:
    """Keep other fusers off a map for as long as this process lives; one that is ending is waited for.

    Returns:
        A descriptor; closing it lets go.

    Raises:
        MapError: when another one has the map, or the folder cannot be written.
    """
    path, deadline = folder / _LOCK_FILE, time.monotonic() + _PATIENCE
    held = None
    try:
        held = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
        while not _lock(held):
            if time.monotonic() >= deadline:
                owner = os.pread(held, 32, 0).decode("ascii", "replace").strip()
                raise MapError(f"the map {folder} is in use by another fuser (pid {owner}): end that first")
            time.sleep(0.05)
    except (OSError, MapError) as error:
        if held is not None:
            os.close(held)
        if isinstance(error, OSError):
            raise MapError(f"cannot lock {path}: {error.strerror}") from error
        raise
    with suppress(OSError):  # it only helps whoever has to wait
        os.truncate(held, 0)
        os.pwrite(held, b"%d" % os.getpid(), 0)
    return held


def _lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


class SavedMap:
    """The checkpoints in a map's folder.

    Args:
        keep_previous: the journal may not go back to the start, so keep the checkpoint before the last, too.

    Attributes:
        volume: the map; as of the last checkpoint when it was opened.
        done: how far it is, by session.
        rejected: keyframes that it could not take: reason → count.

    Raises:
        InvalidConfig: when the map was made with other settings.
        CheckpointError: when it is not a server's, cannot be read now or is of another version. What is
            damaged is set aside.
    """

    def __init__(self, folder: Path, config: VolumeConfig, *, keep_previous: bool) -> None:
        from tsfusion.volume import Volume

        self._path, self._previous = folder / maps.MAP_FILE, folder / maps.PREVIOUS_FILE
        self._new = folder / _NEW_FILE
        with suppress(OSError):  # of a process that was killed
            self._new.unlink()
        self._keep_previous = keep_previous
        self.done: dict[bytes, Progress] = {}
        self.rejected: dict[str, int] = {}
        self.volume = _resume(self._path, config) or _resume(self._previous, config) or Volume(config)
        if meta := self.volume.meta:
            self.done = {bytes.fromhex(key): Progress(*progress) for key, progress in meta["done"].items()}
            self.rejected = dict(meta["rejected"])

    def save(self) -> bool:
        """Write a checkpoint; False when that failed, which is logged.

        Nothing is lost then: the next start fuses the journal from the checkpoint before this one. Until the
        new one is on the disk, the old ones keep their names.
        """
        done = {key.hex(): [progress.seq, progress.client] for key, progress in self.done.items()}
        try:
            self.volume.save(self._new, meta={"done": done, "rejected": self.rejected})
            if self._keep_previous:
                with suppress(FileNotFoundError):
                    self._path.replace(self._previous)
            self._new.replace(self._path)
            disk.sync_folder(self._path.parent)
        except (TsfusionError, OSError, MemoryError) as error:
            log.error("no checkpoint: %s", error)
            return False
        return True


def _resume(path: Path, wanted: VolumeConfig) -> "Volume | None":
    """The volume that was saved there; None when there is none, or it is damaged.

    Nothing else is None: what cannot be read now is good when it can be, and must not be begun anew.
    """
    from tsfusion.volume import Volume

    try:
        volume = Volume.load(path, wanted.threads, **{name: getattr(wanted, name) for name in VIEW_SETTINGS})
    except DamagedCheckpoint as error:
        _set_aside(path, error)
        return None
    except CheckpointError as error:
        if isinstance(error.__cause__, FileNotFoundError):
            return None
        raise
    except MemoryError as error:
        raise CheckpointError(f"the map {path} does not fit into this machine's memory") from error
    if "done" not in volume.meta:
        raise CheckpointError(f"{path} was not saved by a server: it does not say which keyframes it holds")
    for name in VolumeConfig.__struct_fields__:
        here, there = getattr(wanted, name), getattr(volume.config, name)
        if name not in _FREE_SETTINGS and here != there:
            raise InvalidConfig(
                f"the map in {path.parent} was made with {name} = {there}, got {here}: use another state "
                f"folder or map (only a journal that is whole can build this one anew)"
            )
    return volume


def _set_aside(path: Path, error: DamagedCheckpoint) -> None:
    """Out of the way, beside what was set aside before."""
    names = (path.with_name(f"{path.stem}.damaged{number}") for number in ("", *range(2, 1_000_000)))
    try:
        aside = next(name for name in names if not os.path.lexists(name))
        path.rename(aside)
    except OSError as refusal:
        raise CheckpointError(f"{error}, and it cannot be set aside: {refusal.strerror}") from refusal
    log.error(
        "%s; it is kept as %s, and the map is built again from the journal, or goes on from the checkpoint "
        "before it", error, aside,
    )  # fmt: skip
