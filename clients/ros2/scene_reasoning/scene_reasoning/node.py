"""ROS 2 node that holds a `scene_client.Home`: what a moving robot knows about the rooms of a home.

Subscriptions: ``detections`` (vision_msgs/Detection3DArray or Detection2DArray), ``label_info``
(vision_msgs/LabelInfo), ``pose`` (geometry_msgs/PoseWithCovarianceStamped; without it, tf2 has the
pose) and ``room`` (std_msgs/String).
Publications: ``~/events`` and ``~/things`` (scene_reasoning_msgs), ``~/missing`` (std_msgs/String,
JSON), ``~/ghosts`` (visualization_msgs/MarkerArray) and ``/diagnostics``.
Services: ``~/where_is`` and ``~/confirm`` (scene_reasoning_msgs).
The home has its own thread, so the callbacks of messages never wait for the service.
"""

from __future__ import annotations

import math
import time
from dataclasses import asdict
from pathlib import Path
from typing import Any

import rclpy
import yaml
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.duration import Duration
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, qos_profile_sensor_data
from rclpy.time import Time
from scene_reasoning_msgs.msg import RoomProbability, SceneEvent, ThingArray
from scene_reasoning_msgs.srv import Confirm, WhereIs
from std_msgs.msg import Header, String
from tf2_ros import Buffer, TransformException, TransformListener
from vision_msgs.msg import Detection2DArray, Detection3DArray, LabelInfo
from visualization_msgs.msg import MarkerArray

from scene_client import Client, ClientError, Event, Home, Settings, UnknownThingError
from scene_client.frames import CONVENTIONS
from scene_client.ros_fields import MessageError, frame_of
from scene_reasoning import messages
from scene_reasoning.detections import Converter, Pose, Transform
from scene_reasoning.home_thread import HomeThread

KINDS = {"3d": Detection3DArray, "2d": Detection2DArray}


class Counted:
    """A client that counts its answers."""

    def __init__(self, client: Client) -> None:
        self._client = client
        self.answers, self.last = 0, math.nan  # number, and time of the last one

    def __getattr__(self, name: str) -> Any:
        ask = getattr(self._client, name)

        def counted(*arguments: Any, **fields: Any) -> Any:
            answer = ask(*arguments, **fields)
            self.answers, self.last = self.answers + 1, time.monotonic()
            return answer

        return counted


class SceneNode(Node):
    """Update a home with each message of detections, and publish its changes."""

    def __init__(self) -> None:
        super().__init__("scene")
        defaults = asdict(Settings())
        settings = Settings(**{n: self._parameter(f"settings.{n}", defaults[n]) for n in defaults})
        key_file, rooms = self._parameter("api_key_file", ""), self._parameter("rooms", "")
        self.client = Client(
            self._parameter("url", "http://127.0.0.1:8000"),
            timeout=settings.timeout,
            api_key=Path(key_file).read_text("utf-8").strip() if key_file else None,
        )
        self.counted: Any = Counted(self.client)
        view = self._parameter("view_angle", 0.0), self._parameter("view_range", 0.0)
        candidates = list(self._parameter("room_candidates", [""]))
        home = Home(
            self.counted,
            yaml.safe_load(Path(rooms).read_text("utf-8")) if rooms else None,
            path=self._parameter("home_file", "") or None,
            view=view if all(view) else None,
            room_candidates=candidates if any(candidates) else (),
            record=self._parameter("record", "") or None,
            settings=settings,
        )
        self.home = HomeThread(home)
        names = list(self._parameter("class_names", [""]))
        self.converter = Converter(
            self._parameter("label_map", "") or (names if any(names) else None),
            self._parameter("min_score", 0.2),
            self._parameter("boxes", True),
            {name: value for name in CONVENTIONS if (value := self._parameter(name, ""))},
        )
        # The default NaN means that tf2 has the pose, until the first message with a pose.
        viewpoint = tuple(self._parameter("viewpoint", [math.nan] * 3))
        self.pose: Pose | None = viewpoint if all(map(math.isfinite, viewpoint)) else None
        self.pose_frame, self.map_frame = "", self._parameter("map_frame", "map")
        self.base_frame = self._parameter("base_frame", "base_link")
        self.transforms = Buffer()
        self.listener = TransformListener(self.transforms, self)
        self.room: str | None = None
        self.missing_period = self._parameter("missing_period", 5.0)
        self.ghosts_shown = self._parameter("ghosts", 3)
        self.header = Header(frame_id=self.map_frame)  # of the last frame
        self.next: dict[str, float] = {}  # times of the next publications, by topic
        # What the thread of the home reports to the diagnostics.
        self.frames, self.error, self.lost = 0, "", ""
        self.state: dict[str, Any] = {}
        self.reported = time.monotonic(), 0, 0
        self._connect(KINDS[self._parameter("kind", "3d")])

    def _parameter(self, name: str, default: Any) -> Any:
        return self.declare_parameter(name, default).value

    def _connect(self, kind: Any) -> None:
        self.create_subscription(kind, "detections", self.on_detections, qos_profile_sensor_data)
        # A transient-local subscription gets the last message of publishers that started earlier,
        # but does not match volatile publishers. So each topic has both kinds of subscription.
        latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        for qos in (latched, QoSProfile(depth=1, durability=DurabilityPolicy.VOLATILE)):
            self.create_subscription(LabelInfo, "label_info", self.on_label_info, qos)
            self.create_subscription(PoseWithCovarianceStamped, "pose", self.on_pose, qos)
            self.create_subscription(String, "room", self.on_room, qos)
        self.events = self.create_publisher(SceneEvent, "~/events", 100)
        self.things = self.create_publisher(ThingArray, "~/things", latched)
        self.missing = self.create_publisher(String, "~/missing", 1)
        self.markers = self.create_publisher(MarkerArray, "~/ghosts", 1)
        self.diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 1)
        self.create_timer(1.0, self.on_second)
        # A service waits for the thread of the home, in a group of its own: other callbacks go on.
        waiting = MutuallyExclusiveCallbackGroup()
        self.create_service(WhereIs, "~/where_is", self.on_where_is, callback_group=waiting)
        self.create_service(Confirm, "~/confirm", self.on_confirm, callback_group=waiting)

    # ---------------------------------------------------------------------------- callbacks

    def on_detections(self, message: Any) -> None:
        stamp = message.header.stamp
        if not (stamp.sec or stamp.nanosec):
            stamp = self.get_clock().now().to_msg()
        pose, frame, room = self.pose, self.pose_frame, self.room
        self.home.see(lambda home: self._update(home, message, stamp, pose, frame, room))

    def on_label_info(self, message: Any) -> None:
        self.converter.label_map = message

    def on_pose(self, message: Any) -> None:
        self.pose = _transform(message.pose.pose.position, message.pose.pose.orientation).pose
        self.pose_frame = message.header.frame_id

    def on_room(self, message: Any) -> None:
        self.room = message.data or None

    def on_where_is(self, request: Any, response: Any) -> Any:
        return self.home.ask(lambda home: self._where_is(home, request, response)).result()

    def on_confirm(self, request: Any, response: Any) -> Any:
        return self.home.ask(lambda home: self._confirm(home, request, response)).result()

    def on_second(self) -> None:
        """Report rates since the last report, and the state of the home."""
        now, frames, answers = time.monotonic(), self.frames, self.counted.answers
        since, old_frames, old_answers = self.reported
        self.reported = now, frames, answers
        level, text = DiagnosticStatus.OK, "up to date"
        if self.lost or self.error:
            level, text = DiagnosticStatus.ERROR, self.lost or self.error
        elif frames == old_frames:
            level, text = DiagnosticStatus.WARN, "no detections"
        values = {
            "frames/s": f"{(frames - old_frames) / max(now - since, 1e-3):.1f}",
            "answers/s": f"{(answers - old_answers) / max(now - since, 1e-3):.1f}",
            "age of the last answer in s": f"{now - self.counted.last:.1f}",
            "replaced frames": self.home.replaced,
            **self.state,
        }
        status = DiagnosticStatus(level=level, name=f"{self.get_name()}: home", message=text)
        status.values = [KeyValue(key=key, value=str(value)) for key, value in values.items()]
        report = DiagnosticArray(status=[status])
        report.header.stamp = self.get_clock().now().to_msg()
        self.diagnostics.publish(report)

    # ------------------------------------------------------------- in the thread of the home

    def _update(
        self, home: Home, message: Any, stamp: Any, pose: Any, pose_frame: str, room: str | None
    ) -> None:
        self.header = Header(stamp=stamp, frame_id=pose_frame or self.map_frame)
        frame = frame_of(message.header)
        if pose is not None:
            transform = Transform.of(pose, pose_frame, frame)
        elif transform := self._look_up(frame, stamp):
            base = self._look_up(self.base_frame, stamp)
            pose = None if base is None else base.pose
        try:
            detections = self.converter.detections(message, transform)
            events = home.update(detections, pose, stamp, room=room)
            self._publish(home, events)
            self._publish_missing(home)
            self.error = ""
        except (ClientError, MessageError) as error:
            # Any other error is a defect of the node, and ends the node.
            self.error = f"{type(error).__name__}: {error}"
        self.frames += 1

    def _look_up(self, frame: str, stamp: Any) -> Transform | None:
        """Return the transform from a frame to the map, or None if tf2 does not have it soon."""
        at, patience = Time.from_msg(stamp), Duration(seconds=0.2)
        try:
            found = self.transforms.lookup_transform(self.map_frame, frame, at, patience).transform
        except TransformException:
            return None
        return _transform(found.translation, found.rotation)

    def _publish(self, home: Home, events: list[Event]) -> None:
        for event in events:
            self.events.publish(messages.event_of(event))
            if event.kind == "service":
                self.lost = event.detail or "lost" if event.label == "lost" else ""
        if not self._is_due("things", 1.0) and not events:
            return
        alarms, things = home.alarms, messages.present(home)
        self.state = {"things": len(things), "alarms": len(alarms), "room": home.room}
        found = messages.things_of(things, alarms)
        self.things.publish(ThingArray(header=self.header, things=found))

    def _is_due(self, topic: str, period: float) -> bool:
        """Return whether a period in seconds has passed since the last publication."""
        now = time.monotonic()
        if is_due := now >= self.next.get(topic, now):
            self.next[topic] = now + period
        return is_due

    def _publish_missing(self, home: Home) -> None:
        if self.missing_period <= 0 or self.lost or not home.scene()["objects"]:
            return
        if not self._is_due("missing", self.missing_period):
            return
        answer, things = home.missing(), messages.present(home)
        self.missing.publish(String(data=answer.model_dump_json(exclude_none=True)))
        shown = messages.markers_of(answer, things, self.header, self.ghosts_shown)
        self.markers.publish(shown)

    def _where_is(self, home: Home, request: Any, response: Any) -> Any:
        searched = [
            {
                "room": one.room,
                "object": one.object or None,
                "seen_share": one.seen_share or 1.0,
            }
            for one in request.searched
        ]
        try:
            answer = home.where(request.label, searched)
        except ClientError as error:
            response.success, response.message = False, f"{type(error).__name__}: {error}"
            return response
        response.success, response.header = True, self.header
        response.places = messages.places_of(answer, messages.present(home))
        response.rooms = [
            RoomProbability(room=one.room, probability=one.probability) for one in answer.rooms
        ]
        response.not_here = answer.not_here
        return response

    def _confirm(self, home: Home, request: Any, response: Any) -> Any:
        try:
            self._publish(home, home.confirm(request.id))
            response.success = True
        except UnknownThingError as error:
            response.success, response.message = False, str(error)
        return response

    def destroy_node(self) -> None:
        self.home.close()
        self.client.close()
        super().destroy_node()


def _transform(position: Any, q: Any) -> Transform:
    return Transform((q.x, q.y, q.z, q.w), (position.x, position.y, position.z))


def main() -> None:
    rclpy.init()
    node = SceneNode()
    try:
        rclpy.spin(node, MultiThreadedExecutor(num_threads=2))
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
