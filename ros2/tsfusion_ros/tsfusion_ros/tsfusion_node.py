# SPDX-License-Identifier: MIT
"""Lifecycle node that runs `tsfusion scan ros2` and `tsfusion ros2 publish` while it is active.

tsfusion speaks DDS and Zenoh by itself, so the node holds parameters and two processes, and no messages pass
through it.
"""

import shlex
import signal
import subprocess

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.lifecycle import LifecycleNode, LifecycleState, TransitionCallbackReturn

DEFAULTS: dict[str, str | float] = {
    "command": "tsfusion",  # of the environment in which tsfusion is installed
    "server": "tcp://127.0.0.1:5555",
    "map": "default",
    "transport": "",  # dds or zenoh; empty: what is installed
    "router": "",
    "localizer": "given",  # poses of tf or odometry; rgbd, stereo or lidar finds them
    "depth_topic": "",  # empty topics are found by type and name
    "color_topic": "",
    "points_topic": "",
    "pose_topic": "",
    "world_frame": "",
    "slice_low": 0.1,
    "slice_high": 1.8,
    "up": "z",
}
OPTIONS = ("transport", "router", "depth_topic", "color_topic", "points_topic", "pose_topic", "world_frame")
WATCH_S, END_S = 1.0, 30.0


def commands(given: dict[str, str | float]) -> list[list[str]]:
    """Return the command lines of the scan and of the publisher."""
    program, server = shlex.split(str(given["command"])), ["--map", str(given["map"])]
    options = [word for name in OPTIONS if given[name] for word in ("--option", f"{name}={given[name]}")]
    scan = ["scan", "ros2", "--connect", str(given["server"]), "--localizer", str(given["localizer"])]
    links = [word for name in OPTIONS[:2] if given[name] for word in (f"--{name}", str(given[name]))]
    heights = ["--slice", str(given["slice_low"]), str(given["slice_high"]), "--up", str(given["up"])]
    publish = ["ros2", "publish", str(given["server"])]
    return [[*program, *scan, *server, *options], [*program, *publish, *server, *links, *heights]]


class TsfusionNode(LifecycleNode):
    """Node with the states of REP 2002's lifecycle; active means that both processes run."""

    def __init__(self) -> None:
        super().__init__("tsfusion")
        for name, default in DEFAULTS.items():
            self.declare_parameter(name, default)
        self._commands: list[list[str]] = []
        self._processes: list[subprocess.Popen[bytes]] = []
        self.create_timer(WATCH_S, self.watch)

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._commands = commands({name: self.get_parameter(name).value for name in DEFAULTS})
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        try:
            for command in self._commands:
                # Ctrl-C reaches the node alone: a second one would end a scan before it is saved
                self._processes.append(subprocess.Popen(command, start_new_session=True))
        except OSError as error:
            self.get_logger().error(f"{command[0]} cannot be started: {error} (parameter `command`)")
            self._end()
            return TransitionCallbackReturn.FAILURE
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._end()
        return super().on_deactivate(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        self._end()
        return TransitionCallbackReturn.SUCCESS

    def watch(self) -> None:
        """Say that a process has ended by itself; its own last line says why."""
        for process in [*self._processes]:
            if process.poll() is not None:
                self._processes.remove(process)
                words = " ".join(process.args[1:3])
                self.get_logger().error(f"tsfusion {words} has ended with status {process.returncode}")

    def _end(self) -> None:
        for process in self._processes:
            process.send_signal(signal.SIGINT)
        for process in self._processes:
            try:
                process.wait(END_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
        self._processes.clear()


def main() -> None:
    rclpy.init()
    node = TsfusionNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node._end()
        node.destroy_node()
