# SPDX-License-Identifier: MIT
"""A map that is read where it waits goes on where it lies then, and nothing is done with it before."""

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

from keyframes_and_servers import VOLUME, map_hash, wall

from tsfusion import Volume, journal
from tsfusion.fuser import __main__ as fuser_main
from tsfusion.fuser import fuser_messages
from tsfusion.wire.records import codec

SESSION = b"s" * 16


def begin(folder: Path) -> fuser_messages.Begin:
    working = folder.parent / "working"
    working.write_bytes(b"\xff" * 8)
    return fuser_messages.Begin(str(folder), VOLUME, 0.2, 0, str(working), False, 1 << 30, 10**8, 0.75)


def test_a_map_goes_on_in_the_folder_that_it_was_moved_to(tmp_path: Path) -> None:
    waits, home = tmp_path / ".yard.arriving", tmp_path / "yard"
    before = Volume(VOLUME)
    before.integrate(wall(0))
    waits.mkdir()
    done = {SESSION.hex(): [1, "", ""]}
    before.save(waits / "map.tsf", meta={"done": done, "rejected": {}, "blocks": {}, "poses": None})
    with_more = journal.Journal(waits / "journal", 1 << 20)
    places = [
        with_more.append(
            codec.encode(wall(i), session=SESSION, seq=i + 1, jpeg_quality=90), session=SESSION, seq=i + 1
        )
        for i in range(2)
    ]
    with_more.close()
    sent: list[Any] = []
    link = cast("Any", SimpleNamespace(send=lambda one: sent.append(fuser_messages.to_gateway.decode(one))))
    link.send_multipart = lambda frames, **_: link.send(frames[0])
    ahead = fuser_main._Ahead(link)
    assert ahead.do(fuser_messages.ReadAhead(begin(waits)))
    assert [type(one) for one in sent] == [fuser_messages.Prepared]
    waits.rename(home)
    fuser = fuser_main._open_map(link, begin(home), opened=ahead.opened)
    assert fuser is not None
    assert isinstance(sent[-1], fuser_messages.Ready)
    assert sent[-1].done[SESSION].seq == 1
    fuser.handle(fuser_messages.Fuse(0, places[1], SESSION, 2))
    fuser.handle(fuser_messages.Finish())
    assert fuser.exit_status == 0
    assert Volume.load(home / "map.tsf").map_hash() == map_hash(map(wall, range(2)))
    assert not os.path.exists(waits)


def test_a_map_that_cannot_be_read_ahead_is_told(tmp_path: Path) -> None:
    sent: list[Any] = []
    link = cast("Any", SimpleNamespace(send=lambda one: sent.append(fuser_messages.to_gateway.decode(one))))
    assert not fuser_main._Ahead(link).do(fuser_messages.ReadAhead(begin(tmp_path / "nowhere")))
    assert isinstance(sent[0], fuser_messages.Failed)
