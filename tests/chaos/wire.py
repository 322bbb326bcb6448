"""HTTP as bytes: requests that no client library would write, and how the answers are read. The
expected statuses are those of the proxy in front of the service."""

import socket
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Final

from tests.services import PATIENCE

BODY: Final = b'{"objects": ["bed", "lamp"]}'


@dataclass(frozen=True)
class Wire:
    """Bytes to send on one connection.

    Attributes:
        parts: sent one after another.
        expected: the statuses of the answers, in order. None: any below 500, or none at all.
        closes: whether the service must close the connection then.
    """

    name: str
    parts: Sequence[bytes]
    expected: tuple[int, ...] | None
    closes: bool = False


@dataclass(frozen=True)
class Answer:
    status: int
    headers: dict[str, str]
    body: bytes


def exchange(port: int, wire: Wire, patience: float = PATIENCE) -> tuple[list[Answer], bool]:
    """Send, and read until as many answers came as are expected, or the connection is closed.

    Returns:
        The answers, and whether the service closed the connection.
    """
    with socket.create_connection(("127.0.0.1", port), timeout=patience) as connection:
        received = bytearray()
        try:
            for part in wire.parts:
                connection.sendall(part)
        except OSError:
            pass  # refused half-way: what was answered is still there
        answers: list[Answer] = []
        enough = None if wire.closes or wire.expected is None else len(wire.expected)
        while enough is None or len(answers) < enough:
            try:
                chunk = connection.recv(65536)
            except TimeoutError:
                return answers, False
            except OSError:
                return answers, True
            if not chunk:
                return answers, True
            received += chunk
            answers += _answers(received)
        return answers, False


def _answers(received: bytearray) -> Iterator[Answer]:
    """Take whole answers from the front; answers without a body have a length of none."""
    while (end := received.find(b"\r\n\r\n")) >= 0:
        status_line, *lines = received[:end].decode("latin-1").split("\r\n")
        status = int(status_line.split()[1])
        headers = {
            name.lower(): value.strip()
            for name, _, value in (line.partition(":") for line in lines)
        }
        length = 0 if status == 100 else int(headers.get("content-length", 0))
        if len(received) < end + 4 + length:
            return
        body = bytes(received[end + 4 : end + 4 + length])
        del received[: end + 4 + length]
        if status != 100:
            yield Answer(status, headers, body)


def _post(
    *fields: bytes, body: bytes = BODY, length: bool = True, version: bytes = b"1.1"
) -> bytes:
    head = [
        b"POST /outliers HTTP/" + version,
        b"Host: localhost",
        b"Content-Type: application/json",
    ]
    head += fields
    if length:
        head.append(b"Content-Length: %d" % len(body))
    return b"\r\n".join(head) + b"\r\n\r\n" + body


def _chunked(*chunks: bytes, fields: Sequence[bytes] = ()) -> bytes:
    body = b"".join(b"%x\r\n%s\r\n" % (len(chunk), chunk) for chunk in chunks) + b"0\r\n\r\n"
    return _post(b"Transfer-Encoding: chunked", *fields, body=body, length=False)


LIVE: Final = b"GET /health/live HTTP/1.1\r\nHost: localhost\r\n\r\n"
_SMUGGLED: Final = b"GET /health/live HTTP/1.1\r\nHost: localhost\r\nX-Request-Id: smuggled\r\n\r\n"


def wires() -> Iterator[Wire]:
    """Everything that can be wrong below a request's body."""
    yield from framing()
    yield from _smuggling()
    yield from _heads()
    yield from _orders()


def framing() -> Iterator[Wire]:
    """Bodies of every form, right and wrong."""
    chunks = [BODY[k : k + 3] for k in range(0, len(BODY), 3)]
    head = b"POST /outliers HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    yield Wire("plain", [_post()], (200,))
    yield Wire("byte by byte", [bytes([byte]) for byte in _post()], (200,))
    yield Wire("chunked", [_chunked(*chunks)], (200,))
    yield Wire("chunked in pieces", [bytes([byte]) for byte in _chunked(*chunks)], (200,))
    yield Wire("chunks of one byte", [_chunked(*(bytes([byte]) for byte in BODY))], (200,))
    yield Wire("chunked, HTTP/1.0", [_chunked(BODY).replace(b"/1.1", b"/1.0")], None, closes=True)
    yield Wire("HTTP/1.0", [_post(version=b"1.0")], (200,), closes=True)
    yield Wire("close", [_post(b"Connection: close")], (200,), closes=True)
    yield Wire("chunked, too large", [_chunked(*[b" " * 65536] * 33)], (413,))
    yield Wire("chunked, empty", [_chunked()], (400,))
    yield Wire("expect", [_post(b"Expect: 100-continue")], (200,))
    yield Wire("expect the unexpected", [_post(b"Expect: 200-nothing")], (200,))
    yield Wire("extensions", [_chunked(BODY).replace(b"\r\n{", b";a=b;c=d\r\n{")], (200,))
    yield Wire("trailers", [_chunked(BODY)[:-2] + b"X-Request-Id: late\r\n\r\n"], (200,))
    for name, tail in {
        "no hexadecimal": b"zz\r\n",
        "negative": b"-1\r\n",
        "huge": b"f" * 40 + b"\r\n",
        "no end": b"5\r\nabcdeXX",
        "spaces": b"5 \x00\r\nabcde\r\n",
        "prefix": b"0x5\r\nabcde\r\n",
        "no digits": b"\r\n",
    }.items():
        text = head + b"Transfer-Encoding: chunked\r\n\r\n" + tail
        yield Wire(f"chunk of {name}", [text], (400,), closes=True)
        yield Wire(f"chunk of {name}, late", [text[: -len(tail)], tail], (400,), closes=True)
    for value in (
        b"-1", b"+28", b"0x1c", b"1e3", b"28, 28", b"28 28", b"", b"\xd9\xa1", b"9" * 40, b"28.0",
        b"18446744073709551616", b"18446744073709551644", b"\x0028",
    ):  # fmt: skip
        text = head + b"Content-Length: " + value + b"\r\n\r\n" + BODY
        yield Wire(f"length {value[:24]!r}", [text], None, closes=bool(value))
    for size in (2 * 2**20 + 1, 2**31, 2**32, 2**63 - 1):
        yield Wire(f"length {size}", [head + b"Content-Length: %d\r\n\r\n" % size], (413,))


def _smuggling() -> Iterator[Wire]:
    """Requests that two readers might cut in two places: refused, and nothing behind is read."""
    body = b"0\r\n\r\n" + _SMUGGLED
    length = b"Content-Length: %d" % len(body)
    for name, fields in {
        "length, then chunked": [length, b"Transfer-Encoding: chunked"],
        "chunked, then length": [b"Transfer-Encoding: chunked", length],
        "two lengths": [length, b"Content-Length: 5"],
        "the same length twice": [length, length],
        "lengths in a list": [b"Content-Length: 5, %d" % len(body)],
        "chunked, unknown": [b"Transfer-Encoding: xchunked", length],
        "chunked, quoted": [b'Transfer-Encoding: "chunked"', length],
        "chunked, not last": [b"Transfer-Encoding: chunked, identity", length],
        "chunked twice": [b"Transfer-Encoding: chunked, chunked", length],
        "chunked, two fields": [b"Transfer-Encoding: chunked", b"Transfer-Encoding: x", length],
        "chunked after a tab": [b"Transfer-Encoding:\tchunked", length],
        "space before the colon": [b"Transfer-Encoding : chunked", length],
        "space before the name": [b" Transfer-Encoding: chunked", length],
        "null in the name": [b"Transfer\x00-Encoding: chunked", length],
        "line feed in a value": [b"X: a\nTransfer-Encoding: chunked", length],
        "carriage return in a value": [b"X: a\rTransfer-Encoding: chunked", length],
        "folded": [b"X: a\r\n b", length],
        "upgrade with a body": [b"Connection: upgrade", b"Upgrade: h2c", length],
        "WebSocket with a body": [b"Connection: upgrade", b"Upgrade: websocket", length],
    }.items():
        text = _post(*fields, body=body, length=False)
        yield Wire(f"smuggled: {name}", [text], (400,), closes=True)


def _heads() -> Iterator[Wire]:
    yield Wire("no host", [LIVE.replace(b"Host: localhost\r\n", b"")], (400,))
    yield Wire(
        "two hosts", [LIVE.replace(b"Host: localhost", b"Host: localhost\r\nHost: y")], (400,)
    )
    yield Wire("absolute form", [LIVE.replace(b"GET /", b"GET http://elsewhere/")], (400,))
    upgrade = (
        b"Host: localhost\r\nConnection: upgrade\r\nUpgrade: websocket\r\nSec-WebSocket-Version: 13"
    )
    yield Wire("WebSocket without a key", [LIVE.replace(b"Host: localhost", upgrade)], (400,))
    for name, text in {
        "TLS": b"\x16\x03\x01\x02\x00\x01\x00\x01\xfc\x03\x03" + b"\x07" * 500,
        "connect": b"CONNECT elsewhere:443 HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "space in the path": b"GET /a b HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "no colon": LIVE.replace(b"Host: localhost", b"Host localhost"),
        "control in a value": LIVE.replace(b"Host: localhost", b"Host: localhost\r\nA: \x01\x02"),
        "long path": b"GET /" + b"a" * 20_000 + b" HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "long value": LIVE.replace(b"Host: localhost", b"Host: localhost\r\nA: " + b"a" * 20_000),
        "many fields": LIVE[:-2] + b"A: b\r\n" * 3_000 + b"\r\n",
    }.items():
        yield Wire(f"head: {name}", [text], (400,), closes=True)
    yield Wire("HTTP/2", [b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"], None, closes=True)
    yield Wire("line feeds alone", [LIVE.replace(b"\r", b"")], (200,))
    # Closing with bytes unread resets the connection, which may overtake the answer.
    yield Wire(
        "head without end", [b"GET / HTTP/1.1\r\n"] + [b"A: b\r\n" * 10_000] * 50, None, True
    )
    yield Wire("value without end", [b"GET / HTTP/1.1\r\nA: "] + [b"a" * 60_000] * 50, None, True)
    trailers = _chunked(BODY)[:-2]
    yield Wire("trailers without end", [trailers] + [b"A: b\r\n" * 10_000] * 50, None, True)


def _orders() -> Iterator[Wire]:
    """Many requests at once: answered in order, whatever comes behind them."""
    yield Wire("two at once", [_post() + LIVE], (200, 200))
    yield Wire("sixty at once", [LIVE * 60], (200,) * 60)
    yield Wire("mixed", [_post() + _post(body=b"{") + LIVE + _post()], (200, 400, 200, 200))
    yield Wire("noise behind", [_post() + b"\x00noise\r\n\r\n"], (200, 400), closes=True)
    yield Wire("noise behind two", [LIVE + _post() + b"\x00\r\n\r\n"], (200, 200, 400), closes=True)
    yield Wire("far too many at once", [LIVE * 6_000], None, closes=True)
    yield Wire("close, then more", [_post(b"Connection: close") + LIVE], (200,), closes=True)
