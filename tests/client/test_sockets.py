"""The clients on real sockets: shared connections and deadlines."""

import socket
import ssl
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from scene_client import (
    AnswerError,
    AsyncClient,
    Client,
    DeadlineError,
    UnreachableError,
    asynchronous,
    sync,
)
from tests.client.conftest import OVER_HTTP
from tests.client.peers import answering, read_head, say_nothing


def drip(connection: socket.socket) -> None:
    """Send a byte of the body every 20 ms, without end: no single wait is long."""
    read_head(connection)
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 1000000\r\n\r\n")
    while True:
        connection.sendall(b" ")
        time.sleep(0.02)


def drip_head(connection: socket.socket) -> None:
    read_head(connection)
    connection.sendall(b"HTTP/1.1 200 OK\r\n")
    for number in range(10**6):
        connection.sendall(b"X-%d: y\r\n" % number)
        time.sleep(0.02)


def flood(connection: socket.socket) -> None:
    """Send as fast as the client reads: the client never waits."""
    read_head(connection)
    connection.sendall(b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n")
    while True:
        connection.sendall(b"400\r\n" + b" " * 1024 + b"\r\n")


def break_off(connection: socket.socket) -> None:
    read_head(connection)
    connection.sendall(b"HTTP/1.1 200 OK\r\nContent-Length: 100\r\n\r\n{")


every_client = pytest.mark.parametrize("open_caller", OVER_HTTP, indirect=True)


@every_client
def test_many_calls_share_one_connection(peer: Any, open_caller: Any) -> None:
    started = peer(answering())
    with open_caller(started.url) as call:
        for _ in range(20):
            assert call("is_ready") is True
    assert started.connections == 1


@every_client
@pytest.mark.parametrize("behave", [drip, drip_head, say_nothing, flood])
def test_a_call_ends_at_the_deadline(peer, open_caller, behave, monkeypatch):
    monkeypatch.setattr(sync, "MAX_ANSWER", 2**50)
    monkeypatch.setattr(asynchronous, "MAX_ANSWER", 2**50)
    # The test measures no time: a wait beyond the deadline would never end.
    started = peer(behave)
    with open_caller(started.url, timeout=0.2) as call:
        for _ in range(2):
            with pytest.raises(DeadlineError):
                call("models")
        assert call("is_ready") is False


@every_client
def test_a_broken_connection_is_unreachable(peer: Any, open_caller: Any) -> None:
    started = peer(break_off)
    with open_caller(started.url, retries=2) as call, pytest.raises(UnreachableError):
        call("models")
    assert started.connections == 3


@every_client
def test_a_refused_connection_is_unreachable(open_caller: Any) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    with open_caller(f"http://127.0.0.1:{port}", retries=1) as call:
        assert call("is_ready") is False
        with pytest.raises(UnreachableError, match=f"http://127.0.0.1:{port}: "):
            call("models")


@every_client
def test_the_key_and_the_time_left_are_sent(peer: Any, open_caller: Any) -> None:
    heads: list[bytes] = []
    url = peer(answering(heads=heads)).url + "/robot/"
    with open_caller(url, api_key="k" * 16, timeout=60.0) as call:
        call("is_ready")
    (head,) = heads
    assert head.startswith(b"GET /robot/health/ready HTTP/1.1\r\n")
    lines = dict(line.lower().split(b": ", 1) for line in head.split(b"\r\n")[1:] if line)
    assert lines[b"x-api-key"] == b"k" * 16
    assert 0 < int(lines[b"x-request-timeout-ms"]) <= 60_000
    # A compressed answer could decompress to any size.
    assert lines[b"accept-encoding"] == b"identity"


@pytest.mark.system
@every_client
def test_tls(peer, open_caller, tmp_path, monkeypatch, find_tool):
    key, certificate = tmp_path / "key.pem", tmp_path / "certificate.pem"
    command = [
        *(find_tool("openssl"), "req", "-x509", "-newkey", "ec"),
        *("-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "2"),
        *("-subj", "/CN=robot", "-addext", "subjectAltName=IP:127.0.0.1"),
        *("-keyout", key, "-out", certificate),
    ]
    subprocess.run(command, check=True, capture_output=True)
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(certificate, key)

    def secured(behave: Callable[[socket.socket], None]) -> str:
        def behave_secured(connection: socket.socket) -> None:
            with context.wrap_socket(connection, server_side=True) as stream:
                behave(stream)

        return str(peer(behave_secured).url.replace("http:", "https:"))

    with open_caller(secured(answering()), retries=0) as call, pytest.raises(UnreachableError):
        call("models")
    monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
    with open_caller(secured(answering())) as call:
        assert call("is_ready") is True
        assert call("is_ready") is True
    with open_caller(secured(drip), timeout=0.5) as call, pytest.raises(DeadlineError):
        call("models")


async def test_an_endless_answer_is_an_error(peer: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sync, "MAX_ANSWER", 1000)
    monkeypatch.setattr(asynchronous, "MAX_ANSWER", 1000)
    started = peer(answering(b" " * 2000))
    with Client(started.url) as scene, pytest.raises(AnswerError, match="more than"):
        scene.models()
    async with AsyncClient(started.url) as scene_async:
        with pytest.raises(AnswerError, match="more than"):
            await scene_async.models()


@pytest.mark.system
@pytest.mark.parametrize("key", ["secret-key\n", "sécret-key"])
def test_the_cpp_client_refuses_invalid_keys(bridge: Path, key: str) -> None:
    command = [bridge, "http://127.0.0.1:1", "1", "0", key]
    done = subprocess.run(command, capture_output=True, text=True)
    assert "InvalidRequestError" in done.stderr
    assert "the API key must be ASCII, without spaces or line breaks" in done.stderr
    assert "cret" not in done.stderr
