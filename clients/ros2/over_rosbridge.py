#!/usr/bin/env python3
"""Ask about what a robot sees from any machine, without ROS: detections come over rosbridge.

    python clients/ros2/over_rosbridge.py ws://robot:9090 /detections_3d

prints one line of JSON for each message that it could ask about. Messages that come while a
question is in flight are dropped but for the newest. What cannot be asked about is said on
standard error, and so is what the bridge complains of. It ends when there is no bridge, or no
longer, with 1: whoever supervises it starts it again.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Iterator
from typing import Any, NoReturn

from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

from scene_client import Client, ClientError, InvalidRequestError
from scene_client.ros_fields import MessageError
from scene_client.vision_msgs import from_message

MAX_MESSAGE = 2**24  # bytes


def complain(words: str) -> None:
    """Say on standard error what went wrong, in a line."""
    print(" ".join(words.split()), file=sys.stderr, flush=True)


def read(frame: str | bytes) -> dict[str, Any]:
    """What the bridge says; nothing where that is no JSON object, as of a bridge that packs it."""
    try:
        said = json.loads(frame) if isinstance(frame, str) else None
    except (ValueError, RecursionError):
        said = None
    if not isinstance(said, dict):
        kind = "text" if isinstance(frame, str) else "a binary frame"
        complain(f"left out: {kind} that is no JSON object: {frame[:40]!r}")
        return {}
    if said.get("op") == "status" and said.get("level") in ("error", "warning"):
        complain(f"bridge: {said['level']}: {said.get('msg')}")
    return said


def messages(socket: ClientConnection, topic: str) -> Iterator[Any]:
    """What comes on a topic, until the bridge hangs up; of what waits only the newest.

    Raises:
        ConnectionClosed: it did.
    """
    socket.send(json.dumps({"op": "subscribe", "topic": topic, "queue_length": 1}))
    end = None
    while end is None:
        newest = None
        try:
            while True:
                received = read(socket.recv(timeout=None if newest is None else 0))
                if received.get("op") == "publish":
                    newest = received
        except TimeoutError:
            pass
        except ConnectionClosed as closed:
            end = closed
        if newest is not None:
            yield newest
    raise end


def answer_each(
    bridge: str, topic: str, ask: Callable[..., Any], label_map: str | None, say: Callable[..., Any]
) -> NoReturn:
    """Ask about the newest message, again and again; a question without an answer is reported."""
    try:
        socket = connect(bridge, max_size=MAX_MESSAGE)
    except (OSError, WebSocketException, ValueError) as error:
        complain(f"no bridge at {bridge}: {error}")
        sys.exit(1)
    with socket:
        try:
            for message in messages(socket, topic):
                try:
                    fields = from_message(message, label_map)
                    if fields["objects"]:
                        say(ask(**fields).model_dump_json(exclude_none=True), flush=True)
                except (ClientError, MessageError) as error:
                    complain(f"{type(error).__name__}: {error}")
        except ConnectionClosed as error:
            complain(f"the bridge at {bridge} is gone: {error}")
    sys.exit(1)


def main() -> None:
    arguments = argparse.ArgumentParser(description="Ask about detections from rosbridge.")
    arguments.add_argument("bridge", help="ws://ROBOT:9090")
    arguments.add_argument("topic", help="vision_msgs/Detection3DArray or Detection2DArray")
    arguments.add_argument("--service", default="http://127.0.0.1:8000")
    arguments.add_argument("--question", default="missing", choices=["missing", "outliers"])
    arguments.add_argument("--label-map", help="coco, where class ids are COCO's numbers")
    given = arguments.parse_args()
    try:
        client = Client(given.service, timeout=1.0)
    except InvalidRequestError as error:
        arguments.error(f"--service: {error}")
    with client:
        ask = getattr(client, given.question)
        answer_each(given.bridge, given.topic, ask, given.label_map, print)


if __name__ == "__main__":
    main()
