"""HTTP whose time limit holds for the whole exchange.

httpx limits each wait on the socket: a server that sends a byte now and then, or a slow connection
and then a slow answer, may keep a caller for any multiple of that. Here every wait gets what is
left of the request's time. (Only the system's resolution of names cannot be limited, for callers
that block.)
"""

from __future__ import annotations

import ssl
import threading
from collections.abc import AsyncIterator, Iterable, Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any, Final

import anyio
import httpcore
import httpx

MAX_CONNECTIONS: Final = 100
"""At once; further calls wait for a free connection, within their own time."""

KEEP_ALIVE: Final = 4.0
"""Seconds that an idle connection is kept: uvicorn closes it after five, and a request that crosses
with the closing is lost."""


class _Left(threading.local):
    """Until when the request of this thread may wait."""

    ends = float("inf")

    def of(self, timeout: float | None, late: type[httpcore.TimeoutException]) -> float:
        """Seconds for the next wait.

        Raises:
            httpcore.TimeoutException: of the kind ``late``, as nothing is left. A wait whose data
                are there already would succeed however short it was, and so for ever.
        """
        left = self.ends - monotonic()
        if left <= 0:
            raise late("the time of the whole request is over")
        return left if timeout is None else min(timeout, left)


class _Stream(httpcore.NetworkStream):
    def __init__(self, stream: httpcore.NetworkStream, left: _Left) -> None:
        self._stream = stream
        self._left = left

    def read(self, max_bytes: int, timeout: float | None = None) -> bytes:
        return self._stream.read(max_bytes, self._left.of(timeout, httpcore.ReadTimeout))

    def write(self, buffer: bytes, timeout: float | None = None) -> None:
        self._stream.write(buffer, self._left.of(timeout, httpcore.WriteTimeout))

    def close(self) -> None:
        self._stream.close()

    def start_tls(
        self,
        ssl_context: ssl.SSLContext,
        server_hostname: str | None = None,
        timeout: float | None = None,
    ) -> httpcore.NetworkStream:
        left = self._left.of(timeout, httpcore.ConnectTimeout)
        stream = self._stream.start_tls(ssl_context, server_hostname, left)
        return _Stream(stream, self._left)

    def get_extra_info(self, info: str) -> Any:
        return self._stream.get_extra_info(info)


class _Backend(httpcore.NetworkBackend):
    def __init__(self, left: _Left) -> None:
        self._backend = httpcore.SyncBackend()
        self._left = left

    def connect_tcp(
        self,
        host: str,
        port: int,
        timeout: float | None = None,
        local_address: str | None = None,
        socket_options: Iterable[httpcore.SOCKET_OPTION] | None = None,
    ) -> httpcore.NetworkStream:
        left = self._left.of(timeout, httpcore.ConnectTimeout)
        stream = self._backend.connect_tcp(host, port, left, local_address, socket_options)
        return _Stream(stream, self._left)


@contextmanager
def _as_httpx() -> Iterator[None]:
    try:
        yield
    except httpcore.ConnectTimeout as error:
        raise httpx.ConnectTimeout(str(error)) from error
    except httpcore.TimeoutException as error:
        raise httpx.ReadTimeout(str(error)) from error
    except httpcore.ConnectError as error:
        raise httpx.ConnectError(str(error)) from error
    except httpcore.ProtocolError as error:
        raise httpx.RemoteProtocolError(str(error)) from error
    except httpcore.NetworkError as error:
        raise httpx.ReadError(str(error)) from error


class _Body(httpx.SyncByteStream):
    def __init__(self, response: httpcore.Response) -> None:
        self._response = response

    def __iter__(self) -> Iterator[bytes]:
        with _as_httpx():
            yield from self._response.iter_stream()

    def close(self) -> None:
        self._response.close()


class DeadlineTransport(httpx.BaseTransport):
    """Sends requests over pooled connections; a request's shortest time limit is that of all of it.

    An answer must be read by the thread that asked, before it asks again.
    """

    def __init__(self, ssl_context: ssl.SSLContext) -> None:
        self._left = _Left()
        self._pool = httpcore.ConnectionPool(
            ssl_context,
            max_connections=MAX_CONNECTIONS,
            keepalive_expiry=KEEP_ALIVE,
            network_backend=_Backend(self._left),
        )

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """See `httpx.BaseTransport`."""
        self._left.ends = _ends(request)
        url = request.url
        target = httpcore.URL(
            scheme=url.raw_scheme, host=url.raw_host, port=url.port, target=url.raw_path
        )
        with _as_httpx():
            response = self._pool.handle_request(
                httpcore.Request(
                    request.method,
                    target,
                    headers=request.headers.raw,
                    content=request.stream,
                    extensions=request.extensions,
                )
            )
        return httpx.Response(response.status, headers=response.headers, stream=_Body(response))

    def close(self) -> None:
        """Close every connection."""
        self._pool.close()


def _ends(request: httpx.Request) -> float:
    limits = [limit for limit in request.extensions["timeout"].values() if limit is not None]
    return monotonic() + min(limits, default=float("inf"))


@contextmanager
def _until(ends: float, request: httpx.Request) -> Iterator[None]:
    """Cancel what is awaited within, and raise httpx's error, when the time is over."""
    try:
        with anyio.fail_after(ends - monotonic()):
            yield
    except TimeoutError:
        raise httpx.ReadTimeout("the time of the whole request is over", request=request) from None


class _AsyncBody(httpx.AsyncByteStream):
    def __init__(self, body: httpx.AsyncByteStream, ends: float, request: httpx.Request) -> None:
        self._body = body
        self._ends = ends
        self._request = request

    async def __aiter__(self) -> AsyncIterator[bytes]:
        parts = aiter(self._body)
        while True:
            with _until(self._ends, self._request):
                try:
                    part = await anext(parts)
                except StopAsyncIteration:
                    return
            yield part

    async def aclose(self) -> None:
        await self._body.aclose()


class AsyncDeadlineTransport(httpx.AsyncHTTPTransport):
    """The same of coroutines."""

    def __init__(self, ssl_context: ssl.SSLContext) -> None:
        limits = httpx.Limits(max_connections=MAX_CONNECTIONS, keepalive_expiry=KEEP_ALIVE)
        super().__init__(verify=ssl_context, limits=limits)

    async def handle_async_request(self, request: httpx.Request) -> httpx.Response:
        """See `httpx.AsyncBaseTransport`."""
        ends = _ends(request)
        with _until(ends, request):
            response = await super().handle_async_request(request)
        body = response.stream
        if isinstance(body, httpx.AsyncByteStream):
            response.stream = _AsyncBody(body, ends, request)
        return response
