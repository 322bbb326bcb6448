"""The example without ROS: a bridge of websockets on one side, the service on the other."""

import json
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.server import ServerConnection, serve

from tests.conftest import run_program


@contextmanager
def bridge(*published: Any) -> Iterator[tuple[str, list[Any]]]:
    """A bridge that sends these messages (text, bytes or JSON) to a subscriber, and hangs up."""
    heard: list[Any] = []

    def handle(socket: ServerConnection) -> None:
        try:
            heard.append(json.loads(socket.recv()))
            for message in published:
                socket.send(message if isinstance(message, str | bytes) else json.dumps(message))
        except ConnectionClosed:
            pass

    with serve(handle, "127.0.0.1", 0) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}", heard
        finally:
            server.shutdown()
            thread.join()


def run(repository: Path, *arguments: str) -> tuple[list[Any], list[str]]:
    script = repository / "clients" / "ros2" / "over_rosbridge.py"
    # The bridge hung up: the status tells a supervisor to restart the program.
    environment = {"PYTHONPATH": str(repository), "PATH": "/usr/bin:/bin"}
    done = run_program(sys.executable, script, *arguments, status=1, env=environment)
    *errors, last = done.stderr.splitlines()
    assert last.startswith(("the bridge at ws://", "no bridge at "))
    return [json.loads(line) for line in done.stdout.splitlines()], errors


@pytest.mark.parametrize("questions", [["missing"], ["relations", "rooms"]])
def test_a_published_message_is_answered(repository, live, envelope, questions):
    with bridge({"op": "status", "level": "info"}, envelope) as (url, heard):
        (answer,), errors = run(
            repository, url, "/detections_3d", "--service", live.url, "--questions", *questions
        )
    assert heard == [{"op": "subscribe", "topic": "/detections_3d", "queue_length": 1}]
    assert answer["frame_id"] == "base_link"
    assert set(answer) == {"frame_id", "stamp", "notes", *questions}
    entries = {"rooms": "room_types"}
    assert all(answer[question][entries.get(question, question)] for question in questions)
    assert errors == []


def test_invalid_frames_are_left_out(repository: Path) -> None:
    message = {"op": "publish", "topic": "/x", "msg": {"objects": []}}
    frames = [
        "no JSON",
        b"\x00\xff",
        [1, 2],
        "[" * 100_000,
        {"op": "status", "level": "info", "msg": "hello"},
        {"op": "status", "level": "error", "msg": "no such\ntype"},
        {"op": "status", "level": "warning", "msg": "slow"},
    ]
    with bridge(*frames, message) as (url, _):
        answers, errors = run(repository, url, "/x")
    assert answers == []
    assert errors == [
        "left out: text that is no JSON object: 'no JSON'",
        r"left out: a binary frame that is no JSON object: b'\x00\xff'",
        "left out: text that is no JSON object: '[1, 2]'",
        f"left out: text that is no JSON object: {'[' * 40!r}",
        "bridge: error: no such type",
        "bridge: warning: slow",
        "MessageError: the message must have a list of detections",
    ]
