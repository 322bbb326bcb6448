"""``python -m benchmarks.hostile``: a polite client, alone and beside a client that attacks.

The polite client sends 50 questions per second. The attacker has another address and sends costly,
refused or cheap requests without pauses, from a process of its own. Windows with and without an
attack alternate. The result of an attack is the p99 latency of the polite client, divided by its
p99 latency alone.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from benchmarks.load import servers
from benchmarks.load.connections import prepared
from benchmarks.load.questions import labels_of
from benchmarks.load.windows import Window, at_concurrency, at_rate, joined

RATE: Final = 50.0
_BATCH, _SCENE, _TEXT = 2 * 2**20, 256 * 2**10, 64 * 2**10  # sizes of bodies in bytes
_LIMIT: Final = 5.0
_GET: Final = b"GET %b HTTP/1.1\r\nHost: %b\r\n\r\n"


def main(
    store: Annotated[Path, typer.Option(help="the model store to serve")] = Path("model_store"),
    root: Annotated[Path, typer.Option(help="sources of the service")] = servers.ROOT,
    seconds: Annotated[float, typer.Option(min=0.1, help="seconds per window")] = 3.0,
    rounds: Annotated[int, typer.Option(min=1, help="pairs of windows per attack")] = 2,
    connections: Annotated[int, typer.Option(min=1, help="connections of the attacker")] = 4,
) -> None:
    """Print the ratio of each attack. The exit status is 1 if a ratio exceeds 5 or one is refused.

    Raises:
        ServerError: the service does not become ready.
    """
    failed = False
    with servers.service(store, root=root, pinned=False) as service:
        labels = labels_of(service.port)
        polite = [prepared("/missing", {"objects": labels[:12]})]
        for name, request in attacks(labels):
            alone, beside = [], []
            for _ in range(rounds):
                alone.append(window(service.port, polite, seconds))
                with attacker(service.port, request, connections, seconds + 2):
                    beside.append(window(service.port, polite, seconds))
            usual, attacked = joined(alone), joined(beside)
            ratio = attacked.quantile(0.99) / usual.quantile(0.99)
            failed |= ratio > _LIMIT or bool(attacked.errors)
            print(
                f"{name:30} p99 {usual.quantile(0.99) * 1e3:6.1f} ms alone, "
                f"{attacked.quantile(0.99) * 1e3:6.1f} ms beside: {ratio:.1f}, "
                f"{attacked.errors} refused",
                flush=True,
            )
    raise typer.Exit(int(failed))


def window(port: int, requests: list[bytes], seconds: float) -> Window:
    """Run a window of the polite client."""
    return asyncio.run(at_rate(port, requests, RATE, seconds, 8))


def attacks(labels: list[str]) -> Iterator[tuple[str, bytes]]:
    """Yield the name and the request of each attack."""
    bed = {"label": labels[0], "position": [1, 2, 3]}
    scene = b'{"objects":["%b"],"%%b":[' % labels[0].encode()
    related = filled(b'["a","left","b"]', _SCENE, scene % b"relations")
    empty = {
        "lists": b"[]",
        "objects": b"{}",
        "numbers": b"1",
        "nested lists": b"[" * 99 + b"]" * 99,
        "members": b"{%b}" % b",".join(b'"%d":[0]' % n for n in range(32)),
        "long numbers": b"9" * 4300,
        "escapes": b'"%b"' % (b"\\u00e9" * 1000),
    }
    for name, entry in empty.items():
        yield f"batch of {name}", sent("/missing/batch", filled(entry, _BATCH, b'{"scenes":['))
        scenes = filled(filled(entry, _SCENE, b'{"objects":['), _BATCH, b'{"scenes":[')
        yield f"scenes of {name}", sent("/missing/batch", scenes)
        yield f"scene of {name}", sent("/missing", filled(entry, _SCENE, b'{"objects":['))
        text = filled(entry, _TEXT, b'{"scenes":[')
        yield f"small batch of {name}", sent("/missing/batch", text)
    scene_of_12 = {"objects": labels[:12]}
    yield "batch of questions", prepared("/missing/batch", {"scenes": [scene_of_12] * 256})
    yield "draws", prepared("/generate", {**scene_of_12, "count": 16, "steps": 500})
    yield "unknown labels", prepared("/missing", {"objects": [f"nonsuch {k}" for k in range(256)]})
    yield "largest answer", prepared("/relations", largest(labels))
    yield "batch of relations", sent("/missing/batch", filled(related, _BATCH, b'{"scenes":['))
    yield "batch of poses", prepared("/outliers/batch", {"scenes": [{"objects": [bed] * 40}] * 256})
    yield "refused hosts", _GET % (b"/models", b"evil.example")
    yield "unknown paths", _GET % (b"/nowhere", b"127.0.0.1")
    yield "health checks", _GET % (b"/health/ready", b"127.0.0.1")
    yield "candidates", sent("/missing", filled(b'"x y z"', _SCENE // 8, scene % b"candidates"))


def largest(labels: list[str]) -> dict[str, Any]:
    """Return the body of the question with the longest answer: objects near to each other."""
    objects = [
        {
            "id": f"{place:128}".replace(" ", "\U0001f600"),
            "label": labels[place % len(labels)],
            "position": [place % 16 * 0.02, place // 16 * 0.02, 0],
            "size": [0.5, 0.5, 0.01],
        }
        for place in range(256)
    ]
    return {"objects": objects, "top_k": 4096, "include_opposites": True}


def filled(entry: bytes, size: int, head: bytes) -> bytes:
    """Return an object whose last list has so many equal entries that it has about ``size`` bytes.

    ``head`` is the text before the first entry.
    """
    return head + b",".join([entry] * ((size - len(head) - 2) // (len(entry) + 1))) + b"]}"


def sent(path: str, body: bytes) -> bytes:
    """Return the bytes of a request with a body."""
    return (
        prepared(path, None).replace(b"content-length: 4", b"content-length: %d" % len(body))[:-4]
        + body
    )


class attacker:  # noqa: N801 - a context manager
    """An attack until the end of the context, by a process of its own."""

    def __init__(self, port: int, request: bytes, connections: int, seconds: float) -> None:
        context = get_context("spawn")
        self._began = context.Event()
        arguments = self._began, port, [request], connections, seconds, "127.0.0.2"
        self._process = context.Process(target=_attack, args=arguments)

    def __enter__(self) -> None:
        self._process.start()
        self._began.wait(60)

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.join()


def _attack(began: Event, *arguments: Any) -> None:
    began.set()
    asyncio.run(at_concurrency(*arguments))


if __name__ == "__main__":
    typer.run(main)
