# SPDX-License-Identifier: MIT
"""The colcon package `ros2/tsfusion_ros`, with a stand-in for rclpy: ROS is not installed here."""

import ast
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from enum import Enum
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import typer
from repository import ROOT

pytest.importorskip("rosbags", reason="extra ros2")
yaml = pytest.importorskip("yaml")
PACKAGE = ROOT / "ros2" / "tsfusion_ros"
SHOWN = {  # RViz's displays → what they show
    "Marker": "visualization_msgs/msg/Marker",
    "PointCloud2": "sensor_msgs/msg/PointCloud2",
    "Map": "nav_msgs/msg/OccupancyGrid",
    "Path": "nav_msgs/msg/Path",
    "Pose": "geometry_msgs/msg/PoseStamped",
}


class Node:
    """A stand-in for rclpy's LifecycleNode, as far as the node uses it."""

    def __init__(self, name: str) -> None:
        self.name, self.parameters, self.errors = name, dict[str, Any](), list[str]()

    def declare_parameter(self, name: str, default: Any) -> None:
        self.parameters[name] = type("Parameter", (), {"value": default})

    def get_parameter(self, name: str) -> Any:
        return self.parameters[name]

    def create_timer(self, seconds: float, call: Any) -> None:
        self.timer = call

    def get_logger(self) -> Any:
        return type("Logger", (), {"error": staticmethod(self.errors.append)})

    def on_activate(self, state: Any) -> Any:
        return Answer.SUCCESS

    on_deactivate = on_activate


class Answer(Enum):
    SUCCESS, FAILURE = 0, 1


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    rclpy, lifecycle, executors = (
        ModuleType(name) for name in ("rclpy", "rclpy.lifecycle", "rclpy.executors")
    )
    lifecycle.LifecycleNode, lifecycle.LifecycleState = Node, object  # type: ignore[attr-defined]
    lifecycle.TransitionCallbackReturn = Answer  # type: ignore[attr-defined]
    executors.ExternalShutdownException = RuntimeError  # type: ignore[attr-defined]
    for module in (rclpy, lifecycle, executors):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    made = ModuleType("tsfusion_node")
    file = PACKAGE / "tsfusion_ros" / "tsfusion_node.py"
    exec(compile(file.read_text(), str(file), "exec"), made.__dict__)
    return made


def parsed(command: list[str]) -> dict[str, Any]:
    """A command line, as tsfusion itself reads it."""
    from tsfusion import cli

    found: Any = typer.main.get_command(cli.app)
    words = command[1:]
    context = None
    while hasattr(found, "commands"):
        found, context = found.commands[words.pop(0)], None
    return dict(found.make_context("tsfusion", words, parent=context).params)


def test_parameters_become_command_lines(node_module: ModuleType) -> None:
    given = node_module.DEFAULTS | {
        "transport": "zenoh", "router": "tcp/robot:7447", "depth_topic": "/depth", "map": "yard", "up": "-y"
    }  # fmt: skip
    scan, publish = map(parsed, node_module.commands(given))
    assert (scan["source"], scan["connect"], scan["map_"], scan["localizer"]) == (
        "ros2", "tcp://127.0.0.1:5555", "yard", "given"
    )  # fmt: skip
    assert [*scan["option"]] == ["transport=zenoh", "router=tcp/robot:7447", "depth_topic=/depth"]
    assert (publish["server"], publish["map_"], publish["transport"]) == (
        "tcp://127.0.0.1:5555",
        "yard",
        "zenoh",
    )
    assert (publish["slice_"], publish["up"], publish["router"]) == ((0.1, 1.8), "-y", "tcp/robot:7447")


def test_both_processes_run_while_the_node_is_active(node_module: ModuleType) -> None:
    node = node_module.TsfusionNode()
    node.declare_parameter("command", f"{sys.executable} -c 'import time; time.sleep(600)'")
    assert node.on_configure(None) == Answer.SUCCESS
    assert node.on_activate(None) == Answer.SUCCESS
    processes = [*node._processes]
    assert [process.poll() for process in processes] == [None, None]
    processes[0].kill()
    processes[0].wait()
    node.timer()
    assert "has ended with status -9" in node.errors[0]
    assert node.on_deactivate(None) == Answer.SUCCESS
    assert processes[1].poll() is not None


def test_a_missing_command_is_said(node_module: ModuleType) -> None:
    node = node_module.TsfusionNode()
    node.declare_parameter("command", "/nowhere/tsfusion")
    node.on_configure(None)
    assert node.on_activate(None) == Answer.FAILURE
    assert "/nowhere/tsfusion cannot be started" in node.errors[0]


def test_parameters_of_the_file_are_those_of_the_node(node_module: ModuleType) -> None:
    own = yaml.safe_load((PACKAGE / "config" / "tsfusion.yaml").read_text())["tsfusion"]["ros__parameters"]
    for name, value in own.items():
        assert (value, type(value)) == (node_module.DEFAULTS[name], type(node_module.DEFAULTS[name]))


def test_configurations_name_what_is_published() -> None:
    from tsfusion.pipelines.shown import ros2_view

    views = yaml.safe_load((PACKAGE / "rviz" / "tsfusion.rviz").read_text())["Visualization Manager"]
    assert views["Global Options"]["Fixed Frame"] == ros2_view.FLAT
    checked = 0
    for display in views["Displays"]:
        if "Topic" in display:
            topic, kind = display["Topic"]["Value"], SHOWN[display["Class"].rpartition("/")[2]]
            assert ros2_view._KINDS.get(topic, kind) == kind
            latched = display["Topic"]["Durability Policy"] == "Transient Local"
            assert latched == topic.endswith(ros2_view._LATCHED)
            checked += 1
    assert checked == 5
    nav2 = yaml.safe_load((PACKAGE / "config" / "nav2_costmap.yaml").read_text())
    layer = nav2["global_costmap"]["global_costmap"]["ros__parameters"]["static_layer"]
    assert ros2_view._KINDS[layer["map_topic"]] == "nav_msgs/msg/OccupancyGrid"
    assert layer["map_subscribe_transient_local"] is True


def test_messages_are_the_same_from_humble_to_jazzy() -> None:
    """Bytes of one are those of the other, and so are the keys of Zenoh."""
    from rosbags.typesys import Stores, get_typestore

    from tsfusion.datasets.ros2.middleware import message_types
    from tsfusion.pipelines.shown import ros2_view
    from tsfusion.scanner.sources import ros2_topics

    kinds = {
        *ros2_view._KINDS.values(),
        *ros2_topics._KINDS,
        "nav_msgs/msg/Path",
        "geometry_msgs/msg/PoseStamped",
    }
    assert len(kinds) > 12
    for name in ("ROS2_IRON", "ROS2_JAZZY"):
        store = get_typestore(Stores[name])
        for kind in kinds:
            assert store.hash_rihs01(kind) == message_types().hash_rihs01(kind), (name, kind)


def test_the_package_is_whole() -> None:
    described = ET.parse(PACKAGE / "package.xml").getroot()
    name = described.findtext("name")
    assert (PACKAGE / "resource" / str(name)).is_file()
    needed = {str(one.text) for one in described.iter("exec_depend")}
    imported: set[str] = set()
    for file in (*PACKAGE.rglob("*.py"),):
        for one in ast.walk(ast.parse(file.read_text())):
            if isinstance(one, ast.ImportFrom):
                imported.add(str(one.module).partition(".")[0])
            elif isinstance(one, ast.Import):
                imported |= {each.name.partition(".")[0] for each in one.names}
    assert imported - set(sys.stdlib_module_names) - {"setuptools"} == needed
    assert not any("tsfusion_ros" in path.read_text() for path in Path(ROOT, "tsfusion").rglob("*.py"))
