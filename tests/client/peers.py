"""Defective servers on real sockets."""

import socket
from collections.abc import Callable
from contextlib import suppress
from socketserver import BaseRequestHandler, ThreadingTCPServer
from typing import Any

READY = b'{"status":"ready"}'


class Peer(ThreadingTCPServer):
    """A server that calls the function ``behave`` for each connection, in a thread."""

    daemon_threads = True

    def __init__(self, behave: Callable[[socket.socket], None]) -> None:
        super().__init__(("127.0.0.1", 0), BaseRequestHandler)
        self.connections = 0
        self.url = f"http://127.0.0.1:{self.server_address[1]}"
        self._behave = behave

    def finish_request(self, request: Any, client_address: Any) -> None:
        self.connections += 1
        with suppress(OSError):
            self._behave(request)


def read_head(connection: socket.socket) -> bytes:
    head = b""
    while b"\r\n\r\n" not in head:
        if not (part := connection.recv(65536)):
            raise OSError("the client has closed the connection")
        head += part
    return head


def answering(
    *arguments: bytes, heads: list[bytes] | None = None
) -> Callable[[socket.socket], None]:
    """Return a function that answers each request as `answer` does, and records its head."""
    heads = [] if heads is None else heads

    def behave(connection: socket.socket) -> None:
        while True:
            heads.append(read_head(connection))
            answer(connection, *arguments)

    return behave


def say_nothing(connection: socket.socket) -> None:
    """Read a request, and wait until the client closes the connection."""
    read_head(connection)
    connection.recv(1)


def answer(
    connection: socket.socket,
    body: bytes = READY,
    status: bytes = b"200 OK",
    retry_after: bytes = b"0",
) -> None:
    head = b"HTTP/1.1 %s\r\nContent-Type: application/json\r\nContent-Length: %d\r\n"
    connection.sendall(head % (status, len(body)) + b"Retry-After: %s\r\n\r\n" % retry_after + body)
