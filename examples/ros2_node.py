"""A ROS 2 node that publishes which detections do not belong to the room.

    python3 examples/ros2_node.py --ros-args -r detections:=/my_detector/detections

clients/ros2/scene_reasoning is the complete node, with parameters, markers and diagnostics.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import rclpy
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import qos_profile_sensor_data
from std_msgs.msg import String
from vision_msgs.msg import Detection3DArray

from scene_client import Client, ClientError
from scene_client.ros_fields import MessageError
from scene_client.vision_msgs import from_detection3d_array


class Watcher(Node):
    """Ask about detections in a thread, so that no callback waits for the service."""

    def __init__(self) -> None:
        super().__init__("watcher")
        self.scene = Client(os.environ.get("SCENE_URL", "http://127.0.0.1:8000"), timeout=0.5)
        self.thread = ThreadPoolExecutor(max_workers=1)
        self.asked = self.thread.submit(lambda: None)
        self.outliers = self.create_publisher(String, "~/outliers", 1)
        self.create_subscription(
            Detection3DArray, "detections", self.on_detections, qos_profile_sensor_data
        )

    def on_detections(self, message: Detection3DArray) -> None:
        """Ask, unless the service still answers about an earlier message."""
        if self.asked.done():
            self.asked = self.thread.submit(self.ask, message)

    def ask(self, message: Detection3DArray) -> None:
        """Publish the ids of the outliers, separated by commas."""
        try:
            answer = self.scene.outliers(**from_detection3d_array(message), detail="scores")
        except (ClientError, MessageError) as error:
            self.get_logger().warning(f"{type(error).__name__}: {error}")
            return
        names = [thing.object for thing in answer.outliers if thing.is_outlier]
        self.outliers.publish(String(data=",".join(names)))


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Watcher())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
