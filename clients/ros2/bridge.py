"""The common part of the programs that answer single messages of a robot, without rclpy.

They ask about each message alone, so they fit a camera at a fixed place, and trials. For a moving
robot, the node of this folder and `scene_client.Home` remember what the robot has seen.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from scene_client import Client, ClientError, InvalidRequestError
from scene_client.ros_fields import MessageError, read_label_map
from scene_client.vision_msgs import from_message

QUESTIONS = ("missing", "outliers", "relations", "rooms")


def options(description: str) -> argparse.ArgumentParser:
    """Return a parser with the options of every bridge."""
    arguments = argparse.ArgumentParser(description=description)
    address = os.environ.get("SCENE_URL") or "http://127.0.0.1:8000"
    arguments.add_argument("--service", default=address, help="URL of the service (SCENE_URL)")
    arguments.add_argument("--timeout", type=float, default=1.0, help="seconds for one question")
    arguments.add_argument(
        "--questions", nargs="+", choices=QUESTIONS, default=["missing", "outliers"]
    )
    arguments.add_argument("--label-map", help="coco80 or coco91, if the class ids are numbers")
    return arguments


@dataclass
class Advisor:
    """The questions about each message."""

    client: Client
    questions: list[str]
    label_map: str | None

    def answer(self, message: Any) -> str | None:
        """Return the answers about a message as JSON. Report an error, and return None."""
        try:
            fields = from_message(message, self.label_map)
            answers = self._ask(fields) if fields["objects"] else {}
        except (ClientError, MessageError) as error:
            complain(f"{type(error).__name__}: {error}")
            return None
        header = {name: fields.get(name) for name in ("frame_id", "stamp")}
        notes = [note._asdict() for note in fields.notes]
        return json.dumps({**header, **answers, "notes": notes})

    def _ask(self, fields: dict[str, Any]) -> dict[str, Any]:
        copied = {"frame_id", "stamp"}
        return {
            question: getattr(self.client, question)(**fields).model_dump(
                mode="json", exclude=copied, exclude_none=True
            )
            for question in self.questions
        }


@contextmanager
def advisor(arguments: argparse.ArgumentParser, given: argparse.Namespace) -> Iterator[Advisor]:
    """Open a connection to the service, with the API key in SCENE_API_KEY.

    Invalid options end the program with status 2.
    """
    try:
        key = os.environ.get("SCENE_API_KEY")
        client = Client(given.service, timeout=given.timeout, api_key=key or None)
        read_label_map(given.label_map)
    except (InvalidRequestError, MessageError) as error:
        arguments.error(str(error))
    with client:
        yield Advisor(client, given.questions, given.label_map)


def complain(words: str) -> None:
    """Write an error to standard error, as one line."""
    print(" ".join(words.split()), file=sys.stderr, flush=True)
