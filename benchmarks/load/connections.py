"""Fast HTTP/1.1 client connections. They send prepared requests and parse only status and body."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from typing import Any, cast

_END_OF_HEAD = b"\r\n\r\n"
_LENGTH = b"content-length:"


def prepared(path: str, body: Any, headers: dict[str, str] | None = None) -> bytes:
    """Return the bytes of a POST request with a JSON body."""
    content = json.dumps(body, separators=(",", ":")).encode()
    lines = [
        f"POST {path} HTTP/1.1",
        "host: 127.0.0.1",
        "content-type: application/json",
        f"content-length: {len(content)}",
        *(f"{name}: {value}" for name, value in (headers or {}).items()),
    ]
    return "\r\n".join(lines).encode() + _END_OF_HEAD + content


class Connection(asyncio.Protocol):
    """A connection with at most one pending request.

    Attributes:
        on_answer: function that is called after each complete answer, with the connection, the
            status and the body. Status 0 means that the connection broke.
        busy: True while a request is pending.
    """

    def __init__(self, on_answer: Callable[[Connection, int, bytes], None]) -> None:
        self.on_answer = on_answer
        self.busy = False
        self._transport: asyncio.Transport | None = None
        self._received = b""

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        # A cast is necessary: the transports of uvloop are not subclasses of asyncio.Transport.
        self._transport = cast("asyncio.Transport", transport)

    def send(self, request: bytes) -> None:
        """Send a request; `on_answer` receives the answer."""
        assert self._transport is not None
        self.busy = True
        self._transport.write(request)

    def data_received(self, data: bytes) -> None:
        self._received += data
        head = self._received.find(_END_OF_HEAD)
        if head < 0:
            return
        start = self._received.lower().find(_LENGTH, 0, head)
        end = head + len(_END_OF_HEAD)
        if start >= 0:
            value = self._received[start + len(_LENGTH) : head].split(b"\r\n", 1)[0]
            end += int(value)
        if len(self._received) < end:
            return
        status, body = int(self._received[9:12]), self._received[head + len(_END_OF_HEAD) : end]
        self._received = self._received[end:]
        self.busy = False
        self.on_answer(self, status, body)

    def connection_lost(self, _: Exception | None) -> None:
        if self.busy:
            self.busy = False
            self.on_answer(self, 0, b"")

    def close(self) -> None:
        """Close the connection. The answer to a pending request is lost."""
        self.busy = False
        if self._transport is not None:
            self._transport.close()


async def connect(
    port: int,
    count: int,
    on_answer: Callable[[Connection, int, bytes], None],
    address: str = "127.0.0.1",
) -> list[Connection]:
    """Open ``count`` connections to a port on this machine, from one of its loopback addresses.

    Raises:
        OSError: the connection was refused.
    """
    loop = asyncio.get_running_loop()
    made = []
    for _ in range(count):
        _, connection = await loop.create_connection(
            lambda: Connection(on_answer), "127.0.0.1", port, local_addr=(address, 0)
        )
        made.append(connection)
    return made
