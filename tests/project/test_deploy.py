# SPDX-License-Identifier: MIT
"""The examples of docs/deploy say what the program understands, and a server lives as its unit expects it."""

import io
import os
import re
import shlex
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Iterator
from contextlib import redirect_stdout
from functools import cache
from pathlib import Path
from unittest.mock import patch

import pytest
from command_processes import DEADLINE, end, environment, eventually, read_until, tsfusion
from health_snapshots import client, health, map_health
from http_requests import get
from prometheus_client.parser import text_string_to_metric_families
from quick_fusers import SUMS, server_command
from repository import ROOT

from tsfusion import Client, Intrinsics, Keyframe
from tsfusion.cli import main
from tsfusion.core.config import ServerConfig
from tsfusion.gateway.health.metrics import STAGES, Metrics

DEPLOY = ROOT / "docs" / "deploy"
UNIT = (DEPLOY / "tsfusion.service").read_text(encoding="utf-8")
VERBS = ("serve", "status", "keys", "doctor", "config", "journal", "mesh")
CONTAINERFILE = (DEPLOY / "Containerfile").read_text(encoding="utf-8")


def settings(section: str) -> dict[str, list[str]]:
    """A section of the unit; a setting may stand there more than once."""
    body = re.search(rf"^\[{section}\]\n(.*?)(?=^\[|\Z)", UNIT, re.MULTILINE | re.DOTALL)
    assert body is not None
    found: dict[str, list[str]] = {}
    for line in body[1].splitlines():
        if line and not line.startswith("#"):
            name, _, value = line.partition("=")
            found.setdefault(name, []).append(value)
    return found


@cache
def help_of(*verb: str) -> str:
    """The whole help of a verb, wide enough that nothing is cut."""
    text, handler = io.StringIO(), signal.getsignal(signal.SIGTERM)
    for flag in ("--help-all", "--help"):  # of a verb with rare flags; of any
        with patch.dict(os.environ, {"COLUMNS": "400"}), redirect_stdout(text), pytest.raises(SystemExit):
            main([*verb, flag])
    signal.signal(signal.SIGTERM, handler)
    return text.getvalue()


def check_command(words: list[str]) -> None:
    """Every verb and flag of a `tsfusion …` command line exists."""
    assert Path(words[0]).name == "tsfusion", words
    verb: list[str] = []
    for word in words[1:]:
        if word.startswith("-") or re.search(rf"^│ {re.escape(word)} ", help_of(*verb), re.MULTILINE) is None:
            break
        verb.append(word)
    for flag in (word for word in words if word.startswith("--")):
        assert re.search(rf"{flag}[\s,]", help_of(*verb)), f"{' '.join(words)}: {verb} knows no {flag}"


def test_the_unit_starts_what_there_is() -> None:
    (start,) = settings("Service")["ExecStart"]
    words = shlex.split(start)
    assert words[:2] == ["/opt/tsfusion/bin/tsfusion", "serve"]
    check_command(words)


def test_the_unit_says_what_it_has_to() -> None:
    service = settings("Service")
    wanted = {
        "Type": "notify", "NotifyAccess": "main", "Restart": "on-failure", "StateDirectory": "tsfusion",
        "OOMPolicy": "continue", "KillMode": "mixed", "NoNewPrivileges": "yes", "ProtectSystem": "strict",
        "PrivateTmp": "yes", "CapabilityBoundingSet": "", "UMask": "0077",
    }  # fmt: skip
    assert {name: service[name] for name in wanted} == {name: [value] for name, value in wanted.items()}
    assert int(service["WatchdogSec"][0]) >= 30, "a slow disk is no reason to be killed"
    assert service["MemoryMax"]
    (families,) = service["RestrictAddressFamilies"]
    assert "AF_NETLINK" in families.split(), "ZeroMQ aborts without"
    assert "MemoryDenyWriteExecute" not in service, "kernels are compiled"
    for path in re.findall(r"/var/(?:lib|cache)/\w+", UNIT):
        assert Path(path).name in service["StateDirectory"] + service["CacheDirectory"], "else read-only"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="no systemd-analyze")
def test_systemd_understands_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / "tsfusion.service"
    unit.write_text(UNIT.replace("/opt/tsfusion/bin/tsfusion", "/bin/true"))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, timeout=60, check=False
    )
    assert (done.returncode, done.stdout + done.stderr) == (0, "")


def test_the_container_file_names_what_there_is() -> None:
    lines = re.sub(r"\\\n", " ", CONTAINERFILE).splitlines()
    steps = [line.split(maxsplit=1) for line in lines if line and not line.startswith("#")]
    for image in (rest for step, rest in steps if step == "FROM"):
        assert re.match(r"python:3\.\d+-slim( AS \w+)?$", image), "no registry is named"
    for rest in (rest for step, rest in steps if step == "COPY" and not rest.startswith("--from")):
        assert all((ROOT / source).exists() for source in rest.split()[:-1]), rest
    assert [rest for step, rest in steps if step == "USER"][-1] not in ("root", "0")
    for variable in re.findall(r"\b(TSFUSION_\w+)=", CONTAINERFILE):
        flag = variable.removeprefix("TSFUSION_").lower().replace("_", "-")
        assert f"--{flag} " in help_of("serve")
    (check,) = re.findall(r"CMD \[(.*\"status\".*)\]", CONTAINERFILE)
    check_command([word.strip(' "') for word in check.split(",")])


def test_every_command_of_the_guide_exists() -> None:
    text = re.sub(r"\\\n\s*", "", (DEPLOY / "README.md").read_text(encoding="utf-8"))
    blocks = re.findall(r"^```sh\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    found = 0
    for line in "".join(blocks).splitlines():
        words = shlex.split(line, comments=True)
        places = [i for i, word in enumerate(words) if Path(word).name == "tsfusion" and "/var" not in word]
        runs = [i for i in places if words[i + 1 : i + 2] and words[i + 1] in VERBS]
        for place in runs:
            stop = next((i for i in range(place, len(words)) if words[i] == "|"), len(words))
            check_command(words[place:stop])
            found += 1
    assert found >= 9
    for path in re.findall(r"\]\(([\w./-]+)\)", text):
        assert (DEPLOY / path).exists(), path


def figures_there_are() -> set[str]:
    """The names of all figures that a server can show."""
    metrics = Metrics(ServerConfig(state="/", journal_bytes=1 << 30))
    for stage in STAGES:
        metrics.observe("default", stage, 0.1)
    metrics.health = health(
        client(skipped={"thinned": 1}), refused={"gap": 1}, maps={"default": map_health()}
    )
    _, body, _ = metrics.pages["/metrics"]()
    assert isinstance(body, bytes)
    return {
        sample.name for family in text_string_to_metric_families(body.decode()) for sample in family.samples
    }


def test_alerts_and_guide_name_figures_there_are() -> None:
    there_are = figures_there_are()
    for path in (
        DEPLOY / "tsfusion-alerts.yml",
        DEPLOY / "README.md",
        ROOT / "tests" / "project" / "alerts.yml",
    ):
        named = set(re.findall(r"\btsfusion_[a-z_]+", path.read_text(encoding="utf-8")))
        unknown = {name for name in named if name not in there_are and f"{name}_count" not in there_are}
        assert named, path
        assert not unknown, f"{path.name} names {unknown}"


@pytest.mark.skipif(shutil.which("promtool") is None, reason="no promtool")
@pytest.mark.parametrize(
    ("folder", "arguments"),
    [
        (DEPLOY, ["check", "config", "prometheus.yml"]),
        (ROOT / "tests" / "project", ["test", "rules", "alerts.yml"]),
    ],
)
def test_prometheus_understands_its_files(folder: Path, arguments: list[str]) -> None:
    done = subprocess.run(
        ["promtool", *arguments], cwd=folder, capture_output=True, text=True, timeout=60, check=False
    )
    assert done.returncode == 0, done.stdout + done.stderr


def free_port() -> int:
    """A port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@pytest.fixture
def notices(tmp_path: Path) -> Iterator[list[bytes]]:
    """The notices sent to the socket `tmp_path/notify`, read as they come: unread ones fill it up."""
    notices: list[bytes] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))

        def read() -> None:
            while notice := manager.recv(4096):
                notices.append(notice)

        reader = threading.Thread(target=read, daemon=True)
        reader.start()
        yield notices
        manager.shutdown(socket.SHUT_RD)
        reader.join(timeout=DEADLINE)


def test_a_server_lives_as_its_unit_expects(tmp_path: Path, notices: list[bytes]) -> None:
    import numpy as np

    page, address = f"127.0.0.1:{free_port()}", "tcp://127.0.0.1:0"
    process = subprocess.Popen(
        [*server_command(SUMS), "serve", "--listen", address, "--state", str(tmp_path / "state"), "--json",
         "--metrics", page, "--log-format", "json", "--voxel-size", "0.05"],
        stdout=subprocess.PIPE, text=True, stdin=subprocess.DEVNULL,
        env={**environment(), "NOTIFY_SOCKET": str(tmp_path / "notify"), "WATCHDOG_USEC": "1000000"},
    )  # fmt: skip
    try:
        address = re.findall(r"tcp://[\d.:]+", read_until(process, '"ready"'))[0]
        assert eventually(lambda: bool(notices) and notices[0].startswith(b"READY=1"))
        assert eventually(lambda: get(page, "/readyz")[0] == 200)
        camera, pose = Intrinsics(40.0, 40.0, 31.5, 23.5), np.eye(4)
        with Client(address, spool=tmp_path / "spool") as scanner:
            scanner.send(
                Keyframe(depth=np.full((48, 64), 1500, np.uint16), intrinsics=camera, T_world_camera=pose)
            )
            scanner.wait_fused(timeout=DEADLINE)
        assert tsfusion("status", "--connect", address).returncode == 0
        fused = 'tsfusion_keyframe_delay_seconds_count{map="default",stage="fuse"} 1.0'
        assert eventually(lambda: fused in get(page, "/metrics")[1])
        assert eventually(lambda: b"WATCHDOG=1" in notices)
        process.send_signal(signal.SIGSTOP)
        assert tsfusion("status", "--connect", address, "--timeout", 0.5).returncode == 1
        process.send_signal(signal.SIGCONT)
        assert eventually(lambda: tsfusion("status", "--connect", address).returncode == 0)
        assert end(process) == 0
        assert eventually(lambda: any(notice.startswith(b"STOPPING=1") for notice in notices))
        kinds = (b"READY=1", b"WATCHDOG=1", b"STATUS=", b"STOPPING=1")
        assert all(notice.startswith(kinds) for notice in notices), notices
    finally:
        if process.poll() is None:
            os.kill(process.pid, signal.SIGCONT)
            end(process, signal.SIGKILL)
