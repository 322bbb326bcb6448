"""``python -m benchmarks.dds``: questions over DDS, compared with the same questions over HTTP.

A robot publishes a Detection3DArray, and the next message follows the answer. The bridge
`clients/ros2/over_dds.py` receives the message, asks the service and publishes the answer. After
each round trip, this process asks the service the same questions itself. All traffic stays on the
loopback interface.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from time import perf_counter
from typing import IO, Annotated, Any, Final

import numpy as np
import typer
from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rich.console import Console
from rich.table import Table

from benchmarks.load import servers
from benchmarks.report import describe_machine
from scene_client import Client
from scene_client.vision_msgs import from_detection3d_array

sys.path.append(str(Path(__file__).resolve().parents[1] / "clients" / "ros2"))

import dds_messages as ros

AIM: Final = 0.020
"""Target for the 99th percentile of a round trip, in seconds."""

QUESTIONS: Final = ("missing", "outliers")
PROGRAMS: Final = Path(__file__).resolve().parents[1] / "clients" / "ros2"
LOOPBACK: Final = (PROGRAMS / "loopback.xml").as_uri()
DOMAIN: Final = 1 + os.getpid() % 99
"""Own DDS domain of this process. Ports of higher domains may belong to other programs."""

_QUANTILES: Final = (0.5, 0.9, 0.99)
_PATIENCE: Final = 30


class Robot:
    """A robot that publishes detections and receives the answers of one bridge.

    Raises:
        TimeoutError: the bridge does not appear, or does not answer.
    """

    def __init__(self, topic: str) -> None:
        self._domain = Domain(DOMAIN, LOOPBACK)
        participant = DomainParticipant(DOMAIN)
        sent = Topic(participant, f"rt/{topic}", ros.Detection3DArray)
        heard = Topic(participant, f"rt/{topic}/answers", ros.String)
        self.writers = {
            reliable: DataWriter(
                participant, sent, ros.quality(ros.Detection3DArray, reliable=reliable)
            )
            for reliable in (True, False)
        }
        self._reader = DataReader(participant, heard, ros.quality(ros.String, reliable=True))
        self._unread = ReadCondition(
            self._reader, SampleState.NotRead | ViewState.Any | InstanceState.Any
        )
        self._waiting = WaitSet(participant)
        self._waiting.attach(self._unread)
        self._meet()

    def _meet(self) -> None:
        """Wait until the bridge has found both writers and the reader."""
        ends = [writer.get_matched_subscriptions for writer in self.writers.values()]
        ends.append(self._reader.get_matched_publications)
        until = perf_counter() + _PATIENCE
        while not all(end() for end in ends):
            if perf_counter() > until:
                raise TimeoutError("the bridge did not appear")
            self._waiting.wait(duration(milliseconds=10))

    def send(self, message: ros.Detection3DArray, *, reliable: bool = True) -> None:
        self.writers[reliable].write(message)

    def hear(self) -> ros.String:
        """Wait for the next answer."""
        if not self._waiting.wait(duration(seconds=_PATIENCE)):
            raise TimeoutError("no answer came")
        (answer,) = self._reader.take(condition=self._unread)
        return answer


@contextmanager
def bridge(topic: str, service: str, errors: IO[str] | None = None) -> Iterator[None]:
    """Run the bridge as a process. Its answers have the topic of the detections with /answers."""
    command = [
        *(sys.executable, str(PROGRAMS / "over_dds.py"), f"/{topic}"),
        *("--answers", f"/{topic}/answers", "--domain", str(DOMAIN)),
        *("--service", service, "--timeout", str(_PATIENCE), "--questions", *QUESTIONS),
    ]
    environment = os.environ | {"CYCLONEDDS_URI": LOOPBACK}
    process = subprocess.Popen(command, env=environment, stderr=errors, text=True)
    try:
        yield
    finally:
        process.terminate()
        process.wait(timeout=_PATIENCE)


def room(labels: list[str], objects: int) -> list[dict[str, Any]]:
    """Return objects with random positions in a cube of three metres."""
    rng = np.random.default_rng(0)
    chosen = rng.choice(len(labels), objects, replace=False)
    return [
        {
            "id": f"object_{k}",
            "label": labels[label],
            "position": dict(zip("xyz", rng.uniform(0, 3, 3).round(3).tolist(), strict=True)),
            "size": {"x": 0.5, "y": 0.5, "z": 0.5},
        }
        for k, label in enumerate(chosen)
    ]


def detections(things: list[dict[str, Any]], number: int) -> ros.Detection3DArray:
    """Return a message with these objects. Its number is the time in the header."""
    header = ros.Header(ros.Time(number, 0), "base_link")
    entries = []
    for thing in things:
        pose = ros.Pose(ros.Point(**thing["position"]), ros.Quaternion(0.0, 0.0, 0.0, 1.0))
        hypothesis = ros.ObjectHypothesisWithPose(
            ros.ObjectHypothesis(thing["label"], 0.9), ros.PoseWithCovariance(pose, [0.0] * 36)
        )
        box = ros.BoundingBox3D(pose, ros.Vector3(**thing["size"]))
        entries.append(ros.Detection3D(header, [hypothesis], box, thing["id"]))
    return ros.Detection3DArray(header, entries)


def measure(robot: Robot, client: Client, count: int, objects: int) -> dict[str, list[float]]:
    """Return the seconds of each round trip, and of the same questions over HTTP.

    Raises:
        TimeoutError: a message or its answer was lost.
    """
    labels = [entry.label for entry in client.vocabulary().objects if not entry.structure]
    things = room(labels, objects)
    seconds: dict[str, list[float]] = {"over DDS": [], "over HTTP": []}
    for number in range(count):
        message = detections(things, number)
        start = perf_counter()
        robot.send(message, reliable=number % 2 == 0)
        answer = robot.hear()
        seconds["over DDS"].append(perf_counter() - start)
        if json.loads(answer.data)["stamp"]["sec"] != number:
            raise TimeoutError(f"message {number} was lost")
        fields = from_detection3d_array(message)
        start = perf_counter()
        for question in QUESTIONS:
            getattr(client, question)(**fields)
        seconds["over HTTP"].append(perf_counter() - start)
    return seconds


def main(
    store: Annotated[Path, typer.Option(help="the model store to serve")] = Path("model_store"),
    messages: Annotated[int, typer.Option(min=1, help="number of messages")] = 1000,
    objects: Annotated[int, typer.Option(min=1, max=256, help="objects in a message")] = 12,
) -> None:
    """Measure the round trip from detections to answers over DDS."""
    console = Console(width=120)
    for key, value in describe_machine().items():
        console.print(f"{key}: {value}", highlight=False)
    with ExitStack() as stack:
        stack.callback(os.sched_setaffinity, 0, os.sched_getaffinity(0))
        service = stack.enter_context(servers.service(store, access_log="false"))
        os.sched_setaffinity(0, servers.cores()[1])
        url, topic = f"http://127.0.0.1:{service.port}", f"detections_{os.getpid()}"
        stack.enter_context(bridge(topic, url))
        robot, client = Robot(topic), stack.enter_context(Client(url, timeout=_PATIENCE))
        measure(robot, client, 50, objects)
        seconds = measure(robot, client, messages, objects)
    both = zip(seconds["over DDS"], seconds["over HTTP"], strict=True)
    seconds["difference (bridge and DDS)"] = [dds - http for dds, http in both]
    table = Table(title=f"{messages} messages, {objects} objects, 2 questions (milliseconds)")
    for column in ("", *(f"p{100 * q:g}" for q in _QUANTILES)):
        table.add_column(column, justify="left" if not column else "right")
    for name, values in seconds.items():
        table.add_row(name, *(f"{1e3 * value:.2f}" for value in np.quantile(values, _QUANTILES)))
    console.print(table)
    own = float(np.quantile(seconds["over DDS"], 0.99))
    verdict = "met" if own < AIM else "MISSED"
    console.print(
        f"none lost; p99 over DDS: {1e3 * own:.2f} ms; below {1e3 * AIM:.0f} ms: {verdict}"
    )


if __name__ == "__main__":
    typer.run(main)
