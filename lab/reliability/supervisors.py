# SPDX-License-Identifier: MIT
"""A server and a scanner that are started again whenever they end, as an init system would."""

import contextlib
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path
from typing import Any

import msgspec
from bad_network import Proxy
from keyframes_and_servers import Server, until

from lab.reliability.scanner_process import LOST, Plan, Report

SCANNER = Path(__file__).with_name("scanner_process.py")
PATIENCE = 180.0  # seconds; for everything to be fused after all


class Daemon:
    """Keeps a server running, as an init system would, and shows the proxy where it is.

    Args:
        proxy: None = the settings name an address that lasts.
    """

    def __init__(self, state: Path, proxy: Proxy | None, **settings: Any) -> None:
        self.exits: list[str] = []
        self.ready = False
        self.state, self._proxy, self._settings = state, proxy, settings
        self._ended = False
        self._killed = False
        self.server = self._start()
        self._thread = threading.Thread(target=self._keep)
        self._thread.start()

    def _start(self) -> Server:
        return Server(self.state, wait=False, **self._settings)

    def _keep(self) -> None:
        while True:
            if self.server.wait_ready():
                self._show(self.server.address, self.server.control)
                self.ready = True
                self.server.process.wait()
            self.ready = False
            self._show(None)
            if self._ended:
                return
            if not self._killed:
                self.exits.append(self.server.stderr_text()[-500:])
            self._killed = False
            self.server.close()
            self.server = self._start()

    def _show(self, data: str | None, control: str | None = None) -> None:
        if self._proxy is not None:
            self._proxy.target(data, control)

    def kill(self) -> None:
        """SIGKILL, ready or not. A fuser that still runs dies with it."""
        server = self.server
        self._killed = True
        server.process.kill()
        until(lambda: self.server is not server)

    def kill_fuser(self) -> None:
        """SIGKILL to the fuser, once there is one."""

        def killed() -> bool:
            with contextlib.suppress(OSError, AssertionError):
                os.kill(self.server.fuser_pid(), signal.SIGKILL)
                return True
            return False

        until(killed)

    def stop(self) -> int:
        """SIGTERM: drain, checkpoint, end. The exit status."""
        until(lambda: self.ready, PATIENCE)
        self._ended = True
        self.server.process.terminate()
        return self.server.process.wait(PATIENCE)

    def close(self) -> None:
        self._ended = True
        self.server.process.kill()
        self._thread.join()
        self.server.close()


class Scanner:
    """Starts a scanner again and again until one has seen everything fused."""

    def __init__(self, plan: Plan) -> None:
        self.plan = plan
        self.problem = ""
        self._done = threading.Event()
        self._ended = self._killed = False
        self._process = self._start()
        self._thread = threading.Thread(target=self._keep)
        self._thread.start()

    def _start(self) -> "subprocess.Popen[str]":
        command = [sys.executable, str(SCANNER), msgspec.json.encode(self.plan).decode()]
        return subprocess.Popen(command, stderr=subprocess.PIPE, text=True)

    def _keep(self) -> None:
        while True:
            _, words = self._process.communicate()
            if self._process.returncode == 0 or self._ended:
                break
            if not self._killed or self._process.returncode == LOST:
                self.problem = f"the scanner ended with status {self._process.returncode}: {words[-1000:]}"
                break
            self._killed = False
            self._process = self._start()
        self._done.set()

    def kill(self) -> None:
        """SIGKILL; it is started again. One that has finished cannot be killed."""
        process = self._process
        self._killed = True
        process.kill()
        until(lambda: self._process is not process or self._done.is_set())

    @property
    def taken(self) -> int:
        """Number of keyframes that all its processes logged as taken."""
        assert self.plan.log is not None
        log = Path(self.plan.log)
        return len(log.read_bytes().split()) if log.exists() else 0

    @property
    def finished(self) -> bool:
        """True once it will not be started again."""
        return self._done.is_set()

    def wait(self) -> None:
        """Wait until everything is fused or something is wrong."""
        if not self._done.wait(PATIENCE):
            self.problem = f"not everything was fused in {PATIENCE:.0f} s"

    @property
    def pid(self) -> int:
        """The process that runs now, or ran last."""
        return self._process.pid

    def report(self) -> Report:
        """Report of the process that saw everything fused."""
        assert self.plan.report is not None
        return msgspec.json.decode(Path(self.plan.report).read_bytes(), type=Report)

    def close(self) -> None:
        self._ended = True
        self._process.kill()
        self._thread.join()
