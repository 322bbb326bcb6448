"""ROS 2 node that asks the service about detections, and publishes answers and markers.

Subscriptions: ``detections`` (vision_msgs/Detection3DArray or Detection2DArray), ``label_info``
(vision_msgs/LabelInfo) and ``pose`` (geometry_msgs/PoseWithCovarianceStamped).
Publications: ``~/answers`` (std_msgs/String, JSON), ``~/ghosts`` (visualization_msgs/MarkerArray)
and ``/diagnostics``.
Questions run in a separate thread, so callbacks never wait for the service.
"""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from std_msgs.msg import String
from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo
from visualization_msgs.msg import Marker, MarkerArray

from scene_client import Client, ClientError
from scene_client.frames import CONVENTIONS
from scene_client.ros_fields import MessageError
from scene_reasoning.advisor import Advice, Advisor
from scene_reasoning.ghosts import Ghost, ghosts
from scene_reasoning.latest import Latest, Outcome

KINDS = {"3d": Detection3DArray, "2d": Detection2DArray}

# A message of detections, and the viewpoint (x, y in metres, yaw in radians) at its arrival.
Seen = tuple[Any, "tuple[float, float, float] | None"]


class SceneNode(Node):
    """Ask about the newest detections, and publish the answers."""

    def __init__(self) -> None:
        super().__init__("scene")
        self.ghosts_shown = self._parameter("ghosts", 3)
        key_file = self._parameter("api_key_file", "")
        self.client = Client(
            self._parameter("url", "http://127.0.0.1:8000"),
            timeout=self._parameter("timeout", 0.5),
            api_key=Path(key_file).read_text("utf-8").strip() if key_file else None,
            record=self._parameter("record", "") or None,
        )
        names = list(self._parameter("class_names", [""]))
        self.advisor = Advisor(
            self.client,
            questions=tuple(self._parameter("questions", ["missing", "outliers"])),
            label_map=self._parameter("label_map", "") or (names if any(names) else None),
            min_score=self._parameter("min_score", 0.2),
            unknown_labels=self._parameter("unknown_labels", "nearest-or-ignore"),
            boxes=self._parameter("boxes", True),
            conventions={
                name: value for name in CONVENTIONS if (value := self._parameter(name, ""))
            },
        )
        self.latest: Latest[Seen, Advice] = Latest(lambda seen: self.advisor.advise(*seen))
        # The default NaN means that the viewpoint is unknown until the first pose.
        viewpoint = tuple(self._parameter("viewpoint", [math.nan] * 3))
        self.viewpoint = viewpoint if all(map(math.isfinite, viewpoint)) else None
        self.pose_frame: str | None = None

        kind = KINDS[self._parameter("kind", "3d")]
        self.create_subscription(kind, "detections", self.on_detections, qos_profile_sensor_data)
        # A transient-local subscription gets the last message of publishers that started earlier,
        # but does not match volatile publishers. So each topic has both kinds of subscription.
        for durability in (DurabilityPolicy.TRANSIENT_LOCAL, DurabilityPolicy.VOLATILE):
            qos = QoSProfile(depth=1, durability=durability)
            self.create_subscription(LabelInfo, "label_info", self.on_label_info, qos)
            self.create_subscription(PoseWithCovarianceStamped, "pose", self.on_pose, qos)
        self.answers = self.create_publisher(String, "~/answers", 1)
        self.markers = self.create_publisher(MarkerArray, "~/ghosts", 1)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.create_timer(1.0 / self._parameter("rate", 10.0), self.on_tick)

    def _parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    # ---------------------------------------------------------------------------- callbacks

    def on_detections(self, message: Any) -> None:
        # A pose is valid only for detections in its frame. Without a pose, the viewpoint of the
        # parameter is valid in every frame.
        is_valid = self.pose_frame in (None, message.header.frame_id)
        self.latest.see((message, self.viewpoint if is_valid else None))

    def on_label_info(self, message: Any) -> None:
        self.advisor.label_map = message

    def on_pose(self, message: Any) -> None:
        position, q = message.pose.pose.position, message.pose.pose.orientation
        # Yaw of the unit quaternion q, in radians.
        yaw = math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))
        self.viewpoint = (position.x, position.y, yaw)
        self.pose_frame = message.header.frame_id

    def on_tick(self) -> None:
        outcome = self.latest.tick()
        if outcome is None:
            return
        message, _ = outcome.about
        try:
            advice = outcome.future.result()
        except (ClientError, MessageError) as error:
            # Any other error is a defect of the node, and ends the node.
            self._report(DiagnosticStatus.ERROR, outcome, f"{type(error).__name__}: {error}")
            return
        self.answers.publish(String(data=json.dumps(advice.to_json())))
        self.markers.publish(self._markers(message, ghosts(advice, self.ghosts_shown)))
        if advice.answers:
            self._report(DiagnosticStatus.OK, outcome, "answered")
        else:
            self._report(DiagnosticStatus.WARN, outcome, "nothing was seen")

    # ------------------------------------------------------------------------------ messages

    def _markers(self, message: Any, shown: list[Ghost]) -> MarkerArray:
        """Return the markers of ghosts: a text, and a sphere if the extent is known.

        The first marker deletes all earlier markers.
        """
        clear = Marker()
        clear.header = message.header
        clear.action = Marker.DELETEALL
        markers = [clear]
        for ghost in shown:
            kinds = [Marker.TEXT_VIEW_FACING]
            if ghost.extent is not None:
                kinds.append(Marker.SPHERE)
            for kind in kinds:
                marker = Marker()
                marker.header = message.header
                marker.ns = "missing"
                marker.id = len(markers)
                marker.type = kind
                marker.action = Marker.ADD
                place = marker.pose.position
                place.x, place.y, place.z = ghost.position
                colour = marker.color
                colour.r, colour.g, colour.b = 1.0, 0.6, 0.0
                if kind == Marker.SPHERE and ghost.extent is not None:
                    marker.scale.x, marker.scale.y, marker.scale.z = ghost.extent
                    colour.a = 0.35
                else:
                    marker.text = ghost.text
                    marker.scale.z = 0.08
                    colour.a = 1.0
                markers.append(marker)
        return MarkerArray(markers=markers)

    def _report(self, level: Any, outcome: Outcome[Seen, Advice], text: str) -> None:
        status = DiagnosticStatus(level=level, name=f"{self.get_name()}: service", message=text)
        status.values = [KeyValue(key="superseded", value=str(outcome.superseded))]
        report = DiagnosticArray(status=[status])
        report.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(report)

    def destroy_node(self) -> None:
        self.latest.close()
        self.client.close()
        super().destroy_node()


def main() -> None:
    rclpy.init()
    node = SceneNode()
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
