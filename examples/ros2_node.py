"""A ROS 2 node that publishes which things do not belong to the room.

    python3 examples/ros2_node.py --ros-args -r detections:=/my_detector/detections

The robot stands still; clients/ros2/scene_reasoning is the complete node, for a moving robot.
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

from scene_client import Client, ClientError, Home
from scene_client.ros_fields import MessageError
from scene_client.vision_msgs import from_detection3d_array


class Watcher(Node):
    """Update a home in a thread, so that no callback waits for the service."""

    def __init__(self) -> None:
        super().__init__("watcher")
        self.scene = Client(os.environ.get("SCENE_URL", "http://127.0.0.1:8000"), timeout=1.0)
        self.home = Home(self.scene)
        self.thread = ThreadPoolExecutor(max_workers=1)
        self.updated = self.thread.submit(lambda: None)
        self.events = self.create_publisher(String, "~/events", 10)
        self.create_subscription(
            Detection3DArray, "detections", self.on_detections, qos_profile_sensor_data
        )

    def on_detections(self, message: Detection3DArray) -> None:
        """Update the home, unless it is still busy with an earlier message."""
        if self.updated.done():
            self.updated = self.thread.submit(self.update, message)

    def update(self, message: Detection3DArray) -> None:
        """Publish each change as kind and label, such as `out-of-place toilet`."""
        try:
            frame = from_detection3d_array(message)
            events = self.home.update(frame["objects"], (0.0, 0.0, 0.0), message.header.stamp)
            for event in events:
                self.events.publish(String(data=f"{event.kind} {event.label}"))
        except (ClientError, MessageError) as error:
            self.get_logger().warning(f"{type(error).__name__}: {error}")


if __name__ == "__main__":
    rclpy.init()
    try:
        rclpy.spin(Watcher())
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
