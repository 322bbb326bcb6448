#!/usr/bin/env python3
"""Ask the service about a robot's detections, which arrive over rosbridge. ROS is not needed.

    python clients/ros2/over_rosbridge.py ws://robot:9090 /detections_3d --questions missing

The program prints each answer as one line of JSON. It asks about each message alone, as `bridge`
describes. While a question is in progress, only the newest message is kept. Errors, and the
bridge's own errors and warnings, go to standard error. The exit status is 1 if the bridge cannot be
reached or closes the connection, so that a supervisor can restart the program.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator
from typing import Any, NoReturn

from bridge import Advisor, advisor, complain, options
from websockets.exceptions import ConnectionClosed, WebSocketException
from websockets.sync.client import ClientConnection, connect

MAX_MESSAGE = 2**24  # bytes


def read(frame: str | bytes) -> dict[str, Any]:
    """Parse a message of the bridge; an empty dictionary if it is not a JSON object."""
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
    """Iterate over the messages of a topic. Of several waiting messages, only the newest is kept.

    Raises:
        ConnectionClosed: the bridge closed the connection.
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


def answer_each(bridge: str, topic: str, asked: Advisor) -> NoReturn:
    """Print the answers about each newest message until the connection ends."""
    try:
        socket = connect(bridge, max_size=MAX_MESSAGE)
    except (OSError, WebSocketException, ValueError) as error:
        complain(f"no bridge at {bridge}: {error}")
        sys.exit(1)
    with socket:
        try:
            for message in messages(socket, topic):
                if (found := asked.answer(message)) is not None:
                    print(found, flush=True)
        except ConnectionClosed as error:
            complain(f"the bridge at {bridge} is gone: {error}")
    sys.exit(1)


def main() -> None:
    arguments = options("Ask about detections from rosbridge.")
    arguments.add_argument("bridge", help="ws://ROBOT:9090")
    arguments.add_argument("topic", help="vision_msgs/Detection3DArray or Detection2DArray")
    given = arguments.parse_args()
    with advisor(arguments, given) as asked:
        answer_each(given.bridge, given.topic, asked)


if __name__ == "__main__":
    main()
