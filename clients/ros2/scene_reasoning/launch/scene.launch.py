"""Start the node with the parameters of config/scene.yaml and the topic of a detector.

Usage:
    ros2 launch scene_reasoning scene.launch.py detections:=/my_detector/detections
"""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node


def generate_launch_description() -> LaunchDescription:
    share = Path(get_package_share_directory("scene_reasoning"))
    return LaunchDescription(
        [
            DeclareLaunchArgument("detections", default_value="/detections"),
            DeclareLaunchArgument("url", default_value="http://127.0.0.1:8000"),
            DeclareLaunchArgument("params", default_value=str(share / "config" / "scene.yaml")),
            Node(
                package="scene_reasoning",
                executable="scene",
                name="scene",
                parameters=[
                    LaunchConfiguration("params"),
                    {"url": LaunchConfiguration("url")},
                ],
                remappings=[("detections", LaunchConfiguration("detections"))],
            ),
        ]
    )
