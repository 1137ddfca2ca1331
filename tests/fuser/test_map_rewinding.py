# SPDX-License-Identifier: MIT
"""A saved map at any time of its journal."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from corrected_maps import fresh_map
from keyframes_and_servers import VOLUME, map_hash, pose, wall
from saved_maps import ANNA, BOB, correct, decoded, forget, make_map
from watched_surfaces import ordered

from tsfusion import Volume, VolumeConfig
from tsfusion.core.config import override
from tsfusion.core.errors import MapError
from tsfusion.fuser import fuser_messages
from tsfusion.fuser.fuser import Fuser
from tsfusion.journal import list_records, segment_path
from tsfusion.tsdf.files import checkpoint
from tsfusion.wire.messages.questions import Rewind

RAW = override(VOLUME, surface="raw")


class NoGateway:
    """Drops what the fuser sends."""

    def send_multipart(self, frames: list[Any], copy: bool) -> None:
        assert not copy


class Rewound:
    """The map of a folder, in a fuser that does all that is to do after each wish."""

    def __init__(self, folder: Path) -> None:
        with checkpoint.reading(folder / "map.tsf") as (header, _):
            config = header.config
        working = folder / "working"
        working.write_bytes(bytes(8))
        begin = fuser_messages.Begin(
            str(folder), config, 0.0, 0, str(working), False, 1 << 30, 50_000_000, 1.0, is_private=True
        )
        self.fuser = Fuser(NoGateway(), begin)  # type: ignore[arg-type]
        records = list_records(segment_path(folder / "journal", 1))[0]
        for index, one in enumerate(records):
            place = (one.position, one.session, one.seq, one.client, one.world)
            self.fuser.handle(fuser_messages.Fuse(index, *place, is_correction=one.is_correction))
        self.finish()

    def finish(self) -> None:
        while self.fuser.do_chore(idle=True) is not None:
            pass

    def ask(self, keyframes: int | None = None) -> dict[str, Any]:
        assert self.fuser._rewinding is not None
        return self.fuser._rewinding.answer(Rewind(keyframes))

    def seek(self, keyframes: int) -> dict[str, Any]:
        assert not self.ask(keyframes)["is_there"]
        self.finish()
        return self.ask()

    @property
    def volume(self) -> Volume:
        return self.fuser._volume

    def last_clients(self) -> list[bytes]:
        """The sessions whose keyframes touched each cell of the mesh last."""
        found = self.volume.surface.mesh_cells(self.volume.blocks().coordinates, "raw")
        sessions, rows = self.fuser._touched_by.of(self.volume.surface.cell_versions(found.cells))
        return [sessions[row] if row >= 0 else b"" for row in rows.tolist()]


def of_views(views: range, config: VolumeConfig = VOLUME) -> Volume:
    volume = Volume(config)
    for view in views:
        volume.integrate(decoded(wall(view)))
    return volume


@pytest.mark.parametrize("keyframes", [0, 1, 4, 5])
def test_the_map_after_some_keyframes(keyframes: int, tmp_path: Path) -> None:
    rewound = Rewound(make_map(tmp_path, range(6), config=RAW))
    there = rewound.seek(keyframes)
    fresh = of_views(range(keyframes), RAW)
    assert rewound.volume.map_hash() == fresh.map_hash()
    assert rewound.volume.color_hash() == fresh.color_hash()
    assert np.array_equal(ordered(rewound.volume.extract_mesh()), ordered(fresh.extract_mesh()))
    assert there["is_there"]
    assert there["keyframes"] == 6
    assert there["seqs"].tolist() == ([keyframes] if keyframes else [])


def test_there_and_back_again_is_the_same_map(tmp_path: Path) -> None:
    rewound = Rewound(make_map(tmp_path, range(8)))
    hashes, meshes = [], []
    for place in (8, 0, 8, 3, 4, 3, 8, 7, 0, 8):
        rewound.seek(place)
        hashes.append((place, rewound.volume.map_hash()))
        meshes.append((place, ordered(rewound.volume.extract_mesh(surface="raw")).tobytes()))
    assert len(set(hashes)) == len({place for place, _ in hashes})
    assert len(set(meshes)) == len({place for place, _ in meshes})
    assert dict(hashes)[8] == map_hash(decoded(wall(i)) for i in range(8))


def test_the_last_wish_counts(tmp_path: Path) -> None:
    rewound = Rewound(make_map(tmp_path, range(8)))
    for place in (7, 2, 5):
        rewound.ask(place)
        rewound.fuser.do_chore(idle=True)
    rewound.finish()
    assert rewound.volume.map_hash() == of_views(range(5)).map_hash()


def test_what_the_saved_map_lacks_counts(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(5), behind=2, config=RAW)
    correct(folder, ANNA, 6, {1: pose(0.5), 5: pose(0.2)}, removed=[2])
    forget(folder, ANNA, [3], 1)
    rewound = Rewound(folder)
    for number, index in ((2, 5), (3, 6)):
        (one,) = list_records(segment_path(folder / "journal", number))[0]
        place = (one.position, one.session, one.seq, one.client, one.world)
        rewound.fuser.handle(fuser_messages.Fuse(index, *place, is_correction=True))
    rewound.finish()
    fresh = fresh_map(folder / "journal", RAW.voxel_size)
    assert rewound.volume.map_hash() == fresh.map_hash()
    assert rewound.ask()["keyframes"] == 3
    for place in (0, 3):
        rewound.seek(place)
    assert rewound.volume.map_hash() == fresh.map_hash()
    assert rewound.seek(2)["seqs"].tolist() == [4]


def test_a_keyframe_that_the_map_refused_stays_out_of_it(tmp_path: Path) -> None:
    rewound = Rewound(make_map(tmp_path, range(4), refused=[2], config=RAW))
    assert rewound.ask()["keyframes"] == 3
    for place in (0, 3):
        rewound.seek(place)
    assert rewound.volume.map_hash() == map_hash(decoded(wall(i)) for i in (0, 2, 3))


def test_a_record_that_cannot_be_read_any_more_is_counted(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(3), config=RAW)
    rewound = Rewound(folder)
    for path in (folder / "journal").iterdir():
        path.write_bytes(b"")
    rewound.seek(0)
    assert rewound.volume.map_hash() == Volume(RAW).map_hash()  # for which nothing has to be read
    rewound.ask(1)
    rewound.finish()
    assert rewound.fuser._mover.progress().unavailable == 1


def test_two_sessions_are_in_the_order_of_the_journal(tmp_path: Path) -> None:
    folder = make_map(tmp_path, range(3), config=RAW)
    make_map(folder, range(3, 5), session=BOB, client="bob", config=RAW)
    rewound = Rewound(folder)
    there = rewound.seek(4)
    assert there["seqs"].tolist() == [3, 1]
    assert [one.tobytes() for one in there["sessions"]] == [ANNA, BOB]
    assert rewound.volume.map_hash() == map_hash(decoded(wall(i)) for i in range(4))


def last_touched(keyframes: list[tuple[bytes, int]]) -> list[bytes]:
    volume, by_version = Volume(RAW), [b""]
    for session, view in keyframes:
        volume.integrate(decoded(wall(view)))
        by_version.append(session)
    found = volume.surface.mesh_cells(volume.blocks().coordinates, "raw")
    versions = volume.surface.cell_versions(found.cells)
    return [by_version[version] for version in versions.tolist()]


@pytest.mark.parametrize("place", [6, 5, 2])
def test_whose_keyframe_touched_a_cell_last(place: int, tmp_path: Path) -> None:
    folder = make_map(tmp_path, [0, 12], config=RAW)
    make_map(folder, [13, 90], session=BOB, config=RAW)
    make_map(folder, [1, 25], config=RAW)
    keyframes = [(ANNA, 0), (ANNA, 12), (BOB, 13), (BOB, 90), (ANNA, 1), (ANNA, 25)]
    rewound = Rewound(folder)
    before = rewound.volume.map_hash()
    assert rewound.last_clients() == last_touched(keyframes)
    rewound.seek(place)
    rewound.volume.release_empty()
    assert rewound.last_clients() == last_touched(keyframes[:place])
    rewound.seek(6)
    assert rewound.volume.map_hash() == before


def test_a_live_map_has_no_past(tmp_path: Path) -> None:
    rewound = Rewound(make_map(tmp_path, range(1)))
    rewound.fuser._answers._rewinding = None
    asked = fuser_messages.FuserQuestion(1, _ask(Rewind(0)), 0, 1 << 62)
    with pytest.raises(MapError, match="only a saved map has a past"):
        rewound.fuser._answers._find(asked, [])


def _ask(question: Rewind) -> Any:
    from tsfusion.wire.messages.messages import Command

    return Command(name="ask", map="default", question=question)
