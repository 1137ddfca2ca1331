# SPDX-License-Identifier: MIT
"""The ROS 1 bridge with a real master and real nodes."""

import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path

import numpy as np
import pytest
from command_processes import end, python
from keyframes_and_servers import until
from repository import ROOT, SUPPORT

from tsfusion.core.errors import JournalError
from tsfusion.geometry import se3
from tsfusion.geometry.frame import Frame
from tsfusion.geometry.keyframe import Keyframe
from tsfusion.journal.journaled_keyframes import JournalRecording
from tsfusion.scanner.localization.localizer import Lost, TrackedPose
from tsfusion.scanner.localization.pose_feed.feed import PoseFeed

BRIDGE = ROOT / "contrib" / "ros1_bridge.py"
TALKER = SUPPORT / "ros1_talker.py"
PYTHON = "/usr/bin/python3"
TENTH = 100_000_000
START = 1_700_000_000 * 1_000_000_000


def why_not() -> str:
    """Why ROS cannot be run here; empty = it can."""
    for program in (PYTHON, "/usr/bin/rosmaster"):
        if not Path(program).exists():
            return f"no {program}: apt-get install python3-rospy python3-rosmaster"
    needed = "import rospy, tf2_ros, zmq, nav_msgs.msg, sensor_msgs.msg"
    done = subprocess.run([PYTHON, "-c", needed], capture_output=True, text=True, check=False)
    last = done.stderr.strip().splitlines()[-1:] or [""]
    return last[0] and f"{last[0]}: apt-get install python3-rospy python3-tf2-ros python3-zmq"


WHY_NOT = why_not()
pytestmark = pytest.mark.skipif(bool(WHY_NOT), reason=WHY_NOT or "ROS is here")


@contextmanager
def process(*command: object, environment: dict[str, str]) -> Iterator["subprocess.Popen[str]"]:
    made = subprocess.Popen([str(word) for word in command], env=environment, text=True)
    try:
        yield made
    finally:
        end(made)


def listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.fixture
def ros(tmp_path: Path) -> Iterator[dict[str, str]]:
    """The environment of nodes that talk to a master of their own."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = {
        **{key: value for key, value in os.environ.items() if not key.startswith(("ROS", "PYTHON"))},
        "ROS_MASTER_URI": f"http://127.0.0.1:{port}",
        "ROS_IP": "127.0.0.1",
        "ROS_HOME": str(tmp_path / "ros"),
    }
    with process("/usr/bin/rosmaster", "--core", "-p", port, environment=environment):
        until(lambda: listens(port))
        yield environment


def at(tenths: float) -> Frame:
    """A frame so many tenths of a second after the talker's beginning."""
    stamp = START + round(tenths * TENTH)
    return Frame(sensor="lidar", points=np.ones((1, 3), np.float32), timestamp_ns=stamp)


def place(tenths: float) -> np.ndarray:
    return se3.exp(np.array([0, 0, 0, 0, 0, 0.1 * tenths])) + np.eye(4, k=3) * 0.2 * tenths


@pytest.mark.parametrize(
    "source",
    [
        pytest.param(["--pose", "/pose"], marks=pytest.mark.nightly),
        ["--pose", "/odometry"],
        pytest.param(
            ["--world", "odom", "--camera", "camera", "--camera-info", "/info"], marks=pytest.mark.nightly
        ),
    ],
    ids=["poses", "odometry", "tf"],
)
def test_poses_reach_the_feed(ros: dict[str, str], source: list[str]) -> None:
    with ExitStack() as stack:
        feed = stack.enter_context(PoseFeed("@tcp://127.0.0.1:0", max_gap_s=0.15, wait_s=15.0))
        stack.enter_context(
            process(PYTHON, BRIDGE, "--feed", feed.address, "--connect", *source, environment=ros)
        )
        stack.enter_context(process(PYTHON, TALKER, "poses", "tf", environment=ros))
        lap = next(n for n in (20, 60, 120) if isinstance(feed.track(at(20 * n + 10)), TrackedPose))
        for tenths, within in ((10, 1e-6), (3, 1e-6), (3.5, 1e-3)):
            found = feed.track(at(20 * lap + tenths))
            assert isinstance(found, TrackedPose), found.reason
            np.testing.assert_allclose(found.T_world_camera, place(tenths), atol=within)
        assert not feed.dropped


def test_a_lost_camera_is_said_to_be_lost(ros: dict[str, str]) -> None:
    """Calibration comes, and with it the times; tf says nothing."""
    with ExitStack() as stack:
        feed = stack.enter_context(PoseFeed("@tcp://127.0.0.1:0", max_gap_s=0.15, wait_s=0.05))
        words = ("--world", "odom", "--camera", "camera", "--camera-info", "/info")
        stack.enter_context(
            process(PYTHON, BRIDGE, "--feed", feed.address, "--connect", *words, environment=ros)
        )
        stack.enter_context(process(PYTHON, TALKER, environment=ros))

        def heard() -> bool:
            assert isinstance(feed.track(at(0)), Lost)
            return bool(feed.received)

        until(heard)
        assert not feed.dropped


def kept(spool: Path) -> list[Keyframe]:
    with suppress(JournalError):
        return list(JournalRecording(spool))
    return []


def test_keyframes_go_out(ros: dict[str, str], tmp_path: Path) -> None:
    """Under this Python, with the system's ROS behind its packages; there is no server, so that they wait."""
    behind = "import sys, runpy; sys.path.append('/usr/lib/python3/dist-packages'); "
    if python(behind + "import rospy, tf2_ros").returncode:
        pytest.skip("this Python cannot load the system's rospy")
    run = behind + f"runpy.run_path({str(BRIDGE)!r}, run_name='__main__')"
    with socket.socket() as nobody, ExitStack() as stack:
        nobody.bind(("127.0.0.1", 0))
        server, spool = f"tcp://127.0.0.1:{nobody.getsockname()[1]}", tmp_path / "spool"
        words = ["--server", server, "--spool", spool, "--world", "odom", "--camera", "camera"]
        topics = ["--camera-info", "/info", "--depth", "/depth", "--color", "/color", "--distance", "0.3"]
        environment = {**ros, "PYTHONPATH": str(ROOT)}
        bridge = stack.enter_context(
            process(sys.executable, "-c", run, *words, *topics, environment=environment)
        )
        stack.enter_context(process(PYTHON, TALKER, "tf", environment=ros))
        until(lambda: len(kept(spool)) >= 8 or bridge.poll() is not None)
        assert bridge.poll() is None
        assert end(bridge) == 0
        keyframes = kept(spool)
    for keyframe in keyframes:
        tenth = round(keyframe.T_world_camera[0, 3] / 0.2)
        assert (keyframe.timestamp_ns - START) % (20 * TENTH) == tenth * TENTH
        np.testing.assert_allclose(keyframe.T_world_camera, place(tenth), atol=1e-6)
        assert keyframe.depth is not None
        assert keyframe.depth.shape == (6, 8)
        assert (keyframe.depth == 1500 + tenth).all()
        assert keyframe.color is None or (keyframe.color == (50, 100, 200)).all()
    assert sum(keyframe.color is not None for keyframe in keyframes) >= len(keyframes) - 4
    places = np.array([keyframe.T_world_camera[0, 3] for keyframe in keyframes])
    assert (np.abs(np.diff(places)) > 0.3).all()
