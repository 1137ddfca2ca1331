# SPDX-License-Identifier: MIT
"""`tsfusion spool`: what waits is listed, sent with its status, or deleted when asked."""

import json
import os
from collections.abc import Iterator
from pathlib import Path

import pytest
from clients_and_spools import NOBODY, deliver, send_all
from command_processes import Here
from idle_fuser import keeping
from keyframes_and_servers import Server, wall

from tsfusion import Client
from tsfusion.wire.asking.queries import fetch_health


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    with keeping(tmp_path_factory.mktemp("spools")) as running:
        yield running


def left(name: str, count: int = 3, root: str = "tsfusion-spool", **settings: object) -> None:
    with Client(NOBODY, spool=Path(root) / name, policy="spool_all", **settings) as client:  # type: ignore[arg-type]
        send_all(client, range(count))


def test_what_waits_is_listed(here: Here) -> None:
    assert "no keyframes wait in tsfusion-spool" in here("spool", "list").stderr
    left("default", world="w1")
    left("hall.2", 5, map="hall")
    shown = here("spool", "list").stdout
    assert here("spool", "list", "tsfusion-spool").stdout.split()[:12] == shown.split()[:12]
    head, first, second = shown.splitlines()
    assert head.split() == ["spool", "map", "world", "keyframes", "bytes", "age"]
    assert first.split()[:4] == ["default", "default", "w1", "3"]
    assert second.split()[:2] == ["hall.2", "hall"]
    with Client(NOBODY, spool=Path("tsfusion-spool/default")):
        assert f"in use (pid {os.getpid()})" in here("spool", "list").stdout
        sent = here("spool", "send", "default", "--connect", NOBODY)
        assert sent.returncode == 1
        assert "in use by another scanner" in sent.stderr
    (listed, _) = json.loads(here("spool", "list", "--json").stdout)
    assert (listed["map"], listed["world"], listed["keyframes"]) == ("default", "w1", 3)
    assert listed["used_by"] is None


def test_what_waits_is_sent_to_its_map_or_to_another(server: Server, here: Here) -> None:
    left("yard", map="yard", world="w1")
    left("hall", map="hall", world="w2")
    done = here("spool", "send", "--connect", server.address)
    assert done.returncode == 0, done.stderr
    assert "tsfusion-spool/yard → map yard: all sent" in done.stdout
    left("yard", map="yard", world="w3")
    refused = here("spool", "send", "yard", "--connect", server.address)
    assert refused.returncode == 1
    assert "3 keyframes did not get through and stay where they are: tsfusion-spool/yard: " in refused.stderr
    assert "map yard has 3 keyframes of another session" in refused.stderr
    assert refused.stderr.count("map yard has") == 1
    elsewhere = here("spool", "send", "yard", "--connect", server.address, "--map", "auto")
    assert elsewhere.returncode == 0, elsewhere.stderr
    assert "→ map yard-2: all sent" in elsewhere.stdout
    left("yard", map="yard", world="w4")
    shared = here("spool", "send", "--connect", server.address, "--same-frame", "--json")
    assert json.loads(shared.stdout) == {"folder": "tsfusion-spool/yard", "map": "yard", "left": 0, "why": ""}
    found = {name: one.keyframes_durable for name, one in fetch_health(server.address).maps.items()}
    assert found == {"default": 0, "yard": 6, "hall": 3, "yard-2": 3}
    assert "no keyframes wait" in here("spool", "send", "--connect", server.address).stderr


def test_what_an_older_version_left_joins_no_map_by_itself(server: Server, here: Here) -> None:
    with Client(server.address, map="old") as client:
        deliver(client, [wall(0)])
    left("old", map="old")
    refused = here("spool", "send", "--connect", server.address)
    assert refused.returncode == 1
    assert "map old has 1 keyframe of another session" in refused.stderr
    assert here("spool", "send", "--connect", server.address, "--same-frame").returncode == 0


def test_a_server_that_does_not_answer_gets_nothing(here: Here, tmp_path: Path) -> None:
    left("default", root="mine")
    (tmp_path / "quick.toml").write_text("[client]\nconnect_timeout = 2.0\n")
    done = here("spool", "send", "--spool", "mine", "--connect", NOBODY, "--config", "quick.toml")
    assert done.returncode == 1
    assert "3 keyframes did not get through" in done.stderr.splitlines()[-1]
    assert "no server answers at" in done.stderr.splitlines()[-1]
    assert here("spool", "list", "--spool", "mine").stdout.count("default") == 2


def test_what_waits_is_deleted_only_when_that_is_meant(here: Here) -> None:
    left("default")
    unknown = here("spool", "drop", "hall")
    assert "no keyframes wait in a spool hall of tsfusion-spool; spools there: default" in unknown.stderr
    asked = here("spool", "drop", "default")
    assert asked.returncode == 1
    assert (
        "3 keyframes for the map default in tsfusion-spool/default would be deleted: say --yes"
        in asked.stderr
    )
    assert here("spool", "drop", "default", "--yes").returncode == 0
    assert here("spool", "list").stdout == ""


def test_what_damage_has_cost_is_told(server: Server, here: Here) -> None:
    left("barn", map="barn", world="w1")
    left("shed", 1, map="shed", world="w2")
    for name in ("barn", "shed"):
        path = Path("tsfusion-spool") / name / "000001.mcap"
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 16
        path.write_bytes(content)
    listed = here("spool", "list")
    assert (listed.returncode, listed.stdout.split()[6:9]) == (1, ["barn", "barn", "w1"])
    assert "shed: 1 record is damaged: what had" in listed.stderr
    done = here("spool", "send", "--connect", server.address)
    assert (done.returncode, "barn → map barn: all sent" in done.stdout) == (1, True)
    assert "barn: 1 record is damaged: what had not been sent is lost; " in done.stderr
    assert fetch_health(server.address).maps["barn"].keyframes_durable == 2
    left("shed.2", map="shed", world="w2")
    part = here("spool", "send", "shed.2", "--connect", server.address)
    assert part.returncode == 0, part.stderr
