"""The process above the workers: binds the address, keeps them running, ends them.

It loads no model and no torch. A worker that ends is replaced: at once if it had served for a
while, after a growing pause if it ends again and again. Where no worker serves and none comes to
serve, it gives up, since whoever started it can see that and not a loop.
"""

from __future__ import annotations

import asyncio
import logging
import os
import shutil
import signal
import socket
import subprocess  # nosec B404
import sys
import tempfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass

import uvicorn

from app.serving.logs import log_config
from app.settings import Settings
from app.workers.agreement import Agreement, Member, RefusedError
from app.workers.wire import open_channel

WORKER = (sys.executable, "-m", "app.workers.worker")
"""Command of a worker, which is given the descriptors of its listening socket and its channel."""

_METRICS = "PROMETHEUS_MULTIPROC_DIR"

_logger = logging.getLogger("app.workers")


@dataclass(frozen=True, slots=True)
class Patience:
    """How long the supervisor waits, in seconds.

    Attributes:
        prepare: for a worker that starts, or makes ready for a change; first starts compile loops.
        swap: for a worker that is to swap its models.
        drain: for workers that were told to stop.
        stable: a worker that served for so long did not end at once.
        pause: before the first restart of one that did; doubled with each further one.
        longest_pause: the most it is doubled to.
        starts: as many failed starts in a row, in every place, are enough to give up.
    """

    prepare: float = 120.0
    swap: float = 30.0
    drain: float = 25.0
    stable: float = 10.0
    pause: float = 0.5
    longest_pause: float = 30.0
    starts: int = 3


def supervise(settings: Settings) -> int:
    """Serve from several processes until stopped.

    Args:
        settings: of the service; the workers read the same ones from the environment.

    Returns:
        The exit status: 3 where no worker comes to serve.
    """
    server = uvicorn.Config(
        "app",
        host=settings.host,
        port=settings.port,
        log_config=log_config(settings.log_level, settings.log_format, settings.secrets),
    )
    # Bound and not listening: connections are refused until the first worker is ready.
    patience = Patience(drain=settings.longest_drain)
    with server.bind_socket() as listener, _metrics_directory(settings) as metrics:
        return asyncio.run(
            Supervisor(listener, settings.workers, metrics=metrics, patience=patience).run(),
        )


@contextmanager
def _metrics_directory(settings: Settings) -> Iterator[str | None]:
    """Where workers put their metrics for each other; None where none are wanted."""
    if not settings.metrics:
        yield None
        return
    path = tempfile.mkdtemp(prefix="scene-metrics-")
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)


@contextmanager
def _on_signals(stop: Callable[[], None]) -> Iterator[None]:
    loop = asyncio.get_running_loop()
    signals = (signal.SIGTERM, signal.SIGINT)
    for signum in signals:
        loop.add_signal_handler(signum, stop)
    try:
        yield
    finally:
        for signum in signals:
            loop.remove_signal_handler(signum)


class _Worker:
    """One process, and what the supervisor knows of it."""

    def __init__(self, process: subprocess.Popen[bytes], member: Member) -> None:
        self.process = process
        self.member = member

    async def reap(self) -> int:
        """Its exit status, once it is gone; its channel closes just before it ends, or with it."""
        await self.member.gone.wait()
        for _ in range(50):
            if (status := self.process.poll()) is not None:
                return status
            await asyncio.sleep(0.1)
        self.process.kill()
        return self.process.wait()


class Supervisor:
    """Keeps a number of workers running.

    Args:
        listener: bound socket that all workers accept from.
        count: how many.
        metrics: directory of their metrics, if there are any.
        command: what starts one; see `WORKER`.
        patience: how long to wait for what.
    """

    def __init__(
        self,
        listener: socket.socket,
        count: int,
        *,
        metrics: str | None = None,
        command: Sequence[str] = WORKER,
        patience: Patience | None = None,
    ) -> None:
        self._listener = listener
        self._count = count
        self._metrics = metrics
        self._command = command
        self._patience = patience or Patience()
        self._agreement = Agreement(
            patience=self._patience.prepare, swap_patience=self._patience.swap
        )
        self._workers: set[_Worker] = set()
        self._listening: set[asyncio.Task[None]] = set()
        self._failed_starts = [0] * count
        self._stop = asyncio.Event()
        self._hopeless = False

    async def run(self) -> int:
        """Run until SIGTERM or SIGINT.

        Returns:
            The exit status: 3 where no worker came to serve.
        """
        with _on_signals(self._stop.set):
            return await self._run()

    async def _run(self) -> int:
        places = [asyncio.create_task(self._keep(place)) for place in range(self._count)]
        stop = asyncio.create_task(self._stop.wait())
        # Keeping a place never ends by itself, but for a defect of this program.
        await asyncio.wait([stop, *places], return_when=asyncio.FIRST_COMPLETED)
        for task in places:
            task.cancel()
        ends = await asyncio.gather(*places, return_exceptions=True)
        await self._drain()
        for end in ends:
            if isinstance(end, Exception):
                raise end
        return 3 if self._hopeless else 0

    async def _keep(self, place: int) -> None:
        """Have one worker after another in this place."""
        pauses = 0
        while True:
            served = 0.0
            try:
                worker = await self._start()
            except OSError as error:  # no memory or no process left for it
                self._failed_starts[place] += 1
                _logger.error("no worker can be started: %s", error)
            else:
                served = await self._serve(worker, place)
                self._note_end(worker, await worker.reap())
            if served >= self._patience.stable:
                pauses = 0
                continue
            self._give_up_if_hopeless()
            pause = min(self._patience.longest_pause, self._patience.pause * 2**pauses)
            pauses += 1
            _logger.warning("starting another worker in %g s", pause)
            await asyncio.sleep(pause)

    async def _start(self) -> _Worker:
        ours, theirs = socket.socketpair()
        with theirs:
            channel = await open_channel(ours)
            try:
                process = self._spawn(theirs)
            except OSError:
                channel.close()
                raise
        # Nothing is awaited from here on, so that a stop never overlooks a process.
        worker = _Worker(process, Member(channel, process.pid, process.kill))
        self._workers.add(worker)
        listening = asyncio.create_task(worker.member.listen(self._agreement.begin))
        self._listening.add(listening)
        listening.add_done_callback(self._listening.discard)
        return worker

    def _spawn(self, channel: socket.socket) -> subprocess.Popen[bytes]:
        descriptors = (self._listener.fileno(), channel.fileno())
        environment = dict(os.environ)
        if self._metrics is not None:
            environment[_METRICS] = self._metrics
        # Started anew and not forked: a copy of a process with threads may hang in its locks.
        # Our own command, with numbers for arguments.
        return subprocess.Popen(  # noqa: S603  # nosec B603
            [*self._command, *map(str, descriptors)], pass_fds=descriptors, env=environment
        )

    async def _serve(self, worker: _Worker, place: int) -> float:
        """Let a worker serve until it is gone; the seconds that it did."""
        member = worker.member
        try:
            await self._agreement.admit(member)
        except (RefusedError, ConnectionError, TimeoutError) as error:
            self._failed_starts[place] += 1
            reason = "it takes too long" if isinstance(error, TimeoutError) else str(error)
            _logger.error("worker %d does not come to serve: %s", member.pid, reason)
            member.kill()
            return 0.0
        self._failed_starts[place] = 0
        began = asyncio.get_running_loop().time()
        serving = len(self._agreement.members)
        _logger.info("worker %d serves, %d of %d", member.pid, serving, self._count)
        await member.gone.wait()
        return asyncio.get_running_loop().time() - began

    def _note_end(self, worker: _Worker, status: int) -> None:
        self._workers.discard(worker)
        self._agreement.dismiss(worker.member)
        how = f"by signal {-status}" if status < 0 else f"with status {status}"
        _logger.warning("worker %d ended %s", worker.process.pid, how)
        self._forget_metrics(worker)

    def _forget_metrics(self, worker: _Worker) -> None:
        if self._metrics is not None:
            from prometheus_client import multiprocess

            pid = worker.process.pid
            multiprocess.mark_process_dead(pid, self._metrics)  # type: ignore[no-untyped-call]

    def _give_up_if_hopeless(self) -> None:
        if self._agreement.members or min(self._failed_starts) < self._patience.starts:
            return
        _logger.critical(
            "no worker comes to serve after %d starts each: giving up", self._patience.starts
        )
        self._hopeless = True
        self._stop.set()

    async def _drain(self) -> None:
        """Tell all workers to stop, and wait until they have answered what they are asked."""
        members = self._agreement.members
        for worker in self._workers:
            # One that does not serve yet has nothing to finish, and may not listen to signals yet.
            stop = signal.SIGTERM if worker.member in members else signal.SIGKILL
            worker.process.send_signal(stop)
        with suppress(TimeoutError):
            async with asyncio.timeout(self._patience.drain):
                await asyncio.gather(*(worker.reap() for worker in self._workers))
        for worker in self._workers:
            if worker.process.poll() is None:
                _logger.error("worker %d did not stop in time: killed", worker.process.pid)
                worker.process.kill()
                worker.process.wait()
