"""Benchmark of the recorder: the duration of a client's call with and without a recorded file."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory

from benchmarks.load import servers
from benchmarks.load.questions import bodies, labels_of
from benchmarks.report import Result
from benchmarks.timing import Timings
from scene_client import Client, Recorder

PLAIN, KNOWN = "without a recorder", "with a recorder, of a known scene"
NEW = "with a recorder, of a new scene"
BLOCK = 50
"""Number of calls without a pause. Their time includes the writing of their scenes."""


def recording(*, store: Path = Path("model_store"), calls: int = 1000) -> list[Result]:
    """Measure `outliers` about scenes of 12 poses on one connection, with and without a recorder.

    Args:
        store: directory of the model store. The default model is queried.
        calls: number of measured calls of each kind, once with a pause after each call, and once
            without pauses. Kinds alternate. Additional warm-up calls (10 %) are not measured.

    Raises:
        ServerError: the store is missing, or the service does not become ready.
    """
    results: list[Result] = []
    with servers.service(store, pinned=False) as started, TemporaryDirectory() as folder:
        url = f"http://127.0.0.1:{started.port}"
        scene = bodies("12 poses", labels_of(started.port))[0]
        recorder = Recorder(Path(folder, "scenes.jsonl"))
        hours = count(1)  # the hour is a part of the content of a scene
        with Client(url) as plain, Client(url, record=recorder) as recording:

            def ask(name: str, length: int, flushes: bool) -> tuple[float, float]:
                """Return the duration of a call, and the processor time of the client."""
                client = plain if name == PLAIN else recording
                start, worked = time.perf_counter(), time.process_time()
                for _ in range(length):
                    hour = 0 if name == KNOWN else next(hours)
                    client.outliers(scene | {"stamp": {"sec": 3600 * hour, "nanosec": 0}})
                if flushes:
                    recorder.flush()
                taken = time.perf_counter() - start, time.process_time() - worked
                recorder.flush()  # otherwise its thread would slow down the next call
                return taken[0] / length, taken[1] / length

            results += _results("with pauses", calls, lambda name: ask(name, 1, False))
            title = f"without pauses, in blocks of {BLOCK} calls"
            results += _results(title, calls // BLOCK, lambda name: ask(name, BLOCK, True))
    return results


def _results(
    title: str, rounds: int, ask: Callable[[str], tuple[float, float]]
) -> Iterator[Result]:
    kinds = [PLAIN, KNOWN, NEW]
    seconds: dict[str, list[float]] = {name: [] for name in kinds}
    processor: dict[str, list[float]] = {name: [] for name in kinds}
    for turn in range(-max(1, rounds // 10), rounds):
        for name in kinds[turn % 3 :] + kinds[: turn % 3]:
            taken, worked = ask(name)
            if turn >= 0:
                seconds[name].append(taken)
                processor[name].append(worked)
    for name in (KNOWN, NEW):
        yield Result(
            f"A call about 12 poses, one connection kept alive, {title}",
            name,
            Timings({one: seconds[one] for one in (name, PLAIN)}),
            targets={PLAIN: 0.95},
            facts={
                # On a busy machine, the processor time of the client varies less.
                "processor time of the client in µs": 1e6 * median(processor[name]),
                f"the same {PLAIN}": 1e6 * median(processor[PLAIN]),
            },
        )
