# SPDX-License-Identifier: MIT
"""Scans that meet a map of another world, and keyframes that earlier scans left: nothing is mixed or lost."""

import logging
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, deliver, send_all
from command_processes import Here
from idle_fuser import keeping
from keyframes_and_servers import Server, until, wall
from scripted_server import scripted

from tsfusion import Client, open_dataset
from tsfusion.cli.progress import Quiet
from tsfusion.core.config import ClientConfig, ScanConfig, VolumeConfig
from tsfusion.core.errors import WorldRefused
from tsfusion.datasets import select
from tsfusion.datasets.trajectory_files import read_tum
from tsfusion.geometry.frame import Frame
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.pipelines.report.run_record import RunRecord
from tsfusion.pipelines.runs import engine
from tsfusion.pipelines.runs.run import RunPlan
from tsfusion.pipelines.runs.run import run as carry_out
from tsfusion.scanner.sources.source import RecordedSource
from tsfusion.wire.asking.queries import fetch_health

FRAMES = 3
OWN_WORLD = ("synthetic:room", "--localizer", "rgbd", "--max-frames", FRAMES)
Scan = Callable[..., RunRecord]


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with keeping(tmp_path_factory.mktemp("worlds")) as running:
        yield running


@pytest.fixture
def scan(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Scan:
    """A scan in this process that localises itself; what no server takes is soon left."""

    def run(connect: str, map_name: str = "default", *, localizer: str = "rgbd") -> RunRecord:
        monkeypatch.setattr(engine, "LINGER", 0.2 if connect == NOBODY else 30.0)
        source = RecordedSource(select(open_dataset("synthetic:room"), limit=FRAMES))
        plan = RunPlan(
            source=source, scan=ScanConfig(localizer=localizer), volume=VolumeConfig(), connect=connect,
            client=ClientConfig(map=map_name), spool=tmp_path / "spool",
        )  # fmt: skip
        return carry_out(plan, tmp_path / "out", Quiet(), overwrite=True)

    return run


def keyframes(server: Server, map_name: str) -> int:
    """Keyframes in a map's journal."""
    return fetch_health(server.address).maps[map_name].keyframes_durable


def waiting(folder: Path) -> int:
    return len(JournalRecording(folder))


def test_a_second_scan_into_a_map_is_refused_at_once(server: Server, here: Here, tmp_path: Path) -> None:
    to_hall = (*OWN_WORLD, "--connect", server.address, "--map", "hall")
    assert here("scan", *to_hall).returncode == 0
    taken = keyframes(server, "hall")
    again = here("scan", *to_hall, "--out", "again")
    assert again.returncode == 1
    assert again.stderr.count("tsfusion: ") == 1
    (line,) = [line for line in again.stderr.splitlines() if line.startswith("tsfusion: ")]
    assert f"map hall has {taken} keyframes of another session" in line
    assert "--map hall-2 or --map auto, or --same-frame" in line
    assert "scanning" not in again.stderr  # before the first frame
    assert not (tmp_path / "again").exists()
    replayed = here("replay", "synthetic:room", "--max-frames", 1, *to_hall[-4:], "--out", "replayed")
    assert replayed.returncode == 1
    assert f"map hall has {taken} keyframes of another session" in replayed.stderr.splitlines()[-1]
    assert keyframes(server, "hall") == taken
    shared = here("scan", *to_hall, "--same-frame", "--out", "shared")
    assert shared.returncode == 0, shared.stderr
    assert keyframes(server, "hall") == 2 * taken


def test_the_next_free_map_is_found_and_named(server: Server, here: Here) -> None:
    command = ("scan", *OWN_WORLD, "--connect", server.address, "--map", "auto")
    for name in ("default", "default-2"):
        done = here(*command, "--out", name)
        assert done.returncode == 0, done.stderr
        assert f"into the map {name}" in done.stderr
        assert f"map        {name}: {FRAMES} frames" in done.stdout
        assert keyframes(server, name) >= 1
    assert here("scan", *OWN_WORLD, "--same-frame").returncode == 1  # there is no other session


def test_a_refusal_that_comes_late_keeps_the_keyframes_and_names_them(scan: Scan, tmp_path: Path) -> None:
    class Walk(RecordedSource):
        """A recording during which the server opens its map, and sees whose it is."""

        def __iter__(self) -> Iterator[Frame]:
            for number, frame in enumerate(super().__iter__()):
                if number == 4:
                    asked, denied = len(server.hellos), "map yard has 9 keyframes of another session"
                    server.denial = ("world", denied, "yard-2")
                    until(lambda: len(server.hellos) > asked + 1)  # noqa: B023
                yield frame

    said = r"map yard has 9 .*: use --map yard-2 or --map auto, .*; [0-9]+ keyframes? waits? in .*spool/yard "
    with scripted(denial=("opening", "wait")) as server:
        plan = RunPlan(
            source=Walk(select(open_dataset("synthetic:room", count=150), limit=20)), volume=VolumeConfig(),
            scan=ScanConfig(localizer="rgbd", distance=0.01), connect=server.address,
            client=ClientConfig(map="yard", control=server.control), spool=tmp_path / "spool",
        )  # fmt: skip
        with pytest.raises(WorldRefused, match=said) as error:
            carry_out(plan, tmp_path / "out", Quiet())
    assert not server.taken
    assert f"; {waiting(tmp_path / 'spool/yard')} keyframe" in str(error.value)
    assert 4 <= len(read_tum(tmp_path / "out" / "trajectory.txt").timestamps_ns) < 20


def test_each_scan_without_a_server_has_a_spool_of_its_own(
    scan: Scan, server: Server, tmp_path: Path
) -> None:
    first, second = scan(NOBODY, "attic"), scan(NOBODY, "attic")
    assert (
        first.left == second.left == waiting(tmp_path / "spool/attic") == waiting(tmp_path / "spool/attic.2")
    )
    with pytest.raises(WorldRefused, match=r"map attic has [0-9]+ keyframes? of another session"):
        scan(server.address, "attic")  # the first comes first
    assert keyframes(server, "attic") == first.left
    assert not list((tmp_path / "spool/attic").glob("*.mcap"))
    assert waiting(tmp_path / "spool/attic.2") == second.left


def test_what_was_left_goes_to_its_own_map_or_waits_and_is_named(
    scan: Scan, server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.WARNING)
    left = scan(NOBODY, "cellar").left
    with Client(server.address, map="cellar", world="another") as client:
        deliver(client, [wall(0)])
    scan(server.address, "roof")
    assert f"{left} keyframes that a scan of " in caplog.text
    assert (
        f"left for the map cellar wait in {tmp_path / 'spool/cellar'}: that map has keyframes" in caplog.text
    )
    assert (keyframes(server, "cellar"), waiting(tmp_path / "spool/cellar")) == (1, left)
    with keeping(tmp_path / "state") as new:  # another server, on which the map is new
        assert scan(new.address, "porch").left == 0
        assert keyframes(new, "cellar") == left
        new.kill()
    assert "are sent, too, as soon as the server takes them" in caplog.text
    assert not list((tmp_path / "spool/cellar").glob("*.mcap"))


def test_what_an_older_version_left_is_never_fused_into_another_session(
    scan: Scan, server: Server, tmp_path: Path
) -> None:
    """Records of an old spool name no world, and neither do those that the map has."""
    with Client(server.address, map="old") as client:
        deliver(client, [wall(0)])
    for name in ("old", "older"):
        with Client(NOBODY, spool=tmp_path / "spool" / name, map=name) as client:
            send_all(client, range(1, 4))
    assert scan(server.address, "new").left == 0
    assert (keyframes(server, "old"), keyframes(server, "older")) == (1, 3)
    assert waiting(tmp_path / "spool/old") == 3
    scan(server.address, "old", localizer="given")  # poses from elsewhere, as those that wait
    assert keyframes(server, "old") >= 1 + 3 + 1


def test_a_spool_that_another_scanner_uses_is_left_alone(
    scan: Scan, server: Server, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with Client(NOBODY, spool=tmp_path / "spool/busy", map="busy", world="a") as client:
        send_all(client, range(2))
        assert scan(server.address, "busy").left == 0
    assert f"{tmp_path / 'spool/busy'} is in use by another scanner (pid" in caplog.text
    assert waiting(tmp_path / "spool/busy") == 2
