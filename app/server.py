"""The server: uvicorn's, which drains before it stops."""

from __future__ import annotations

import signal
from time import monotonic
from types import FrameType

import uvicorn

from app.api import connections, sockets
from app.main import create_app
from app.serving.logs import log_config
from app.serving.runtime import Runtime
from app.serving.stream import Streams
from app.settings import Settings


class Server(uvicorn.Server):
    """Ends in three steps on SIGTERM.

    At once nothing new is taken, readiness says so, and streams take their leave; after
    ``drain_seconds``, in which a load balancer may notice, the listening socket is closed; then
    what is under way is finished. A second signal, or Ctrl-C, leaves the first step out.
    """

    def __init__(
        self, config: uvicorn.Config, runtime: Runtime, streams: Streams, drain_seconds: float
    ) -> None:
        super().__init__(config)
        self._runtime = runtime
        self._streams = streams
        self._drain_seconds = drain_seconds
        self._closing_at: float | None = None

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Uvicorn's handler of signals."""
        if sig == signal.SIGTERM and not self._runtime.draining and self._drain_seconds:
            self._runtime.drain()
            self._captured_signals.append(sig)
            self._closing_at = monotonic() + self._drain_seconds
            return
        self._runtime.drain()
        super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Whether to close the socket now; asked ten times a second."""
        # Here, and not where signals are handled: that is between any two steps of the loop.
        if self._runtime.draining:
            self._streams.drain()
        if self._closing_at is not None and monotonic() >= self._closing_at:
            self.should_exit = True
        return await super().on_tick(counter)


def build(settings: Settings) -> Server:
    """The service behind a server of its own, not started yet."""
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        root_path=settings.root_path,
        http=connections.guarded(settings.client_timeout),
        ws=sockets.guarded(settings.client_timeout),
        ws_max_size=settings.max_body_bytes,
        ws_ping_interval=settings.client_timeout,
        ws_ping_timeout=settings.client_timeout,
        log_config=log_config(settings.log_level, settings.log_format, settings.secrets),
        access_log=False,
        server_header=False,
        timeout_graceful_shutdown=settings.drain_timeout,
    )
    return Server(config, app.state.runtime, app.state.streams, settings.drain_seconds)
