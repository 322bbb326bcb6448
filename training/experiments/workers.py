"""Measure rows in parallel: in local processes, or as tasks of Ray where Ray is installed.

A worker measures one row at a time with one thread. Workers write reports to the folder of the
plan, so the machines of a Ray cluster need a shared file system.
"""

from __future__ import annotations

import importlib
import multiprocessing
import os
import pickle  # nosec B403
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_EXCEPTION, Future, ProcessPoolExecutor, wait
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, Protocol, TypeAlias

import torch

from training.config import ConfigError
from training.experiments.rows import Row

# A progress function receives the row, the source, and a note on the current step.
Progress: TypeAlias = Callable[[str, str, str], None]
# Measures a row; returns the error of a row that failed.
Work: TypeAlias = Callable[[Row, Progress], Exception | None]
Submit: TypeAlias = Callable[[Row], "Future[Exception | None]"]

# Seconds between two checks for messages.
_TICK = 0.2
# Linear algebra libraries read these variables when a process loads them.
_THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


class Messages(Protocol):
    """A queue of arguments for `Progress`, from all workers."""

    def put(self, message: tuple[str, str, str], /) -> Any:
        """Add a message."""

    def get(self) -> tuple[str, str, str]:
        """Remove and return the oldest message."""

    def empty(self) -> bool:
        """Return whether all messages were read."""


def measure_in_workers(
    work: Work, rows: Sequence[Row], progress: Progress, workers: int, ray: str = ""
) -> dict[tuple[str, int], Exception]:
    """Measure rows in workers; return the errors of failed rows by (name, seed).

    Args:
        workers: number of local processes.
        ray: address of a Ray cluster, or "local" for a new one; empty uses local processes.
    """
    # Pickling avoids the shared memory of torch, which is small in containers.
    material = pickle.dumps(work)
    started = _ray_tasks(material, ray) if ray else _processes(material, workers)
    with started as (submit, messages):
        futures = {submit(row): (row.name, row.seed) for row in rows}
        while True:
            done, waiting = wait(futures, _TICK, FIRST_EXCEPTION)
            while not messages.empty():
                progress(*messages.get())
            failed = {futures[future]: error for future in done if (error := future.result())}
            if not waiting:
                return failed


def _measure(material: bytes, messages: Messages, row: Row) -> Exception | None:
    torch.set_num_threads(1)
    return _work_of(material)(row, lambda *message: messages.put(message))


@lru_cache(maxsize=1)
def _work_of(material: bytes) -> Work:
    # The main process wrote these bytes and passed them on in memory.
    work: Work = pickle.loads(material)  # noqa: S301  # nosec B301
    return work


# -- Ray -----------------------------------------------------------------------------------------


@contextmanager
def _ray_tasks(material: bytes, address: str) -> Iterator[tuple[Submit, Messages]]:
    """Run rows as Ray tasks of one core each.

    Raises:
        ConfigError: Ray is not installed.
    """
    try:
        ray = importlib.import_module("ray")
        queue = importlib.import_module("ray.util.queue")
    except ImportError as error:
        raise ConfigError("--ray needs the package ray: pip install ray") from error
    ray.init(address=address, runtime_env={"env_vars": _THREADS}, log_to_driver=False)
    try:
        messages: Messages = queue.Queue()
        stored = ray.put(material)
        task = ray.remote(num_cpus=1, max_retries=0)(_measure)
        yield lambda row: task.remote(stored, messages, row).future(), messages
    finally:
        # This ends the tasks that still run.
        ray.shutdown()


# -- processes -----------------------------------------------------------------------------------

_material: bytes
_messages: Messages


@contextmanager
def _processes(material: bytes, workers: int) -> Iterator[tuple[Submit, Messages]]:
    context = multiprocessing.get_context("spawn")
    # SimpleQueue has no sending thread, so all messages of a finished row are already in the queue.
    messages: Messages = context.SimpleQueue()
    with (
        _one_thread(),
        ProcessPoolExecutor(
            workers, context, initializer=_begin, initargs=(material, messages)
        ) as pool,
    ):
        try:
            yield lambda row: pool.submit(_measure_here, row), messages
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            for process in multiprocessing.active_children():
                process.terminate()
            raise


@contextmanager
def _one_thread() -> Iterator[None]:
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(_THREADS)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value


def _begin(material: bytes, messages: Messages) -> None:
    global _material, _messages  # set once in each worker
    # Ctrl-C reaches every process of the terminal; only the main process handles it.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _material, _messages = material, messages


def _measure_here(row: Row) -> Exception | None:
    return _measure(_material, _messages, row)
