"""Defective servers on real sockets."""

import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from typing import Self

READY = b'{"status":"ready"}'


class Peer:
    """A server that calls the function ``behave`` for each connection, in a thread."""

    def __init__(self, behave: Callable[[socket.socket], None]) -> None:
        self.connections = 0
        self._behave = behave
        self._socket = socket.create_server(("127.0.0.1", 0))
        self._accepted: list[socket.socket] = []
        self.url = f"http://127.0.0.1:{self._socket.getsockname()[1]}"
        self._threads = [threading.Thread(target=self._accept)]
        self._threads[0].start()

    def _accept(self) -> None:
        with suppress(OSError):
            while True:
                connection, _ = self._socket.accept()
                self.connections += 1
                self._accepted.append(connection)
                self._threads.append(threading.Thread(target=self._serve, args=(connection,)))
                self._threads[-1].start()

    def _serve(self, connection: socket.socket) -> None:
        with suppress(OSError), connection:
            self._behave(connection)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        for connection in (self._socket, *self._accepted):
            with suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
        self._socket.close()
        for thread in self._threads:
            thread.join()


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
    """Return a function that answers one request as `answer` does, and records its head."""
    heads = [] if heads is None else heads

    def behave(connection: socket.socket) -> None:
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
