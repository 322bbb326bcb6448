"""The service in process and as a process of its own, over stores of small random machines.

The fixtures are those of every test: `live` is one process for all tests that leave it as it is.
"""

from __future__ import annotations

import gc
import os
import socket
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from typing import Any

import httpx
import pytest

ADMIN_KEY = "correct-horse-battery-staple"
CONTROL = {"objects": ["bed", "lamp", {"id": "desk_1", "label": "desk"}], "seed": 11}
NAMED = {"allowed_hosts": ["service"]}
"""Settings of a service in process, which its clients call http://service."""

Replace = Callable[[str, Callable[..., Any]], None]

DEFECTIVE = """
import sys
from app import questions
from app.__main__ import main

missing = questions.missing

def fail(artifact, scene, **parameters):
    # In no other scene, or the models would be refused when they are warmed up.
    if scene.room_type is None:
        return missing(artifact, scene, **parameters)
    raise ZeroDivisionError({message!r})

questions.missing = fail
sys.exit(main())
"""
"""A program for `launch`: a service that cannot say what is missing in a room of a known type."""


@asynccontextmanager
async def serve(store: Path, **settings: Any) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the application over a store, inside its lifespan."""
    # Here, so that tests without a service do not wait for the import.
    from app.main import create_app
    from app.settings import Settings

    app = create_app(Settings(store=store, **{"admin_key": ADMIN_KEY, **NAMED, **settings}))
    # As `python -m app` does: the runtime enables it when it has started.
    gc.disable()
    transport = httpx.ASGITransport(app, raise_app_exceptions=False)
    async with (
        app.router.lifespan_context(app),
        httpx.AsyncClient(transport=transport, base_url="http://service") as client,
    ):
        client.app = app  # type: ignore[attr-defined]
        yield client


@pytest.fixture(scope="session")
def shared_store(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store that no test changes."""
    from tests.http.stores import make_store

    return make_store(tmp_path_factory.mktemp("store"))


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store of the test's own."""
    from tests.http.stores import make_store

    return make_store(tmp_path / "store")


@pytest.fixture(scope="session")
async def client(shared_store: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the service in process."""
    async with serve(shared_store) as client:
        yield client


@pytest.fixture
def admin() -> dict[str, str]:
    """The headers of an administrator."""
    return {"X-Admin-Key": ADMIN_KEY}


@pytest.fixture
def replace(monkeypatch: pytest.MonkeyPatch) -> Replace:
    """Put a function in place of one of the four questions; the question is its first argument."""
    from app import questions

    def replace(name: str, function: Callable[..., Any]) -> None:
        question = getattr(questions, name)

        @wraps(question)
        def replaced(*args: Any, **parameters: Any) -> Any:
            return function(question, *args, **parameters)

        monkeypatch.setattr(questions, name, replaced)

    return replace


def defect(*_: Any, **__: Any) -> Any:
    """In place of a question."""
    raise ZeroDivisionError("secret detail")


@dataclass
class LiveService:
    """A running ``python -m app``, which ends with its ``with`` block."""

    process: subprocess.Popen[str]
    client: httpx.Client
    port: int
    log: Path

    @property
    def url(self) -> str:
        """Where it listens."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def memory(self) -> int:
        """Resident bytes."""
        for line in Path(f"/proc/{self.process.pid}/status").read_text("ascii").splitlines():
            if line.startswith("VmRSS:"):
                return int(line.split()[1]) * 1024
        raise ProcessLookupError(self.process.pid)

    @property
    def descriptors(self) -> int:
        """Open files and sockets."""
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))

    def control(self) -> dict[str, bytes]:
        """The answers to one question of each kind, which never change."""
        answers = {}
        for question in ("relations", "missing", "outliers", "generate"):
            body = CONTROL | ({"steps": 8} if question == "generate" else {})
            headers = {"X-Request-Id": "control"}
            response = self.client.post(f"/{question}", json=body, headers=headers)
            assert response.status_code == 200, response.text
            answers[question] = response.content
        assert self.client.get("/health/ready").status_code == 200
        return answers

    def stop(self) -> str:
        """End it as an orchestrator does; its whole log."""
        self.client.close()
        self.process.terminate()
        try:
            self.process.wait(timeout=30)
        finally:
            self.process.kill()
        return self.log.read_text()

    def __enter__(self) -> LiveService:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def begin(
    store: Path, log: Path, *, program: tuple[str, ...] = ("-m", "app"), **variables: str
) -> subprocess.Popen[str]:
    """Start ``python -m app`` (or another program) and do not wait for it."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("SCENE_")
    }
    environment |= {"SCENE_STORE": str(store), "SCENE_ADMIN_KEY": ADMIN_KEY, **variables}
    with log.open("w") as stream:
        return subprocess.Popen(
            [sys.executable, *program], env=environment, stderr=stream, text=True
        )


def launch(
    store: Path,
    log: Path,
    *,
    program: tuple[str, ...] = ("-m", "app"),
    port: int | None = None,
    **variables: str,
) -> LiveService:
    """Start ``python -m app`` (or another program) and wait until it answers.

    The port is a free one unless it is given.
    """
    if port is None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
    process = begin(store, log, program=program, **{"SCENE_PORT": str(port), **variables})
    client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=30)
    deadline = time.monotonic() + 60
    while time.monotonic() < deadline:
        try:
            client.get("/health/live")
        except httpx.ConnectError:
            if process.poll() is not None:
                break
            time.sleep(0.02)
        else:
            return LiveService(process, client, port, log)
    process.kill()
    raise AssertionError(f"the service did not start:\n{log.read_text()}")


@pytest.fixture(scope="session")
def live(shared_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """The service as a process of its own."""
    with launch(shared_store, tmp_path_factory.mktemp("live") / "log") as service:
        yield service


@pytest.fixture(scope="session")
def shipped(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """The same with the shipped models."""
    log = tmp_path_factory.mktemp("shipped") / "log"
    with launch(repository / "model_store", log) as service:
        yield service
