"""Benchmark of the recorder: the duration of a client's call with and without a recorded file."""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

from benchmarks.load import servers
from benchmarks.load.questions import bodies, labels_of
from benchmarks.report import Result
from benchmarks.timing import Timings
from scene_client import Client, Recorder

PLAIN, KNOWN = "without a recorder", "with a recorder, of a known scene"
NEW = "with a recorder, of a new scene"


def recording(*, store: Path = Path("model_store"), calls: int = 1000) -> list[Result]:
    """Measure `outliers` about scenes of 12 poses on one connection, with and without a recorder.

    Args:
        store: directory of the model store. The default model is queried.
        calls: number of measured calls of each kind. Kinds alternate. Additional warm-up calls
            (10 %) are not measured.

    Raises:
        ServerError: the store is missing, or the service does not become ready.
    """
    seconds: dict[str, list[float]] = {KNOWN: [], PLAIN: [], NEW: []}
    processor: dict[str, list[float]] = {KNOWN: [], PLAIN: [], NEW: []}
    with servers.service(store, pinned=False) as started, TemporaryDirectory() as folder:
        url = f"http://127.0.0.1:{started.port}"
        scene = bodies("12 poses", labels_of(started.port))[0] | {"stamp": _stamp(0)}
        file = Path(folder, "scenes.jsonl")
        recorder = Recorder(file)
        with Client(url) as plain, Client(url, record=recorder) as recording:
            for turn in range(-calls // 10, calls):
                # The hour is a part of the content of a scene.
                other = scene | {"stamp": _stamp(turn + calls)}
                asked = [(PLAIN, plain, other), (KNOWN, recording, scene), (NEW, recording, other)]
                for name, client, body in asked[turn % 3 :] + asked[: turn % 3]:
                    taken, worked = _seconds(client, body)
                    recorder.flush()  # otherwise its thread would slow down the next call
                    if turn >= 0:
                        seconds[name].append(taken)
                        processor[name].append(worked)
        lines = len(file.read_bytes().splitlines())
    title = "A call about 12 poses, one connection kept alive"
    return [
        Result(
            title,
            name,
            Timings({one: seconds[one] for one in (name, PLAIN)}),
            targets={PLAIN: 0.95},
            facts={
                "recorded scenes": lines,
                # On a busy machine, the processor time of the client varies less.
                "processor time of the client in µs": 1e6 * median(processor[name]),
                f"the same {PLAIN}": 1e6 * median(processor[PLAIN]),
            },
        )
        for name in (KNOWN, NEW)
    ]


def _stamp(hour: int) -> dict[str, int]:
    return {"sec": 3600 * hour, "nanosec": 0}


def _seconds(client: Client, body: dict[str, Any]) -> tuple[float, float]:
    """Return the duration of a call, and the processor time of its thread."""
    start, worked = time.perf_counter(), time.thread_time()
    client.outliers(body)
    return time.perf_counter() - start, time.thread_time() - worked
