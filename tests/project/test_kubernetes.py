# SPDX-License-Identifier: MIT
"""The Kubernetes example fits the schemas, and what it starts serves a fleet and is upgraded one by one."""

import json
import re
import signal
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from command_processes import COMMAND, end, environment, read_until
from keyframes_and_servers import DEADLINE, lasting_address, wall
from repository import ROOT

from tsfusion import Client
from tsfusion.core.config import ClientConfig, load
from tsfusion.wire.asking import queries
from tsfusion.wire.keys import key_folder
from tsfusion.wire.sockets.curve import client_keys

_FUSER = f"""
import sys
sys.path.insert(0, {str(ROOT / "tests" / "support")!r})
import sum_map
sum_map.take_the_place_of_volume()
from tsfusion.fuser.__main__ import main
sys.exit(main())
"""
_QUICK = f"""
import sys
from tsfusion.gateway.ports import fuser_process
fuser_process.COMMAND = (sys.executable, "-c", {_FUSER!r})
from tsfusion.__main__ import main
main()
"""
QUICK = [sys.executable, "-c", _QUICK]  # the command with fusers that start without Taichi
FILE = ROOT / "docs" / "deploy" / "kubernetes.yml"


@pytest.fixture(scope="module")
def objects() -> dict[str, dict[str, Any]]:
    """The objects of the example, by kind."""
    yaml = pytest.importorskip("yaml")
    return {one["kind"]: one for one in yaml.safe_load_all(FILE.read_text(encoding="utf-8"))}


def test_the_example_fits_the_schemas(objects: dict[str, dict[str, Any]]) -> None:
    validator = pytest.importorskip("kubernetes_validate")
    for one in objects.values():
        validator.validate(one, validator.latest_version(), strict=True)
    assert len(objects) == 5
    wrong = json.loads(json.dumps(objects["StatefulSet"]))
    wrong["spec"]["replicas"] = "two"
    with pytest.raises(validator.ValidationError):
        validator.validate(wrong, validator.latest_version(), strict=True)


def test_names_and_places_agree(objects: dict[str, dict[str, Any]]) -> None:
    pod = objects["StatefulSet"]["spec"]["template"]["spec"]
    volumes = {one["name"] for one in pod["volumes"]} | {"state"}
    for container in (*pod["initContainers"], *pod["containers"]):
        assert {one["name"] for one in container["volumeMounts"]} <= volumes
    (server,) = pod["containers"]
    mounted = {one["mountPath"] for one in server["volumeMounts"]}
    for path in re.findall(r'"(/\w+)', objects["ConfigMap"]["data"]["server.toml"]):
        assert path in mounted
    assert objects["Service"]["metadata"]["name"] == objects["StatefulSet"]["spec"]["serviceName"]
    listening = [one["containerPort"] for one in server["ports"]]
    assert listening == [one["port"] for one in objects["Service"]["spec"]["ports"]]


class Pod:
    """Server that the example starts, as a process of this machine."""

    def __init__(
        self, objects: dict[str, dict[str, Any]], folder: Path, name: str, command: list[str]
    ) -> None:
        self.address = lasting_address()
        (container,) = objects["StatefulSet"]["spec"]["template"]["spec"]["containers"]
        settings = objects["ConfigMap"]["data"]["server.toml"]
        for place in ("/state", "/keys", "/directory"):
            own = folder / (name if place == "/state" else "shared") / place[1:]
            own.parent.mkdir(parents=True, exist_ok=True)
            settings = settings.replace(f'"{place}', f'"{own}')
        (folder / "shared" / "directory").mkdir(exist_ok=True)
        config = folder / f"{name}.toml"
        config.write_text(settings, encoding="utf-8")
        load(config)
        arguments = [one.replace("/config/server.toml", str(config)) for one in container["args"]]
        arguments = [re.sub(r"tcp://.+", self.address, one) for one in arguments]
        self._command = [*command, *arguments, "--json"]
        self.start()

    def start(self) -> None:
        self.process = subprocess.Popen(
            self._command, stdout=subprocess.PIPE, stdin=subprocess.DEVNULL, text=True, env=environment()
        )

    def wait_ready(self) -> None:
        read_until(self.process, '"ready"')

    def close(self) -> None:
        if self.process.poll() is None:
            end(self.process, signal.SIGKILL)


@pytest.mark.parametrize("command", [QUICK, pytest.param(COMMAND, marks=pytest.mark.nightly)])
def test_its_processes_serve_a_fleet_that_is_upgraded_one_by_one(
    objects: dict[str, dict[str, Any]], tmp_path: Path, command: list[str]
) -> None:
    keys = tmp_path / "shared" / "keys" / "fleet"
    keys.parent.mkdir(parents=True)
    key_folder.create_pair(keys, "server")
    key_folder.allow(keys, "robot", key_folder.create_pair(tmp_path / "robot", "robot").public)
    key_folder.allow(keys, "robot", forget=True)
    key, server_key = tmp_path / "robot" / "robot.key_secret", keys / "server.key"
    known = client_keys(str(key), str(server_key))
    with ExitStack() as stack:
        pods = [Pod(objects, tmp_path, name, command) for name in ("tsfusion-0", "tsfusion-1")]
        for pod in pods:
            stack.callback(pod.close)
            pod.wait_ready()

        def client(map_name: str) -> Client:
            # Both know the first server only.
            made = Client(
                pods[0].address, spool=tmp_path / map_name, map=map_name, key=key, server_key=server_key,
                config=ClientConfig(stall_timeout=0.5),
            )  # fmt: skip
            stack.callback(made.close)
            return made

        clients = [client("yard"), client("house")]
        for one in clients:
            one.send(wall(0))
            one.flush(DEADLINE)
        assert queries.move_map("house", pods[0].address, pods[1].address, keys=known).nbytes > 0
        for number, pod in enumerate(pods, start=1):  # as `kubectl rollout restart` does it
            assert end(pod.process) == 0
            pod.start()
            for one in clients:
                one.send(wall(number))
            pod.wait_ready()
            for one in clients:
                one.flush(DEADLINE)
        for one in clients:
            one.send(wall(3))
            one.wait_fused(DEADLINE)
        found = [queries.fetch_health(pod.address, keys=known).maps for pod in pods]
        assert (found[0]["yard"].keyframes_fused, found[1]["house"].keyframes_fused) == (4, 4)
        assert "house" not in found[0]
        assert "yard" not in found[1]
