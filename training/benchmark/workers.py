"""Rows measured by several processes at once, each with one thread.

Workers do nothing but fill the folder's files, each of which is written as a whole. So they can be
stopped at any time, and whoever comes after reads and goes on.
"""

from __future__ import annotations

import multiprocessing
import os
import pickle  # nosec B403
import signal
from collections.abc import Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, ProcessPoolExecutor, wait
from contextlib import contextmanager
from multiprocessing.queues import SimpleQueue

import torch

from training.benchmark.entries import Entry
from training.benchmark.measure import Plan, Progress

_Message = tuple[str, str, str]
# How often messages are looked for, in seconds.
_TICK = 0.2
# Read by the linear algebra libraries when they are loaded, that is at the start of a process.
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")

_plan: Plan
_messages: SimpleQueue[_Message]


def fill(
    plan: Plan,
    entries: Sequence[Entry],
    progress: Progress,
    workers: int,
    *,
    failures: tuple[type[Exception], ...] = (),
) -> dict[tuple[str, int], Exception]:
    """Measure entries; the reports are on disk afterwards.

    KeyboardInterrupt stops the workers at once and passes through, and so does any error but those
    of a row itself.

    Args:
        failures: errors that end the row in which they arise and leave the others alone.

    Returns:
        These errors, by (name, seed) of the row.

    Raises:
        BrokenProcessPool: a worker died.
    """
    # Plain bytes: torch would hand tensors over through shared memory, which containers keep small.
    material = pickle.dumps(plan)
    context = multiprocessing.get_context("spawn")
    # Without a thread that sends: what a row says last is there when the row is done.
    messages: SimpleQueue[_Message] = context.SimpleQueue()
    with (
        _one_thread(),
        ProcessPoolExecutor(
            workers, context, initializer=_begin, initargs=(material, messages)
        ) as pool,
    ):
        futures = {
            pool.submit(_measure, entry, failures): (entry.name, entry.seed) for entry in entries
        }
        try:
            while True:
                done, waiting = wait(futures, _TICK, FIRST_EXCEPTION)
                for message in _pending(messages):
                    progress(*message)
                failed = {futures[future]: error for future in done if (error := future.result())}
                if not waiting:
                    return failed
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin(material: bytes, messages: SimpleQueue[_Message]) -> None:
    global _plan, _messages  # what a worker is given once, for all its rows
    # Ctrl-C reaches every process of the terminal; the first one decides.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    torch.set_num_threads(1)
    # Written by the process that started this one, and passed on in memory: nobody else's bytes.
    _plan = pickle.loads(material)  # noqa: S301  # nosec B301
    _messages = messages


def _measure(entry: Entry, failures: tuple[type[Exception], ...]) -> Exception | None:
    """The row's own failure: caught here, where it does not stop the others."""
    try:
        _plan.measure(entry, lambda *message: _messages.put(message))
    except failures as error:
        return error
    return None


def _pending(messages: SimpleQueue[_Message]) -> Iterator[_Message]:
    while not messages.empty():
        yield messages.get()
