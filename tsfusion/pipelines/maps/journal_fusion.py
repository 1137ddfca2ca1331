# SPDX-License-Identifier: MIT
"""Fuse the keyframes of a journal, or a selection of them, into a map; make textures from its images."""

from collections import Counter
from collections.abc import Callable, Collection
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from tsfusion.core.config import VIEW_SETTINGS, VolumeConfig, override
from tsfusion.core.errors import DecodeError, InvalidKeyframe, JournalError, MapError
from tsfusion.core.readable_numbers import OnProgress
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.geometry.mesh import Mesh
from tsfusion.geometry.textured_mesh import TexturedMesh
from tsfusion.journal import journaled_keyframes, state_folder
from tsfusion.journal.journaled_keyframes import LOST, FinalKeyframe, JournaledKeyframes, JournaledSession
from tsfusion.pipelines.maps import saved_maps
from tsfusion.tsdf.files import checkpoint
from tsfusion.tsdf.texture import texturing
from tsfusion.tsdf.texture.texturing import TextureSettings
from tsfusion.tsdf.volume import Volume
from tsfusion.viewer.map.vertex_colors import hex_color, item_color

ColorBy = Literal["client", "session"]
FusionProgress = Callable[[int, int, int], None]  # keyframes read, in the map, of how many


class Painter:
    """Gives each keyframe the colour of its origin, in place of the camera's colours.

    A surface that several origins saw gets a mix of their colours, by their votes.

    Args:
        by: `client` uses the name of the client's key, or the session where there are no keys.
    """

    def __init__(self, by: ColorBy) -> None:
        self._by = by
        self._counts: Counter[str] = Counter()

    def __call__(self, found: FinalKeyframe) -> Keyframe:
        """Return the keyframe with the colour of its origin."""
        name = self._name(found.session)
        self._counts[name] += 1
        keyframe = found.keyframe
        bgr = item_color(list(self._counts).index(name))[::-1]
        return replace(keyframe, color=np.full((*keyframe.shape, 3), bgr, np.uint8))

    @property
    def legend(self) -> list[dict[str, Any]]:
        """The `name`, `color` (#rrggbb) and number of `keyframes` of each origin, in order of arrival."""
        return [
            {"name": name, "color": hex_color(item_color(index)), "keyframes": count}
            for index, (name, count) in enumerate(self._counts.items())
        ]

    def _name(self, session: JournaledSession) -> str:
        return session.name if self._by == "client" else session.key.hex()[:8]


class JournalMap(msgspec.Struct):
    """A map that was made of a journal.

    Attributes:
        volume: the map.
        left_out: reason → number of keyframes that it could not take.
        legend: meaning of its colours, see `Painter.legend`; empty if the colours are those of the cameras.
        missing: number of keyframes of the saved map that the journal does not have.
        lost: number of keyframes (or more) that the map lacks because the journal is damaged.
    """

    volume: Volume
    left_out: dict[str, int]
    legend: list[dict[str, Any]] = []
    missing: int = 0
    lost: int = 0


def fuse(
    keyframes: JournaledKeyframes,
    volume: Volume,
    *,
    T_map_journal: NDArray[np.float64] | None = None,
    sensor: str | None = None,
    paint: Painter | None = None,
    watch: FusionProgress = lambda _read, _fused, _all: None,
) -> JournalMap:
    """Add the keyframes of a journal, each at its final pose, to a map.

    A keyframe that the map cannot take is counted and left out, as a server does.

    Args:
        T_map_journal: (4, 4) pose of the journal's coordinate frame in the map's; None if both are the same.
        sensor: sensor of keyframes that name none; None for the map's own.
        paint: gives each keyframe its colour.

    Raises:
        JournalError: when a keyframe cannot be read any more.
    """
    left_out = Counter(keyframes.unreadable)
    for index in range(len(keyframes)):
        try:
            found = keyframes[index]
            keyframe = found.keyframe if paint is None else paint(found)
            if T_map_journal is not None:
                keyframe = replace(keyframe, T_world_camera=T_map_journal @ keyframe.T_world_camera)
            if sensor is not None and keyframe.sensor is None:
                keyframe = replace(keyframe, sensor=sensor)
            volume.integrate(keyframe)
        except (MapError, DecodeError, InvalidKeyframe) as error:
            left_out[str(error)] += 1
        watch(index + 1, volume.keyframes, len(keyframes))
    return JournalMap(volume, dict(left_out), [] if paint is None else paint.legend)


def choose(
    source: Path, *, until: str | None = None, only: Collection[str] = (), watch: OnProgress = lambda *_: None
) -> JournaledKeyframes:
    """Return the keyframes of a journal that a user selects.

    Args:
        source: what `state_folder.find_journal` takes.
        until: a time, as `journaled_keyframes.moment_ns` reads it. Later records do not count.
        only: names of sessions or clients, see `journaled_keyframes.sessions_named`; empty for all.

    Raises:
        InvalidConfig, JournalError: for an invalid time or name, or when no keyframe is left.
    """
    place = state_folder.find_journal(source)
    if not (last_ns := place.last_logged_ns()):
        raise journaled_keyframes.none_in(place)
    until_ns = None if until is None else journaled_keyframes.moment_ns(until, last_ns)
    found = JournaledKeyframes(place, until_ns=until_ns, watch=watch)
    if only:
        clients = {key: one.client for key, one in found.sessions.items()}
        if clients:
            named = [key for name in only for key in journaled_keyframes.sessions_named(name, clients)]
            found.keep_only(named)
    if not len(found) and (only or until is not None):
        begins = JournaledKeyframes(place).sessions.values()
        first = journaled_keyframes.clock(min((one.first_ns for one in begins), default=last_ns))
        raise JournalError(
            f"the selection leaves no keyframe of {place.path}, which has records from {first} to "
            f"{journaled_keyframes.clock(last_ns)}"
        )
    return found


def map_of(
    source: Path,
    config: VolumeConfig,
    *,
    given: bool = False,
    until: str | None = None,
    only: Collection[str] = (),
    color_by: ColorBy | None = None,
    memory_for: Callable[[Path | None], int | None] = lambda _saved: None,
    reading: OnProgress = lambda _done, _all: None,
    watch: FusionProgress = lambda _read, _fused, _all: None,
) -> JournalMap:
    """Return the map of a state folder or a journal.

    Without `given` or a selection, this is the saved map with all that its journal holds. Otherwise the
    journal's keyframes are fused anew, with the settings of the saved map.

    Args:
        given: fuse anew with the settings of `config`. Otherwise `config` only says how the surface is read
            and the number of threads. Without a saved map all of `config` counts.
        memory_for: returns `memory_bytes` of `Volume` for the file of a saved map, or for a new map (None).

    Raises:
        InvalidConfig, JournalError, CheckpointError: as `choose`, `saved_maps.check_journal` and
            `Volume.load`.
    """
    view = {name: getattr(config, name) for name in VIEW_SETTINGS}
    saved = source / state_folder.MAP_FILE
    is_view = bool(only) or until is not None or color_by is not None
    if saved.is_file() and not given and not is_view and _is_of_server(saved):
        there = saved_maps.SavedMap(saved, source)
        settled = saved_maps.opened(there, lambda done, total: watch(done, done, total), reading)
        with settled as (file, left_out):
            volume = Volume.load(file, config.threads, memory_bytes=memory_for(file), **view)
            lost = left_out.pop(LOST, 0)
            return JournalMap(volume, dict(left_out), lost=lost)
    keyframes, missing = choose(source, until=until, only=only, watch=reading), 0
    if saved.is_file():
        if given and not is_view:
            saved_maps.check_journal(saved, keyframes.recorded)
        with checkpoint.reading(saved) as (header, _):
            missing = saved_maps.missing(header, keyframes.recorded)
            if not given:
                config = override(msgspec.structs.replace(header.config, threads=config.threads), **view)
    if color_by is not None:
        config = override(config, color=True)
    volume = Volume(config, memory_bytes=memory_for(None))
    made = fuse(keyframes, volume, paint=None if color_by is None else Painter(color_by), watch=watch)
    made.missing, made.lost = missing, keyframes.lost
    return made


def _is_of_server(saved: Path) -> bool:
    """True if a saved map says which records of its journal it has. A file copied by hand does not say it."""
    with checkpoint.reading(saved) as (header, _):
        return "done" in header.meta


class JournalImages:
    """Sequence of a journal's keyframes for a texture. An item is None if it cannot be decoded."""

    def __init__(self, keyframes: JournaledKeyframes) -> None:
        self._keyframes = keyframes

    def __len__(self) -> int:
        return len(self._keyframes)

    def __getitem__(self, index: int) -> Keyframe | None:
        """Read a keyframe.

        Raises:
            JournalError: when the keyframe can no longer be read.
        """
        try:
            return self._keyframes[index].keyframe
        except (DecodeError, InvalidKeyframe):  # the map did not take it either, and this was reported
            return None


def textured(
    mesh: Mesh,
    source: Path,
    voxel_size: float,
    settings: TextureSettings | None = None,
    *,
    until: str | None = None,
    only: Collection[str] = (),
    reading: OnProgress = lambda _done, _all: None,
    watch: texturing.StageProgress = lambda _stage, _done, _all: None,
) -> TexturedMesh:
    """Give the mesh of a map a texture from the images in its journal.

    Args:
        source: what `state_folder.find_journal` takes.
        voxel_size: metres, of the map.
        until, only: selection of keyframes, see `choose`.

    Raises:
        JournalError: when there is no journal, or it has no keyframe. See also `texturing.textured`.
    """
    keyframes = choose(source, until=until, only=only, watch=reading)
    if not len(keyframes):
        raise JournalError(f"a texture needs the images in the journal, but {source} has no keyframes")
    return texturing.textured(mesh, JournalImages(keyframes), voxel_size, settings, watch=watch)
