"""Where the service is, and connections on which a time limit holds for a whole call.

httpx limits each wait on the socket: a server that sends a byte now and then could keep a client
for any multiple of that. anyio cancels coroutines at a deadline; for blocking calls, every wait
gets the rest of the call's time. (Only the system's resolution of names cannot be limited, for
blocking calls.)
"""

from __future__ import annotations

import ssl
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final
from urllib.parse import urlsplit

import anyio
import httpcore
import httpx

from scene_client.calls import Call, T
from scene_client.errors import InvalidRequestError, UnreachableError
from scene_client.schemas import FieldError

MAX_TIMEOUT: Final = 600.0
"""Seconds; the service takes no more."""

RETRIES: Final = 5
"""Further attempts at most, as far as there is time for them."""

MAX_CONNECTIONS: Final = 100
"""At once; further calls wait for a free connection, within their own time."""

KEEP_ALIVE: Final = 4.0
"""Seconds that an idle connection is kept: uvicorn closes it after five, and a request that crosses
with the closing is lost."""


@dataclass(frozen=True, slots=True)
class Options:
    """Arguments of `AsyncClient`, checked; ``url`` with the path that a proxy strips, if any.

    Raises:
        InvalidRequestError: there is no service at such a URL, or no call takes so long.
    """

    url: str
    timeout: float = 10.0
    api_key: str | None = field(default=None, repr=False)
    admin_key: str | None = field(default=None, repr=False)
    model: str | None = None
    retries: int = RETRIES

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise _refused("the URL must begin with http:// or https:// and name a host")
        if parts.query or parts.fragment:
            raise _refused("the URL must end with its path")
        if self.retries < 0:
            raise _refused("retries must not be negative")
        self.limit(self.timeout)

    def limit(self, timeout: float | None) -> float:
        """The seconds that a call may take.

        Raises:
            InvalidRequestError: no call takes so long, or so little.
        """
        seconds = self.timeout if timeout is None else timeout
        if not 1e-3 <= seconds <= MAX_TIMEOUT:
            raise _refused(f"the timeout must be from 0.001 to {MAX_TIMEOUT:g} seconds")
        return seconds

    def ssl_context(self) -> ssl.SSLContext:
        """Trusted certificates: the system's bundle; none without encryption."""
        if urlsplit(self.url).scheme == "https":
            return httpx.create_ssl_context()
        # Reading the bundle takes longer than a question.
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)

    def address(self, call: Call[T]) -> str:
        """The URL of a call."""
        return self.url.rstrip("/") + call.path

    def headers(self, call: Call[T], left: float) -> dict[str, str]:
        """The headers of a call that has so many seconds left."""
        headers = {
            "Accept": "application/json",
            # Not compressed: a small compressed body could unpack to any size.
            "Accept-Encoding": "identity",
            "X-Request-Timeout-Ms": str(max(1, int(left * 1e3))),
        }
        if call.body is not None:
            headers["Content-Type"] = "application/json"
        # The admin key is sent to administrative routes only.
        if call.administers and self.admin_key is not None:
            headers["X-Admin-Key"] = self.admin_key
        elif self.api_key is not None:
            headers["X-API-Key"] = self.api_key
        return headers

    def unreachable(self, error: Exception) -> UnreachableError:
        """The error of a call whose connection failed so."""
        parts = urlsplit(self.url)
        # A name and a password may stand before the host.
        host = parts.netloc.rpartition("@")[2]
        return UnreachableError(f"{parts.scheme}://{host}: {str(error) or type(error).__name__}")


def _refused(message: str) -> InvalidRequestError:
    return InvalidRequestError([FieldError(pointer="#", message=message)])


# ---------------------------------------------------------------------------------- coroutines

async_deadline = anyio.fail_after


def async_transport(ssl_context: ssl.SSLContext) -> httpx.AsyncHTTPTransport:
    """Pooled connections."""
    limits = httpx.Limits(max_connections=MAX_CONNECTIONS, keepalive_expiry=KEEP_ALIVE)
    return httpx.AsyncHTTPTransport(verify=ssl_context, limits=limits)


# ------------------------------------------------------------------------------ blocking calls


class _Deadline(threading.local):
    """Until when this thread may wait."""

    ends = float("inf")


_DEADLINE: Final = _Deadline()


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Limit the waits of this thread on connections of `DeadlineTransport`, all together."""
    _DEADLINE.ends = monotonic() + seconds
    try:
        yield
    finally:
        _DEADLINE.ends = float("inf")


def _left(timeout: float | None) -> float:
    """Seconds for the next wait.

    Raises:
        httpcore.TimeoutException: nothing is left. (A wait for data that are there already would
            succeed however short it was, and so for ever.)
    """
    left = _DEADLINE.ends - monotonic()
    if left <= 0:
        raise httpcore.TimeoutException("the time of the whole call is over")
    return left if timeout is None else min(timeout, left)


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream) -> None:
        self._stream = stream

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, _left(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._stream.write(buffer, _left(timeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,
    ) -> httpcore.NetworkStream:
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, _left(timeout)))

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


class _Backend(httpcore.SyncBackend):
    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        left = _left(timeout)
        return _Stream(super().connect_tcp(host, port, left, local_address, socket_options))


@contextmanager
def _as_httpx() -> Iterator[None]:
    try:
        yield
    except httpcore.TimeoutException as error:
        raise httpx.TimeoutException(str(error)) from error
    except httpcore.ConnectError as error:
        raise httpx.ConnectError(str(error)) from error
    except (httpcore.NetworkError, httpcore.ProtocolError) as error:
        raise httpx.TransportError(str(error)) from error


class _Body(httpx.SyncByteStream):
    def __init__(self, response: httpcore.Response) -> None:
        self._response = response

    def __iter__(self) -> Iterator[bytes]:
        with _as_httpx():
            yield from self._response.iter_stream()

    def close(self) -> None:
        self._response.close()


class DeadlineTransport(httpx.BaseTransport):
    """Pooled connections whose waits end with `deadline`."""

    def __init__(self, ssl_context: ssl.SSLContext) -> None:
        self._pool = httpcore.ConnectionPool(
            ssl_context,
            max_connections=MAX_CONNECTIONS,
            keepalive_expiry=KEEP_ALIVE,
            network_backend=_Backend(),
        )

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """See `httpx.BaseTransport`."""
        url = request.url
        sent = httpcore.Request(
            request.method,
            httpcore.URL(
                scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path
            ),
            headers=request.headers.raw,
            content=request.stream,
            extensions=request.extensions,
        )
        with _as_httpx():
            response = self._pool.handle_request(sent)
        return httpx.Response(response.status, headers=response.headers, stream=_Body(response))

    def close(self) -> None:
        """Close every connection."""
        self._pool.close()
