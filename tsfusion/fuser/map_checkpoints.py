# SPDX-License-Identifier: MIT
"""Write a map's checkpoints to a server's disk, and open a map from its last good checkpoint."""

import logging
import os
from collections.abc import Iterator, Mapping
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from tsfusion import journal
from tsfusion.core import durable_files, process
from tsfusion.core.config import LIMIT_SETTINGS, RUN_SETTINGS, VIEW_SETTINGS, VolumeConfig
from tsfusion.core.errors import CheckpointError, DamagedCheckpoint, InvalidConfig, TsfusionError, refusals_as
from tsfusion.fuser.fuser_messages import Begin, SessionProgress
from tsfusion.journal import state_folder
from tsfusion.journal.ledger import Ledger
from tsfusion.tsdf.files import map_history

if TYPE_CHECKING:
    from tsfusion.tsdf.volume import Volume


# Settings that can differ between a checkpoint and its server, because they do not change the sums.
_FREE_SETTINGS = (*RUN_SETTINGS, *LIMIT_SETTINGS, *VIEW_SETTINGS)
_NEW_FILE = "map.new.tsf"
_PARTS = r"map\.new\.tsf|\.map\.new\.tsf\.partial"

log = logging.getLogger(__name__)
_WORKING_MEMORY = 768 << 20  # bytes for keyframes and meshes, beyond those of the map


class MapCheckpoints:
    """A server's map with its checkpoints in the map's folder.

    Args:
        keep_previous: also keep the checkpoint before the last, because the journal may be cut.
        kept: arguments of `Volume` that say where the map's blocks are stored.

    Raises:
        InvalidConfig: the map was made with other settings.
        CheckpointError: the checkpoint is not a server's, cannot be read now or is of another version. A
            damaged checkpoint is set aside instead.
    """

    def __init__(
        self, folder: Path, config: VolumeConfig, *, keep_previous: bool, kept: dict[str, Any] | None = None
    ) -> None:
        from tsfusion.tsdf.volume import Volume

        self.use_folder(folder)
        durable_files.sweep(folder, _PARTS)  # left by a killed process
        self._keep_previous = keep_previous
        self.problem = ""  # why the last checkpoint could not be written; empty = it could
        self.done: dict[bytes, SessionProgress] = {}  # session → progress of the map
        self.rejected: dict[str, int] = {}  # reason → number of keyframes that the map could not take
        self.blocks: dict[str, int] = {}  # client with a key → number of blocks that its keyframes added
        # The map, loaded from the last checkpoint
        kept = kept or {}
        found = _resume(self._path, config, kept) or _resume(self._previous, config, kept)
        self.volume = found or Volume(config, **kept)
        if meta := self.volume.meta:
            self.done = {
                bytes.fromhex(key): SessionProgress(*progress)
                for key, progress in meta.get("done", {}).items()
            }
            self.rejected = dict(meta.get("rejected", {}))
            self.blocks = dict(meta.get("blocks", {}))
        self.ledger = Ledger(meta.get("poses"), {key: one.seq for key, one in self.done.items()})

    def use_folder(self, folder: Path) -> None:
        """Use this name of the map's folder from now on, after a rename."""
        self._path, self._previous = folder / state_folder.MAP_FILE, folder / state_folder.PREVIOUS_FILE
        self._new = folder / _NEW_FILE

    def save(self) -> bool:
        """Write a checkpoint; return False if that failed (the error is logged).

        A failure loses nothing: the next start uses the older checkpoint and the journal. Old checkpoints
        keep their names until the new one is on the disk.
        """
        done = {key.hex(): msgspec.structs.astuple(progress) for key, progress in self.done.items()}
        meta = {"done": done, "rejected": self.rejected, "blocks": self.blocks, "poses": self.ledger.saved()}
        try:
            self.volume.release_empty()
            self.volume.save(self._new, meta=meta)
            if self._keep_previous:
                with suppress(FileNotFoundError):
                    self._path.replace(self._previous)
            self._new.replace(self._path)
            durable_files.sync_folder(self._path.parent)
        except (TsfusionError, OSError, MemoryError) as error:
            if str(error) != self.problem:  # an error is logged once, not at each repetition
                log.error("no checkpoint: %s", error)
            self.problem = str(error) or type(error).__name__
            return False
        if self.problem:
            log.warning("checkpoints are written again")
            self.problem = ""
        return True

    def replace_previous(self) -> str:
        """Replace the previous checkpoint by the last one; return why that failed, or an empty text.

        On a disk without hard links, the previous checkpoint is deleted.
        """
        try:
            if self._previous.exists() and not self._previous.samefile(self._path):
                self._new.unlink(missing_ok=True)
                try:
                    os.link(self._path, self._new)
                    self._new.replace(self._previous)
                except OSError:
                    self._previous.unlink()
                durable_files.sync_folder(self._path.parent)
        except OSError as error:
            return f"{self._previous} cannot be replaced: {error.strerror}"
        return ""


def _resume(path: Path, wanted: VolumeConfig, kept: dict[str, Any]) -> "Volume | None":
    """Return the map of a checkpoint; None if the file is missing, or damaged and set aside.

    Any other error is raised: an unreadable checkpoint may be good, and the map must not start empty.
    """
    from tsfusion.tsdf.volume import Volume

    try:
        changed = {name: getattr(wanted, name) for name in ("arch", *VIEW_SETTINGS, *LIMIT_SETTINGS)}
        volume = Volume.load(path, wanted.threads, **kept, **changed)
        check_journal(path, volume.meta)
    except DamagedCheckpoint as error:
        if path.is_symlink():  # the file of another server
            raise
        _set_aside(path, error)
        return None
    except CheckpointError as error:
        if error.missing:
            return None
        raise
    if "done" not in volume.meta and not _is_shown_alone(path):
        raise CheckpointError(f"{path} was not saved by a server: it does not say which keyframes it holds")
    for name in VolumeConfig.__struct_fields__:
        here, there = getattr(wanted, name), getattr(volume.config, name)
        if name not in _FREE_SETTINGS and here != there:
            raise InvalidConfig(
                f"the map in {path.parent} was made with {name} = {there}, got {here}: go on with "
                f"{name} = {there}, or use another state folder or map (only a journal that is whole can "
                f"build this one anew)"
            )
    return volume


def _is_shown_alone(path: Path) -> bool:
    """True for a private server's link to a map without a journal."""
    return path.is_symlink() and not journal.segments(path.parent / state_folder.JOURNAL_FOLDER)


def check_journal(path: Path, meta: Mapping[str, Any]) -> None:
    """Raise DamagedCheckpoint if a checkpoint with this `meta` does not belong to the journal beside it.

    Raise CheckpointError if the checkpoint cannot be read.
    """
    with refusals_as(CheckpointError, f"{path} cannot be read"):
        folder, written_ns = path.parent / state_folder.JOURNAL_FOLDER, path.stat().st_mtime_ns
    for one in map_history.sessions(meta):
        rows, session = one.rows, bytes.fromhex(one.session)
        for at in (0, -1) if len(rows) else ():
            seq, place = int(rows.seqs[at]), journal.Position(int(rows.segments[at]), int(rows.offsets[at]))
            if journal.has_another(folder, session, seq, place, until_ns=written_ns):
                raise DamagedCheckpoint(
                    f"{path} is the checkpoint of another map than that of the journal beside it, which has "
                    f"another record in the place of keyframe {seq} of session {one.session[:8]}"
                )


def _set_aside(path: Path, error: DamagedCheckpoint) -> None:
    """Rename a damaged checkpoint, to keep it, without overwriting earlier renamed ones."""
    names = (path.with_name(f"{path.stem}.damaged{number}") for number in ("", *range(2, 1_000_000)))
    try:
        aside = next(name for name in names if not os.path.lexists(name))
        path.rename(aside)
    except OSError as refusal:
        raise CheckpointError(f"{error}, and it cannot be set aside: {refusal.strerror}") from refusal
    log.error(
        "%s; it is kept as %s, and the map is built again from the journal, or from the checkpoint before it",
        error,
        aside,
    )


class OpenedMap:
    """Map that is opened from the folder of a `Begin`, with kernels being compiled.

    Attributes:
        checkpoints: the map and its checkpoints.
        memory_limit: memory limit of the process, bytes.
        warming: compiles the kernels that no keyframe needs, one per step.

    Raises:
        TsfusionError, MemoryError: as `MapCheckpoints`.
    """

    def __init__(self, begin: Begin) -> None:
        from tsfusion.kernels.base import runtime

        runtime.start(begin.volume.threads)  # it reserves a GB, and more for each thread, and hardly uses it
        self.memory_limit = process.data_bytes() + _WORKING_MEMORY + begin.memory_bytes
        process.limit_memory(self.memory_limit)
        # A map of any size opens while there is memory; after that, `memory_bytes` limits its growth.
        self.checkpoints = MapCheckpoints(
            Path(begin.folder),
            begin.volume,
            keep_previous=begin.keep_previous,
            kept={"memory_bytes": begin.memory_bytes, "cache": begin.cache} if begin.cache else {},
        )
        volume = self.checkpoints.volume
        self.warming: Iterator[None] = iter(()) if begin.is_private else volume.warming_up()
        next(self.warming, None)
        volume.limit_memory(begin.memory_bytes)


def warm(config: VolumeConfig) -> None:
    """Compile all kernels of maps with these settings, so that such a map opens at once."""
    from tsfusion.kernels.base import runtime
    from tsfusion.tsdf.volume import Volume

    runtime.start(config.threads)
    Volume(config).warm_up()
