# SPDX-License-Identifier: MIT
"""Start the node, bring it to its active state, and RViz if it is wanted.

`ros2 launch tsfusion_ros tsfusion.launch.py server:=tcp://robot:5555 rviz:=true`
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, EmitEvent, RegisterEventHandler
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import LifecycleNode, Node
from launch_ros.event_handlers import OnStateTransition
from launch_ros.events.lifecycle import ChangeState
from launch_ros.substitutions import FindPackageShare
from lifecycle_msgs.msg import Transition


def generate_launch_description() -> LaunchDescription:
    share = FindPackageShare("tsfusion_ros")
    params = PathJoinSubstitution([share, "config", "tsfusion.yaml"])
    looks = PathJoinSubstitution([share, "rviz", "tsfusion.rviz"])
    node = LifecycleNode(
        package="tsfusion_ros", executable="tsfusion_node", name="tsfusion", namespace="", output="screen",
        parameters=[LaunchConfiguration("params"), {"server": LaunchConfiguration("server")}],
    )  # fmt: skip

    def change(transition: int) -> EmitEvent:
        return EmitEvent(
            event=ChangeState(lifecycle_node_matcher=lambda one: one is node, transition_id=transition)
        )

    activate = OnStateTransition(
        target_lifecycle_node=node, goal_state="inactive", start_state="configuring",
        entities=[change(Transition.TRANSITION_ACTIVATE)],
    )  # fmt: skip
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", looks],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription([
        DeclareLaunchArgument("server", default_value="tcp://127.0.0.1:5555"),
        DeclareLaunchArgument("params", default_value=params),
        DeclareLaunchArgument("rviz", default_value="false"),
        node,
        RegisterEventHandler(activate),
        change(Transition.TRANSITION_CONFIGURE),
        rviz,
    ])  # fmt: skip
