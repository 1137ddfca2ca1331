# SPDX-License-Identifier: MIT
"""Ray does the jobs: the same map, also where a worker of it is killed."""

import os
import signal
import socket
import subprocess
import sys
import threading
from importlib.util import find_spec
from pathlib import Path

import pytest
from command_processes import Here, descendants, eventually
from silent_display import Silent

from tsfusion import Volume
from tsfusion.cluster import fusion, keyframe_sources, ray_scheduler
from tsfusion.cluster.ray_scheduler import RayCluster
from tsfusion.core.config import VolumeConfig
from tsfusion.core.errors import TransportError

if find_spec("ray") is None:
    pytest.skip("Ray is not installed: pip install '.[ray]'", allow_module_level=True)
os.environ |= ray_scheduler.OWN  # Ray reads them once a process
os.environ["RAY_AUTH_TOKEN"] = TOKEN = "0123456789abcdef" * 4
# Ray's own: sockets and files of a cluster that ends with the process
pytestmark = [pytest.mark.filterwarnings("ignore"), pytest.mark.nightly]

CONFIG = VolumeConfig(voxel_size=0.03, threads=1)


def doing() -> list[int]:
    """The processes in which Ray does a job now."""
    found = []
    for pid in descendants(os.getpid()):
        try:
            name = Path(f"/proc/{pid}/cmdline").read_bytes()
        except OSError:
            continue
        if name.startswith(b"ray::_do"):
            found.append(pid)
    return found


def test_a_killed_worker_is_replaced_by_ray(tmp_path: Path) -> None:
    found = keyframe_sources.listed(["synthetic:room"], options={"count": 24})
    killed: list[int] = []

    def kill() -> None:
        if eventually(lambda: bool(doing()), 90.0):
            killed.append(doing()[0])
            os.kill(killed[0], signal.SIGKILL)

    killer = threading.Thread(target=kill)
    killer.start()
    run = fusion.fuse(found, CONFIG, tmp_path / "out", lambda: RayCluster(2), Silent())
    killer.join()
    whole = Volume(CONFIG)
    for keyframe in keyframe_sources.reading(found.keyframes):
        whole.integrate(keyframe())
    assert (run.scheduler, run.map_hash, run.keyframes_fused) == ("ray", whole.map_hash(), 24)
    assert (len(killed), run.workers_lost) == (1, 1)
    assert not doing()


def test_a_node_that_is_killed_takes_no_keyframe_along(tmp_path: Path) -> None:
    """Two nodes, each with a raylet and workers of its own as two machines have them; one ends at its job."""
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
    try:
        other = cluster.add_node(num_cpus=1)
        found = keyframe_sources.listed(["synthetic:room"], options={"count": 24})
        killed: list[int] = []

        def kill() -> None:
            if eventually(lambda: len(doing()) == 2, 120.0):  # a core each: one on each node
                killed.extend(doing())
                cluster.remove_node(other, allow_graceful=False)

        killer = threading.Thread(target=kill)
        killer.start()
        run = fusion.fuse(found, CONFIG, tmp_path / "out", lambda: RayCluster(2, cluster.address), Silent())
        killer.join()
    finally:
        cluster.shutdown()
    whole = Volume(CONFIG)
    for keyframe in keyframe_sources.reading(found.keyframes):
        whole.integrate(keyframe())
    assert len(killed) == 2
    assert (run.map_hash, run.keyframes_fused) == (whole.map_hash(), 24)
    assert run.workers_lost >= 1


def test_another_user_of_the_machine_is_refused() -> None:
    """The cluster is on loopback, where every user of a machine is, and asks for a token."""
    cluster = RayCluster(1)
    try:
        import ray

        host, _, port = ray.get_runtime_context().gcs_address.rpartition(":")
        assert host == "127.0.0.1"
        with socket.socket() as elsewhere:  # a port of ours on another address is free
            elsewhere.bind(("127.0.0.2", int(port)))
        for token in ("", "f" * 64, TOKEN):
            code = f"import ray; ray.init(address='{host}:{port}', log_to_driver=False); print('in')"
            clean = {name: one for name, one in os.environ.items() if not name.startswith("RAY_AUTH")}
            mode = {"RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": token} if token else {}
            done = subprocess.run(
                [sys.executable, "-c", code],
                check=False, env=clean | mode, capture_output=True, text=True, timeout=120,
            )  # fmt: skip
            assert (done.returncode == 0, "in" in done.stdout.split()) == (token == TOKEN,) * 2, done.stderr
    finally:
        cluster.close()


def test_a_cluster_that_is_not_there_is_told() -> None:
    with pytest.raises(TransportError, match="there is no Ray cluster"):
        RayCluster(1, "127.0.0.1:9")


def test_the_command_asks_for_ray(here: Here, tmp_path: Path) -> None:
    done = here(
        "fuse", "synthetic:room", "--option", "count=6", "--voxel-size", 0.06, "--ray", "--workers", 2
    )
    assert done.returncode == 0, done.stderr
    assert "by 2 workers" in done.stdout
