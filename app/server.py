"""The server: uvicorn with a graceful shutdown."""

from __future__ import annotations

import asyncio
import errno
import logging
import os
import resource
import signal
from socket import SO_ACCEPTCONN, SOL_SOCKET, socket
from time import monotonic
from types import FrameType
from typing import ClassVar, Final

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol

from app.errors import ServiceError
from app.main import create_app
from app.serving.logs import log_config
from app.serving.runtime import Runtime
from app.settings import Settings, warnings

# The server closes a connection after this idle time in seconds. A proxy must close its idle
# connections earlier. Otherwise the proxy may send a request while the server closes the
# connection.
KEEP_ALIVE: Final = 20
# The server closes a connection that sends no request in this time in seconds.
SILENT: Final = 10
# uvicorn refuses requests above its limit of connections. So this limit leaves room for connections
# that the service is closing in the same iteration of the event loop.
_CLOSING: Final = 32
# Number of file descriptors for other purposes: closing connections, models, logs, event loop.
_OTHER_FILES: Final = 64

_logger = logging.getLogger("app.server")


class Connection(HttpToolsProtocol):
    """An HTTP connection that ignores the trailers of chunked bodies, and never blocks a new one.

    uvicorn appends trailers to the headers of the request, so a trailer could replace a header that
    a proxy has checked or removed.

    If the service has its maximum number of connections, a new connection closes the one that has
    been idle for the longest time. So idle connections cannot keep health checks out.

    Attributes:
        idle: connections without a request in progress, the longest idle first, and since when.
        has_asked: whether the connection has sent a request.
    """

    idle: ClassVar[dict[Connection, float]] = {}
    has_asked = False

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        """Make room for the connection."""
        super().connection_made(transport)
        if len(self.connections) > (self.limit_concurrency or 0) - _CLOSING:
            for connection in Connection.idle:
                connection.close()
                break
        Connection.idle[self] = monotonic()

    def connection_lost(self, exc: Exception | None) -> None:
        """Forget the connection."""
        Connection.idle.pop(self, None)
        super().connection_lost(exc)

    def on_headers_complete(self) -> None:
        """Start the request with the headers so far. The parser adds trailers to `self.headers`."""
        Connection.idle.pop(self, None)
        self.has_asked = True
        super().on_headers_complete()
        self.scope["headers"] = self.headers.copy()

    def on_response_complete(self) -> None:
        """Start the next pipelined request, or wait for one."""
        super().on_response_complete()
        if self.cycle.response_complete:
            Connection.idle[self] = monotonic()

    def close(self) -> None:
        """Close the connection, which is idle."""
        Connection.idle.pop(self, None)
        self.transport.close()

    @classmethod
    def close_silent(cls) -> None:
        """Close connections that have been open for `SILENT` seconds without a request."""
        began = monotonic() - SILENT
        for connection, since in list(cls.idle.items()):
            if since < began and not connection.has_asked:
                connection.close()


class Server(uvicorn.Server):
    """A server that shuts down in three steps on SIGTERM.

    1. The server answers readiness checks with 503 and closes each connection after its answer.
       This step takes ``drain_seconds``, so that load balancers notice the failing readiness check.
       A second signal, or Ctrl-C, ends this step at once.
    2. The server closes the listening socket.
    3. The server finishes the requests in progress.

    Args:
        config: configuration of uvicorn.
        runtime: the runtime of the service. It is not ready during the shutdown.
        drain_seconds: time in seconds from SIGTERM until the server closes the listening socket.
        began: `time.monotonic()` at the start of the process.
    """

    def __init__(
        self, config: uvicorn.Config, runtime: Runtime, drain_seconds: float, began: float
    ) -> None:
        super().__init__(config)
        self._runtime = runtime
        self._drain_seconds = drain_seconds
        self._closing_at: float | None = None
        self._began = began
        self._has_terminal = os.isatty(0)

    async def startup(self, sockets: list[socket] | None = None) -> None:
        """Load the models, accept connections and log the addresses of the service.

        Raises:
            OSError: another program has started to listen on the same port.
        """
        try:
            await super().startup(sockets)
            # uvloop does not raise an exception if a socket cannot listen, so check each socket.
            if not all(map(_listens, sockets or [])):
                raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE))
        except OSError:
            self.started = False
            await self.lifespan.shutdown()
            raise
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._handle_hangup)
        self._log_addresses(sockets or [])

    def _handle_hangup(self) -> None:
        """Load the changes in the store, or shut down if the terminal of the service is closed."""
        if self._has_terminal and not os.isatty(0):
            self.handle_exit(signal.SIGTERM, None)
        else:
            self._runtime.request_check()

    def _log_addresses(self, sockets: list[socket]) -> None:
        addresses = [listener.getsockname() for listener in sockets]
        pages = ", ".join(_page(host, port) for host, port, *_ in addresses)
        count = len(self._runtime.models.served)
        models = "1 model" if count == 1 else f"{count} models"
        details = f"{pages} ({models}, {monotonic() - self._began:.1f} s)"
        try:
            self._runtime.check_ready()
        except ServiceError as error:
            _logger.warning("not ready: %s: %s", details, error)
        else:
            _logger.info("ready: %s", details)

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Start the shutdown. A second signal ends the first step of the shutdown at once."""
        is_first, self._runtime.draining = not self._runtime.draining, True
        if sig == signal.SIGTERM and is_first:
            self._closing_at = monotonic() + self._drain_seconds
        else:
            super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Return whether the server must stop. uvicorn calls this method ten times per second."""
        if counter % 10 == 0:
            Connection.close_silent()
        if self._closing_at is not None and monotonic() >= self._closing_at:
            self._closing_at = None
            super().handle_exit(signal.SIGTERM, None)
        return await super().on_tick(counter)


def _listens(listener: socket) -> bool:
    try:
        return listener.getsockopt(SOL_SOCKET, SO_ACCEPTCONN) == 1
    except OSError:  # the socket is closed
        return False


def _page(host: str, port: int) -> str:
    """Return the URL of the service for a browser on the same machine."""
    host = {"0.0.0.0": "127.0.0.1", "::": "::1"}.get(host, host)  # noqa: S104 # nosec B104
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def most_connections(wanted: int) -> int:
    """Return the number of connections for which the process may open files."""
    files = resource.getrlimit(resource.RLIMIT_NOFILE)[0]
    if files == resource.RLIM_INFINITY:
        return wanted
    most = max(files - _OTHER_FILES, _OTHER_FILES)
    if wanted > most:
        _logger.warning(
            "the service accepts %d connections, not SCENE_MAX_CONNECTIONS=%d, because it may open "
            "only %d files (ulimit -n)",
            *(most, wanted, most + _OTHER_FILES),
        )
    return min(wanted, most)


def build(settings: Settings, began: float) -> Server:
    """Return the server, not yet started. Warn if other machines can use it without a key.

    ``began`` is `time.monotonic()` at the start of the process.
    """
    app = create_app(settings)
    config = uvicorn.Config(
        app,
        host=settings.host,
        port=settings.port,
        root_path=settings.root_path,
        http=Connection,
        ws="none",
        limit_concurrency=most_connections(settings.max_connections) + _CLOSING,
        timeout_keep_alive=KEEP_ALIVE,
        log_config=log_config(settings.log_level, settings.log_format, settings.secrets),
        access_log=False,
        server_header=False,
        # Behind a proxy, X-Forwarded-For tells the clients apart that share the queues.
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=list(settings.trusted_proxies),
        timeout_graceful_shutdown=settings.drain_timeout,
    )
    for warning in warnings():
        _logger.warning(warning)
    if settings.is_open:
        _logger.warning(
            "SCENE_HOST gives other machines access and SCENE_API_KEY is not set, so every machine "
            "that reaches port %d can use the service",
            settings.port,
        )
    return Server(config, app.state.runtime, settings.drain_seconds, began)
