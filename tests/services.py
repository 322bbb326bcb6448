"""Fixtures for every test: the service in process or as a separate process.

The stores hold small machines with random weights. All tests share the process of `live`, so they
must not change its state.
"""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field
from functools import partial
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from socketserver import BaseServer
from typing import Any, TypeVar

import httpx
import pytest

from benchmarks.load.servers import free_port

PATIENCE = 120.0
"""Seconds after which a wait is a hang. A busy machine needs many, and no test measures them."""
DEADLINE_MS = 60_000
"""The deadline of a request, unless deadlines are the subject of a test."""
CONTROL = {"objects": ["bed", "lamp", {"id": "desk_1", "label": "desk"}], "seed": 11}
NAMED = {"allowed_hosts": ["service"]}
"""Settings of a service in process; its clients use the URL http://service."""

Server = TypeVar("Server", bound=BaseServer)
Replace = Callable[[str, Callable[..., Any]], None]

WITHOUT_TRAINING = """
import runpy, sys
for name in ("torch", "training", "opentelemetry.sdk"):
    sys.modules[name] = None  # importing them fails
runpy.run_module("app", run_name="__main__")
"""
"""A program for `launch`: the service as it is installed for serving."""

DEFECTIVE = """
import sys
from app.__main__ import main
from app.questions.missing import MISSING

def fail(*args, **options):
    raise ZeroDivisionError({message!r})

MISSING.answer = fail
sys.exit(main())
"""
"""A program for `launch`: its question `missing` fails for every scene."""


@asynccontextmanager
async def serve(store: Path, **settings: Any) -> AsyncIterator[httpx.AsyncClient]:
    """Start the application on a store, and yield a client."""
    # Imported here, so that tests without a service do not wait for the import.
    from app.main import create_app
    from app.settings import Settings

    if "max_request_timeout_ms" not in settings:
        settings = {"request_timeout_ms": DEADLINE_MS, **settings}
    app = create_app(Settings(store=store, **{**NAMED, **settings}))
    app.state.runtime.metrics.max_age = 0.0
    # `python -m app` also disables the collector; the runtime enables it after the start.
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
    """A store that all tests share and must not change."""
    from tests.http.stores import make_store

    return make_store(tmp_path_factory.mktemp("store"))


@pytest.fixture
def store(tmp_path: Path) -> Path:
    """A store for one test, which may change it."""
    from tests.http.stores import make_store

    return make_store(tmp_path / "store")


@pytest.fixture(scope="session")
async def client(shared_store: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
    """A client of the service in process."""
    async with serve(shared_store) as client:
        yield client


@pytest.fixture
async def own(store: Path) -> AsyncIterator[httpx.AsyncClient]:
    """A client of a service with the store of this test, which loads changes on demand."""
    async with serve(store, store_poll=0) as client:
        yield client


async def load_changes(client: httpx.AsyncClient) -> None:
    """Make a service in process load the changes in its store."""
    await client.app.state.runtime.check_store()  # type: ignore[attr-defined]


@pytest.fixture
def replace(monkeypatch: pytest.MonkeyPatch) -> Replace:
    """Replace the function of a question, for requests and for the warm-up.

    The new function gets the original function as its first argument.
    """
    from app.questions import QUESTIONS

    questions = {question.name: question for question in QUESTIONS}

    def replace(name: str, function: Callable[..., Any]) -> None:
        replaced = partial(function, questions[name].answer)
        monkeypatch.setattr(questions[name], "answer", replaced)
        monkeypatch.setattr(sys.modules[f"app.questions.{name}"], name, replaced)

    return replace


@dataclass(frozen=True)
class Paused:
    """A question that waits in its worker thread for the event `release`."""

    started: threading.Event = field(default_factory=threading.Event)
    release: threading.Event = field(default_factory=threading.Event)


Pause = Callable[..., Paused]


@pytest.fixture
def pause(replace: Replace) -> Iterator[Pause]:
    """Pause a question from the call on, of all models or of some."""
    paused = Paused()

    def pause(name: str, of: Callable[[Any], bool] = lambda model: True) -> Paused:
        def wait(question: Any, model: Any, *args: Any, **parameters: Any) -> Any:
            if of(model):
                paused.started.set()
                assert paused.release.wait(PATIENCE)
            return question(model, *args, **parameters)

        replace(name, wait)
        return paused

    yield pause
    paused.release.set()


def defect(*_: Any, **__: Any) -> Any:
    """A replacement for a question that raises an error."""
    raise ZeroDivisionError("secret detail")


@dataclass
class LiveService:
    """A running ``python -m app``, which stops at the end of its ``with`` block."""

    process: subprocess.Popen[str]
    client: httpx.Client
    port: int
    log: Path

    @property
    def url(self) -> str:
        """Base URL of the service."""
        return f"http://127.0.0.1:{self.port}"

    @property
    def memory(self) -> int:
        """Resident memory in bytes."""
        pages = Path(f"/proc/{self.process.pid}/statm").read_text("ascii").split()[1]
        return int(pages) * os.sysconf("SC_PAGE_SIZE")

    @property
    def descriptors(self) -> int:
        """Number of open files and sockets."""
        return len(list(Path(f"/proc/{self.process.pid}/fd").iterdir()))

    def control(self) -> dict[str, bytes]:
        """Ask one fixed question of each kind. The answers never change."""
        answers = {}
        for question in ("relations", "missing", "outliers", "rooms", "generate"):
            body = CONTROL | ({"steps": 8} if question == "generate" else {})
            headers = {"X-Request-Id": "control", "X-Request-Timeout-Ms": "30000"}
            response = self.client.post(f"/{question}", json=body, headers=headers)
            assert response.status_code == 200, response.text
            answers[question] = response.content
        assert self.client.get("/health/ready").status_code == 200
        return answers

    def stop(self) -> str:
        """Stop the service with SIGTERM, as an orchestrator does, and return its log."""
        self.client.close()
        self.process.terminate()
        try:
            self.process.wait(timeout=PATIENCE)
        finally:
            self.process.kill()
        return self.log.read_text()

    def __enter__(self) -> LiveService:
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()


def begin(
    store: Path,
    log: Path,
    *,
    program: tuple[str, ...] = ("-m", "app"),
    stdin: int | None = None,
    **variables: str,
) -> subprocess.Popen[str]:
    """Start ``python -m app`` (or another program) without waiting for it."""
    environment = {
        name: value for name, value in os.environ.items() if not name.startswith("SCENE_")
    }
    # Without a load balancer, nothing has to notice the end.
    environment |= {"SCENE_STORE": str(store), "SCENE_DRAIN_SECONDS": "0"}
    environment |= {"SCENE_REQUEST_TIMEOUT_MS": str(DEADLINE_MS), "SCENE_CLIENT_TIMEOUT": "120"}
    environment |= variables
    with log.open("w") as stream:
        return subprocess.Popen(
            [sys.executable, *program], env=environment, stdin=stdin, stderr=stream, text=True
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

    By default it listens on a free port.
    """
    port = port or free_port()
    process = begin(store, log, program=program, **{"SCENE_PORT": str(port), **variables})
    client = httpx.Client(base_url=f"http://127.0.0.1:{port}", timeout=PATIENCE)
    deadline = time.monotonic() + PATIENCE
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


@contextmanager
def in_thread(server: Server) -> Iterator[Server]:
    """Run a server of the standard library in a thread."""
    thread = threading.Thread(target=server.serve_forever, args=(0.01,))
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


@contextmanager
def http_server(handler: type[BaseHTTPRequestHandler], **options: Any) -> Iterator[str]:
    """Run a server without a log, and yield its URL."""
    quiet = type("Quiet", (handler,), {"log_message": lambda *_: None})
    with in_thread(ThreadingHTTPServer(("127.0.0.1", 0), partial(quiet, **options))) as server:
        yield f"http://127.0.0.1:{server.server_port}"


def is_ready(port: int) -> bool:
    """Whether a service, or one behind a proxy, is ready."""
    with suppress(httpx.TransportError):
        url = f"http://127.0.0.1:{port}/health/ready"
        return httpx.get(url, timeout=PATIENCE).status_code == 200
    return False


def wait_until(
    condition: Callable[[], object], log: Path | None = None, *, seconds: float = PATIENCE
) -> None:
    """Wait until the condition holds. Fail with the log if this takes too long."""
    deadline = time.monotonic() + seconds
    while not condition():
        if time.monotonic() > deadline:
            pytest.fail("it takes too long" + (f":\n{log.read_text()}" if log else ""))
        time.sleep(0.01)


@pytest.fixture(scope="session")
def live(shared_store: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """The service as a separate process without torch and training, shared by all tests."""
    log, program = tmp_path_factory.mktemp("live") / "log", ("-c", WITHOUT_TRAINING)
    with launch(shared_store, log, program=program) as service:
        yield service


@pytest.fixture(scope="session")
def url(live: LiveService) -> str:
    """The URL of the shared service."""
    return live.url


@pytest.fixture(scope="session")
def shipped(repository: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """The service as a separate process with the shipped models, shared by all tests."""
    log = tmp_path_factory.mktemp("shipped") / "log"
    with launch(repository / "model_store", log) as service:
        yield service


def live_service(*, logs_errors: bool = False, **variables: str) -> Any:
    """Return a fixture of one module: a service as a separate process, with a store of its own.

    Unless `logs_errors`, a traceback in its log fails the module.
    """

    @pytest.fixture(scope="module")
    def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
        from tests.http.stores import make_store

        folder = tmp_path_factory.mktemp("service")
        with launch(make_store(folder / "store"), folder / "log", **variables) as service:
            yield service
            assert logs_errors or "Traceback" not in service.log.read_text()

    return service


def client_of_service(**settings: Any) -> Any:
    """Return a fixture of one module: a client of a service in process with these settings."""

    @pytest.fixture(scope="module")
    async def client(shared_store: Path, anyio_backend: str) -> AsyncIterator[httpx.AsyncClient]:
        async with serve(shared_store, **settings) as client:
            yield client

    return client
