"""An S3 server on this machine (moto), and buckets in it."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from threading import Lock, Thread
from typing import Any

import httpx
import obstore
import pytest
from moto.server import DomainDispatcherApplication, MotoRequestHandler, create_backend_app
from obstore.store import from_url
from werkzeug.serving import BaseWSGIServer, make_server

CREDENTIALS = {
    "AWS_ACCESS_KEY_ID": "testing",
    "AWS_SECRET_ACCESS_KEY": "testing",
    "AWS_REGION": "us-east-1",
    "AWS_ALLOW_HTTP": "true",
}


@dataclass
class ObjectStorage:
    """An S3 server that can stop and start again with its objects.

    `get`, `put` and `delete` need the environment of `use`.

    Attributes:
        port: port of the server on 127.0.0.1.
    """

    port: int
    _running: tuple[BaseWSGIServer, Thread] | None = None

    def start(self) -> None:
        storage = DomainDispatcherApplication(create_backend_app)
        lock = Lock()

        def one_at_a_time(environ: Any, start_response: Any) -> Any:
            # moto checks the condition of a conditional put and writes the object in two steps.
            with lock:
                return storage(environ, start_response)

        server = make_server(
            *("127.0.0.1", self.port, one_at_a_time),
            threaded=True,
            request_handler=MotoRequestHandler,
        )
        thread = Thread(target=server.serve_forever, daemon=True)
        thread.start()
        self._running = server, thread

    def stop(self) -> None:
        if self._running is not None:
            server, thread = self._running
            server.shutdown()
            thread.join()
            server.server_close()
            self._running = None

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"

    def environment(self) -> dict[str, str]:
        """The environment variables of a client of this server."""
        return {**CREDENTIALS, "AWS_ENDPOINT_URL": self.address}

    def create_bucket(self, name: str) -> str:
        """Create a bucket, and return the URL of a store in it."""
        httpx.put(f"{self.address}/{name}").raise_for_status()
        return f"s3://{name}/models"

    def get(self, store: str, path: str) -> bytes:
        return bytes(obstore.get(from_url(store), path).bytes())

    def put(self, store: str, path: str, data: bytes) -> None:
        obstore.put(from_url(store), path, data)

    def delete(self, store: str, path: str) -> None:
        obstore.delete(from_url(store), path)


@contextmanager
def running() -> Iterator[ObjectStorage]:
    """An S3 server on a free port."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    storage = ObjectStorage(port)
    storage.start()
    try:
        yield storage
    finally:
        storage.stop()


def use(storage: ObjectStorage, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the clients of this process use the server."""
    for name, value in storage.environment().items():
        monkeypatch.setenv(name, value)
