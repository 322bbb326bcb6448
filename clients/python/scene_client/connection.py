"""Options of a client, and connections with a deadline for a whole call.

A timeout of httpx limits only each single wait on the socket. If a server sends single bytes, a
call could take much longer than the timeout. So anyio cancels the coroutine of an asynchronous call
at the deadline. In a blocking call, each wait on the socket ends at the deadline at the latest.
Only the name resolution of blocking calls has no time limit.
"""

from __future__ import annotations

import ssl
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass, field
from time import monotonic
from typing import Any, Final
from urllib.parse import urlsplit

import anyio
import httpcore
import httpx

from scene_client.calls import Call, T
from scene_client.errors import InvalidRequestError, UnreachableError

MAX_TIMEOUT: Final = 600.0
"""Maximum timeout of a call in seconds. The service has the same maximum."""

RETRIES: Final = 5
"""Default for the maximum number of retries of a call."""

MAX_CONNECTIONS: Final = 100
"""Maximum number of open connections of a client. Further calls wait for a free connection."""

MAX_ANSWER: Final = 256 * 2**20
"""Maximum size of an answer in bytes, above that of 256 scenes with 4,096 relations each."""

KEEP_ALIVE: Final = 4.0
"""The client closes a connection after this idle time in seconds.

By default, uvicorn closes an idle connection after five seconds, and a request sent at that moment
would be lost."""

_refused: Final = InvalidRequestError.about


@dataclass(frozen=True, slots=True)
class Options:
    """The checked arguments of `AsyncClient`.

    If a proxy strips a path prefix, ``url`` must include this prefix.

    Raises:
        InvalidRequestError: the URL, the timeout, a key or the number of retries is invalid.
    """

    url: str
    timeout: float = 10.0
    api_key: str | None = field(default=None, repr=False)
    model: str | None = None
    retries: int = RETRIES

    def __post_init__(self) -> None:
        parts = urlsplit(self.url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise _refused("the URL must start with http:// or https:// and contain a host")
        if parts.query or parts.fragment:
            raise _refused("the URL must not have a query or a fragment")
        if not all("!" <= letter <= "~" for letter in self.api_key or ""):
            raise _refused("a key must have only ASCII characters, without spaces or line breaks")
        if self.retries < 0:
            raise _refused("the number of retries must not be negative")
        self.limit(self.timeout)

    def limit(self, timeout: float | None) -> float:
        """Return the timeout of a call in seconds.

        Raises:
            InvalidRequestError: the timeout is out of range.
        """
        seconds = self.timeout if timeout is None else timeout
        if not 1e-3 <= seconds <= MAX_TIMEOUT:
            raise _refused(f"the timeout must be from 0.001 to {MAX_TIMEOUT:g} seconds")
        return seconds

    def ssl_context(self) -> ssl.SSLContext:
        """Return the SSL context. For https, it trusts the authorities of the package certifi.

        The environment variable SSL_CERT_FILE or SSL_CERT_DIR selects other authorities.
        """
        if urlsplit(self.url).scheme == "https":
            return httpx.create_ssl_context()
        # For http, no authorities are needed. To load them takes longer than a question.
        return ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)

    def headers(self, call: Call[T], left: float) -> dict[str, str]:
        """Return the HTTP headers of a call whose deadline is in `left` seconds."""
        headers = {
            "Accept": "application/json",
            # The client asks for uncompressed answers, because a small compressed answer could
            # decompress to any size.
            "Accept-Encoding": "identity",
            "X-Request-Timeout-Ms": str(max(1, int(left * 1e3))),
        }
        if call.body is not None:
            headers["Content-Type"] = "application/json"
        if self.api_key is not None:
            headers["X-API-Key"] = self.api_key
        return headers

    def unreachable(self, error: Exception) -> UnreachableError:
        """Convert an exception of the connection to `UnreachableError`."""
        parts = urlsplit(self.url)
        # The message must not contain the user name and the password of the URL.
        host = parts.netloc.rpartition("@")[2]
        return UnreachableError(f"{parts.scheme}://{host}: {str(error) or type(error).__name__}")


async_deadline = anyio.fail_after


def async_transport(ssl_context: ssl.SSLContext) -> httpx.AsyncHTTPTransport:
    """Return an httpx transport with a pool of connections."""
    limits = httpx.Limits(max_connections=MAX_CONNECTIONS, keepalive_expiry=KEEP_ALIVE)
    return httpx.AsyncHTTPTransport(verify=ssl_context, limits=limits)


# The deadline of the current call as a value of `time.monotonic`. Each thread has its own context.
_DEADLINE: Final = ContextVar("deadline", default=float("inf"))


@contextmanager
def deadline(seconds: float) -> Iterator[None]:
    """Limit the total time for which this thread waits on connections of `DeadlineTransport`."""
    token = _DEADLINE.set(monotonic() + seconds)
    try:
        yield
    finally:
        _DEADLINE.reset(token)


def _seconds_left(timeout: float | None) -> float:
    """Return the maximum time of the next wait in seconds."""
    seconds = _DEADLINE.get() - monotonic()
    if seconds <= 0:  # else a read of data that have already arrived would succeed
        raise httpcore.TimeoutException("the timeout of the call has expired")
    return seconds if timeout is None else min(timeout, seconds)


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream) -> None:
        self._stream = stream

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, _seconds_left(timeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._stream.write(buffer, _seconds_left(timeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,
    ) -> httpcore.NetworkStream:
        return _Stream(self._stream.start_tls(ssl_context, server_hostname, _seconds_left(timeout)))

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
        left = _seconds_left(timeout)
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
    """Pool of connections for blocking calls. A wait on a connection ends at the `deadline`."""

    def __init__(self, ssl_context: ssl.SSLContext) -> None:
        self._pool = httpcore.ConnectionPool(
            ssl_context,
            max_connections=MAX_CONNECTIONS,
            keepalive_expiry=KEEP_ALIVE,
            network_backend=_Backend(),
        )

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send one request and return the response."""
        url = request.url
        target = httpcore.URL(
            scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path
        )
        call = httpcore.Request(
            request.method,
            target,
            headers=request.headers.raw,
            content=request.stream,
            extensions=request.extensions,
        )
        with _as_httpx():
            response = self._pool.handle_request(call)
        return httpx.Response(response.status, headers=response.headers, stream=_Body(response))

    def close(self) -> None:
        """Close all connections."""
        self._pool.close()
