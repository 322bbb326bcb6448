"""Options, questions and error reports of the programs that bridge to a robot without rclpy."""

from __future__ import annotations

import argparse
import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from scene_client import Client, ClientError, InvalidRequestError
from scene_client.ros_fields import MessageError

# The ROS package beside this file; a colcon workspace installs it.
sys.path.insert(0, str(Path(__file__).resolve().parent / "scene_reasoning"))

from scene_reasoning.advisor import QUESTIONS, Advisor


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


@contextmanager
def advisor(arguments: argparse.ArgumentParser, given: argparse.Namespace) -> Iterator[Advisor]:
    """Open a connection to the service, with the API key in SCENE_API_KEY.

    Invalid options end the program with status 2.
    """
    try:
        key = os.environ.get("SCENE_API_KEY")
        client = Client(given.service, timeout=given.timeout, api_key=key or None)
        found = Advisor(client, given.questions, given.label_map)
    except (InvalidRequestError, MessageError) as error:
        arguments.error(str(error))
    with client:
        yield found


def answer(advisor: Advisor, message: Any) -> str | None:
    """Return the answers about a message as JSON. Report an error, and return None."""
    try:
        return json.dumps(advisor.advise(message).to_json())
    except (ClientError, MessageError) as error:
        complain(f"{type(error).__name__}: {error}")
        return None


def complain(words: str) -> None:
    """Write an error to standard error, as one line."""
    print(" ".join(words.split()), file=sys.stderr, flush=True)
