# SPDX-License-Identifier: MIT
"""Files and folders that somebody deletes or moves under a real server: no acknowledged keyframe is lost."""

from pathlib import Path

from keyframes_and_servers import DEADLINE, serving, until, wall
from quick_fusers import SUMS
from sum_map import hash_of

from tsfusion import Client
from tsfusion.journal import state_folder
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.wire.asking.queries import fetch_health, fetch_status


def problems(address: str) -> str:
    return " ".join(fetch_health(address).problems)


def test_a_deleted_segment_and_a_folder_that_is_away_cost_no_keyframe(tmp_path: Path) -> None:
    state, sent = tmp_path / "state", 0
    folder = state_folder.map_folder(state, "default")
    with serving(state, fuser=SUMS) as server, Client(server.address, policy="spool_all") as client:

        def send(count: int) -> None:
            nonlocal sent
            for _ in range(count):
                client.send(wall(sent))
                sent += 1

        send(5)
        client.flush(DEADLINE)
        (folder / "journal" / "000001.mcap").unlink()
        send(5)
        client.flush(DEADLINE)
        until(lambda: "was taken away while it was written to" in problems(server.address))
        folder.rename(tmp_path / "aside")
        send(3)
        until(lambda: "No such file" in problems(server.address))
        until(lambda: "No such file" in client.problem)
        assert not fetch_health(server.address).ready
        assert not folder.exists()  # nobody made it again: it could not be moved back
        (tmp_path / "aside").rename(folder)
        send(3)
        client.flush(DEADLINE)
        client.wait_fused(DEADLINE)
        assert (client.stats.durable, client.stats.rejected, client.stats.skipped) == (sent, {}, {})
        until(lambda: fetch_health(server.address).ready)
        assert fetch_status(server.address).map_hash == hash_of(map(wall, range(sent)))
        server.kill()
    assert len(JournalRecording(state)) == sent
