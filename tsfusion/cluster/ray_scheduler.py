# SPDX-License-Identifier: MIT
"""Schedule jobs by Ray (extra `ray`), on an existing cluster or on a cluster of this machine.

Workers on other machines need tsfusion, and the results' folder under the same path.
"""

import logging
import os
import secrets
import socket
from collections.abc import Iterator, Sequence
from typing import Any

import msgspec

from tsfusion.cluster.jobs import AnyJob, JobDone, JobFailed, JobLost, JobMessage
from tsfusion.core.errors import MissingDependency, TransportError

_TICK_S = 1.0
_CONNECT_S = 10.0
_QUIET = {
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",  # else Ray warns of GPUs that are not used
    "RAY_USAGE_STATS_ENABLED": "0",  # else Ray sends usage statistics to its makers
}
# For a cluster started here. Ray reads these variables when it is imported.
OWN = {
    "RAY_AUTH_MODE": "token",
    "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "0",  # then Ray listens on loopback, on Linux, too
}


class RayCluster:
    """A scheduler with Ray as its engine. Ray finds room for workers, and replaces a worker that dies.

    Args:
        workers: most jobs at the same time; Ray gives each a core.
        address: address of a cluster, `auto` or `ray://HOST:PORT`. None = a cluster is started here and ends
            with this process. It listens on loopback and needs a token that only its own processes know.

    Raises:
        MissingDependency: without Ray.
        TransportError: when there is no cluster at `address`.
    """

    name = "ray"

    def __init__(self, workers: int, address: str | None = None) -> None:
        for variable, value in _QUIET.items():
            os.environ.setdefault(variable, value)
        if address is None:
            os.environ.update(OWN)
            os.environ.setdefault("RAY_AUTH_TOKEN", secrets.token_hex(32))
        try:
            import ray
        except ImportError as error:
            raise MissingDependency(
                f"a Ray cluster needs another package ({error}): run `pip install '.[ray]'` in a clone"
            ) from error
        self.workers = workers
        self._ray: Any = ray
        own = {"num_cpus": workers, "include_dashboard": False} if address is None else {}
        try:
            _check_reachable(address)
            ray.init(address=address or "local", log_to_driver=False, logging_level=logging.ERROR, **own)
        except (OSError, ValueError, RuntimeError) as error:
            raise TransportError(f"there is no Ray cluster at {address}: {error}") from error
        # One attempt: `CarryingOut` counts lost jobs and repeats them, for every engine.
        self._do = ray.remote(num_cpus=1, max_retries=0, num_returns="streaming")(_do)
        self._under_way: dict[Any, str] = {}

    def start(self, job: AnyJob) -> None:
        self._under_way[self._do.options(num_cpus=job.threads).remote(msgspec.msgpack.encode(job))] = job.name

    def wait(self) -> Sequence[JobMessage]:
        ready: list[Any] = []
        while not ready:
            ready, _ = self._ray.wait(list(self._under_way), num_returns=1, timeout=_TICK_S)
        return [self._next(one) for one in ready]

    def _next(self, under_way: Any) -> JobMessage:
        try:
            message: JobMessage = msgspec.msgpack.decode(self._ray.get(next(under_way)), type=JobMessage)
        except StopIteration:
            message = JobLost(self._under_way[under_way], "it ended without a result")
        except self._ray.exceptions.RayError as error:
            message = JobLost(
                self._under_way[under_way], f"{type(error).__name__}: {str(error).splitlines()[0]}"
            )
        if isinstance(message, JobDone | JobFailed | JobLost):
            del self._under_way[under_way]
        return message

    def close(self) -> None:
        for under_way in self._under_way:
            self._ray.cancel(under_way, force=True)
        self._under_way.clear()
        self._ray.shutdown()


def _check_reachable(address: str | None) -> None:
    """Raise OSError if nobody listens at HOST:PORT, because Ray itself would try for minutes."""
    host, colon, port = (address or "").removeprefix("ray://").rpartition(":")
    if colon and port.isdigit():
        socket.create_connection((host.strip("[]"), int(port)), _CONNECT_S).close()


def _do(encoded: bytes) -> Iterator[bytes]:
    """Do a job, encoded by msgpack, on the machine that Ray chose; yield its messages, encoded."""
    from tsfusion.cluster import job_runner

    for message in job_runner.run(msgspec.msgpack.decode(encoded, type=AnyJob)):
        yield msgspec.msgpack.encode(message)
