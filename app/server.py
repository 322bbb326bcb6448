"""The server: uvicorn with a graceful shutdown."""

import asyncio
import errno
import fcntl
import logging
import os
import signal
import socket
import struct
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from time import monotonic
from types import FrameType
from typing import Any, Final

import uvicorn
from uvicorn.protocols.http.httptools_impl import HttpToolsProtocol, RequestResponseCycle

from app.api.health import HealthPort
from app.errors import ServiceError
from app.main import create_app
from app.serving.logs import flush, log_config
from app.serving.runtime import Runtime
from app.settings import Settings, warnings

# A socket with one of these addresses listens on every address of the machine.
_ANY: Final = frozenset(("0.0.0.0", "::"))  # noqa: S104 # nosec B104
# Request to the kernel of Linux for the address of a network interface; see netdevice(7).
_SIOCGIFADDR: Final = 0x8915

_logger = logging.getLogger("app.server")


class Connection(HttpToolsProtocol):
    """A connection that tells each pipelined request that the client has disconnected.

    uvicorn tells only the last request. The request in progress would then fail at its answer,
    because the connection is closed, and would count as a defect of the service.
    """

    def __init__(self, *args: Any, **options: Any) -> None:
        super().__init__(*args, **options)
        self._unfinished: deque[RequestResponseCycle] = deque()

    def on_headers_complete(self) -> None:
        """Begin a request, or queue it behind the request in progress."""
        super().on_headers_complete()
        while self._unfinished and self._unfinished[0].response_complete:
            self._unfinished.popleft()
        self._unfinished.append(self.cycle)

    def connection_lost(self, exc: Exception | None) -> None:
        """Tell all requests that the client has disconnected."""
        for request in self._unfinished:
            request.disconnected = not request.response_complete
            request.message_event.set()
        self._unfinished.clear()
        super().connection_lost(exc)


class Server(uvicorn.Server):
    """A server that shuts down in three steps on SIGTERM.

    1. For ``drain_seconds``, the server answers readiness checks with 503, so that load balancers
       notice, and closes each connection after its answer. A second signal, or Ctrl-C, ends this
       step at once.
    2. The server closes the listening socket.
    3. The server finishes the requests in progress.

    ``began`` is `time.monotonic()` at the start of the process. ``health`` are the sockets of the
    port for health checks.
    """

    def __init__(self, settings: Settings, began: float, health: list[socket.socket]) -> None:
        app = create_app(settings)
        config = uvicorn.Config(
            app,
            root_path=settings.root_path,
            http=Connection,
            ws="none",
            limit_concurrency=settings.max_connections,
            # A proxy must close idle connections earlier. Otherwise it may send a request while the
            # server closes the connection.
            timeout_keep_alive=20,
            log_config=log_config(settings),
            access_log=False,
            server_header=False,
            # Behind a proxy, X-Forwarded-For tells the clients apart that share the queues.
            proxy_headers=bool(settings.trusted_proxies),
            forwarded_allow_ips=list(settings.trusted_proxies),
            timeout_graceful_shutdown=settings.drain_timeout,
        )
        super().__init__(config)
        for warning in warnings():
            _logger.warning(warning)
        self._runtime: Runtime = app.state.runtime
        self._health = HealthPort(self._runtime, health) if health else None
        self._watching: asyncio.Task[None] | None = None
        self._settings = settings
        self._closing_at: float | None = None
        self._began = began
        self._has_terminal = os.isatty(0)

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
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
        if self._health is not None:
            self._watching = asyncio.create_task(self._health.watch())
        asyncio.get_running_loop().add_signal_handler(signal.SIGHUP, self._handle_hangup)
        self._log_addresses(sockets or [])

    def _handle_hangup(self) -> None:
        """Load the changes in the store, or shut down if the terminal of the service is closed."""
        if self._has_terminal and not os.isatty(0):
            self.handle_exit(signal.SIGTERM, None)
        else:
            self._runtime.request_check()

    def _log_addresses(self, sockets: list[socket.socket]) -> None:
        """Log the URLs of the service, whether its models are ready, and whether it needs a key."""
        port = sockets[0].getsockname()[1]
        hosts = dict.fromkeys(listener.getsockname()[0] for listener in sockets)
        others = [host for host in hosts if host not in _ANY]
        pages = ", ".join(_page(host, port) for host in others or ["127.0.0.1"])
        count = len(self._runtime.models.served)
        models = "1 model" if count == 1 else f"{count} models"
        details = f"{pages} ({models}, {monotonic() - self._began:.1f} s)"
        try:
            self._runtime.check_ready()
        except ServiceError as error:
            _logger.warning("not ready: %s: %s", details, error)
        else:
            _logger.info("ready: %s", details)
        if not self._settings.serves_network:
            return
        if not others:
            pages = ", ".join(_page(host, port) for host in _lan_addresses())
        _logger.info("from other machines: %s (docs/network.md)", pages)
        if self._settings.api_key is None:
            _logger.warning(
                "every machine that reaches port %d can use the service: SCENE_API_KEY is not set; "
                "set it to at least 16 characters",
                port,
            )

    @contextmanager
    def capture_signals(self) -> Iterator[None]:
        """Handle signals in the ``with`` block. After it, they end the process as usual."""
        with super().capture_signals():
            try:
                yield
            finally:
                flush()

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Start the shutdown, or end its first step. During the start, end the process at once."""
        if not self.started:
            flush()
            signal.signal(sig, signal.SIG_DFL)
            signal.raise_signal(sig)
        is_first, self._runtime.draining = not self._runtime.draining, True
        if sig == signal.SIGTERM and is_first:
            self._closing_at = monotonic() + self._settings.drain_seconds
        else:
            super().handle_exit(sig, frame)

    async def on_tick(self, counter: int) -> bool:
        """Return whether the server must stop. uvicorn calls this method ten times per second."""
        if self._closing_at is not None and monotonic() >= self._closing_at:
            self._closing_at = None
            super().handle_exit(signal.SIGTERM, None)
        return await super().on_tick(counter)


def _listens(listener: socket.socket) -> bool:
    try:
        return listener.getsockopt(socket.SOL_SOCKET, socket.SO_ACCEPTCONN) == 1
    except OSError:  # the socket is closed
        return False


def _page(host: str, port: int) -> str:
    """Return the URL of the service at one of its addresses."""
    return f"http://[{host}]:{port}/" if ":" in host else f"http://{host}:{port}/"


def _lan_addresses() -> list[str]:
    """Return the IPv4 addresses of this machine, except the loopback, or else its `.local` name."""
    addresses = []
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        for _, name in socket.if_nameindex():
            with suppress(OSError):  # the interface has no address
                answer = fcntl.ioctl(probe, _SIOCGIFADDR, struct.pack("256s", name.encode()))
                addresses.append(socket.inet_ntoa(answer[20:24]))
    name = f"{socket.gethostname().partition('.')[0]}.local"
    return [address for address in addresses if not address.startswith("127.")] or [name]
