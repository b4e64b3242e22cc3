"""Launch the tracker on the topics of a camera; arguments that are not given leave the parameters to the file."""

from __future__ import annotations

from typing import Any

import yaml
from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TOPICS = {
    "image": "/camera/camera/color/image_raw",
    "depth": "/camera/camera/aligned_depth_to_color/image_raw",
    "camera_info": "/camera/camera/color/camera_info",
}
"""Topics of the node, and where a RealSense camera has them."""

PARAMETERS = (
    *("weights", "monitor", "device", "alpha", "alpha_frames", "labels", "texts", "points", "discover", "online_s"),
    *("threshold", "use_depth", "image_transport", "depth_transport", "depth_scale_m", "sync_s", "world_frame"),
    *("marker_m", "use_sim_time"),
)
"""Parameters of the node, which are arguments too; values are written as in YAML."""


def generate_launch_description() -> LaunchDescription:
    """The node with its topics, a file of parameters, and parameters that overrule the file."""
    config = PathJoinSubstitution([FindPackageShare("quest_ros"), "config", "track.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("name", default_value="quest", description="name of the node"),
            DeclareLaunchArgument("params_file", default_value=config, description="file of parameters"),
            *(DeclareLaunchArgument(name, default_value=at, description="topic") for name, at in TOPICS.items()),
            *(DeclareLaunchArgument(name, default_value="", description="as in the file") for name in PARAMETERS),
            OpaqueFunction(function=_node),
        ]
    )


def _node(context: LaunchContext) -> list[Any]:
    given = {name: LaunchConfiguration(name).perform(context) for name in PARAMETERS}
    overruled = {name: yaml.safe_load(value) for name, value in given.items() if value}
    return [
        Node(
            package="quest_ros",
            executable="track",
            name=LaunchConfiguration("name"),
            output="screen",
            parameters=[LaunchConfiguration("params_file"), *([overruled] if overruled else [])],
            remappings=[(name, LaunchConfiguration(name)) for name in TOPICS],
        )
    ]
