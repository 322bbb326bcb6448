#!/usr/bin/env python3
"""Answer questions about detections over DDS, the transport of ROS 2. rclpy is not needed.

    python clients/ros2/over_dds.py /detections_3d --questions missing outliers

The program subscribes to a vision_msgs/Detection3DArray and publishes each answer as JSON in a
std_msgs/String. It asks about each message alone, as `bridge` describes. While a question is in
progress, only the newest message is kept. Errors go to standard error. CYCLONEDDS_URI selects the
network interface.
"""

from __future__ import annotations

import os
import re
import sys
from argparse import ArgumentTypeError
from collections.abc import Iterator
from typing import Final

import bridge
from cyclonedds.core import (
    DDSException,
    InstanceState,
    ReadCondition,
    SampleState,
    ViewState,
    WaitSet,
)
from cyclonedds.domain import DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from dds_messages import Detection3DArray, String, quality

# The UDP ports of higher domains would exceed 65535.
_MAX_DOMAIN: Final = 232
_TOPIC: Final = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(/[A-Za-z_][A-Za-z0-9_]*)*")


def detections(participant: DomainParticipant, topic: str) -> Iterator[Detection3DArray]:
    """Iterate over the messages of a topic, without end. Only the newest message is kept."""
    # A best-effort reader also receives the messages of reliable writers.
    reader = DataReader(
        participant,
        Topic(participant, topic, Detection3DArray),
        quality(Detection3DArray, reliable=False),
    )
    unread = ReadCondition(reader, SampleState.NotRead | ViewState.Any | InstanceState.Any)
    waiting = WaitSet(participant)
    waiting.attach(unread)
    while True:
        # Python handles Ctrl-C only between waits.
        waiting.wait(duration(seconds=1))
        try:
            samples = reader.take(condition=unread)
        except UnicodeDecodeError as error:
            bridge.complain(f"left out: a message on {topic}: {error}")
            continue
        # A publisher that ends leaves a sample without data.
        yield from (sample for sample in samples if isinstance(sample, Detection3DArray))


def ros_topic(name: str) -> str:
    """Return the DDS name of a ROS topic.

    Raises:
        ArgumentTypeError: the text is not the name of a topic.
    """
    if _TOPIC.fullmatch(name) is None:
        raise ArgumentTypeError(
            f"{name!r} is not the name of a topic, such as /camera/boxes: words of letters, digits "
            "and _, separated by /, without a digit at the start"
        )
    return f"rt/{name.removeprefix('/')}"


def domain(text: str) -> int:
    """Return the number of a DDS domain.

    Raises:
        ArgumentTypeError: the text is not a number from 0 to 232.
    """
    if not text.isdecimal() or int(text) > _MAX_DOMAIN:
        raise ArgumentTypeError(f"{text!r} is not a number from 0 to {_MAX_DOMAIN}")
    return int(text)


def main() -> None:
    arguments = bridge.options("Answer questions about detections over DDS.")
    arguments.add_argument(
        "detections", type=ros_topic, help="topic of a vision_msgs/Detection3DArray"
    )
    arguments.add_argument(
        "--answers", type=ros_topic, default="/scene/answers", help="topic of the answers"
    )
    arguments.add_argument(
        "--domain", type=domain, default=os.environ.get("ROS_DOMAIN_ID") or "0", help="DDS domain"
    )
    given = arguments.parse_args()
    if given.answers == given.detections:
        arguments.error("--answers: the answers need another topic than the detections")
    try:
        participant = DomainParticipant(given.domain)
        writer = DataWriter(
            participant,
            Topic(participant, given.answers, String),
            quality(String, reliable=True),
        )
        with bridge.advisor(arguments, given) as advisor:
            for message in detections(participant, given.detections):
                if (answer := advisor.answer(message)) is not None:
                    writer.write(String(answer))
    except DDSException as error:
        bridge.complain(f"DDS: {error}")
        sys.exit(1)
    except KeyboardInterrupt:
        pass


if __name__ == "__main__":
    main()
