"""HAProxy with the shipped configuration in front of the service: normal and hostile requests."""

import json
import resource
import socket
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from typing import Any

import httpx
import pytest

from app.settings import Settings
from scene_client import Client
from tests.chaos.wire import LIVE, Wire, exchange, wires
from tests.services import (
    PATIENCE,
    LiveService,
    free_port,
    http_server,
    is_ready,
    launch,
    live_service,
    wait_until,
)
from tests.system.conftest import Proxy, StartProxy

pytestmark = pytest.mark.system

API_KEY = "incorrect-zebra-capacitor-nail"
CONNECTIONS, REQUESTS = 30, 100
SCENE = {"objects": ["bed", "lamp"]}
HEAD = b"POST /outliers HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"

service = live_service(SCENE_CLIENT_TIMEOUT="3")


@pytest.fixture(scope="module")
def behind(haproxy: StartProxy, configuration: Path) -> StartProxy:
    def start(service: LiveService, log: Path, **variables: str) -> Any:
        backend = {
            "PROXY_BACKEND": f"127.0.0.1:{service.port}",
            "PROXY_HEALTH_PORT": str(service.port),
            "PROXY_REPLICAS": "1",
        }
        return haproxy(configuration, log, **(backend | variables))

    return start


@pytest.fixture(scope="module")
def proxy(behind, service, tmp_path_factory):
    """A proxy without a limit on rates."""
    log = tmp_path_factory.mktemp("proxy") / "log"
    variables = {"PROXY_HEAD_TIMEOUT": "10s", "PROXY_TIMEOUT": "10s", "PROXY_REQUESTS": "1000000"}
    with behind(service, log, **variables) as proxy:
        yield proxy


def test_questions_and_pages_are_answered(proxy: Proxy) -> None:
    with Client(proxy.address, timeout=60) as scene:
        assert scene.missing(SCENE["objects"]).missing
    with httpx.Client(base_url=proxy.address, timeout=PATIENCE) as client:
        for path in ("/", "/docs", "/models", "/problems", "/health/ready"):
            assert client.get(path).status_code == 200, path
        batch = client.post("/missing/batch", json={"scenes": [SCENE] * 256})
        assert len(batch.json()["results"]) == 256
        # Refusals of the service arrive as they are.
        assert client.post("/missing", json={}).json()["type"] == "/problems/invalid-request"
        media = {"Content-Type": "application/json"}
        large = client.post("/missing", content=b" " * 2_100_000, headers=media)
        assert large.json()["type"] == "/problems/body-too-large"
        other_host = client.get("/models", headers={"Host": "evil.example"})
        assert other_host.json()["type"] == "/problems/host-refused"


def test_incomplete_heads(behind: StartProxy, service: LiveService, tmp_path: Path) -> None:
    with behind(service, tmp_path / "log", PROXY_HEAD_TIMEOUT="1s") as proxy:
        for part, statuses in ((b"", ([], [408])), (LIVE[:-2], ([408],))):
            answers, is_closed = exchange(proxy.port, Wire("", [part], None))
            assert is_closed
            assert [answer.status for answer in answers] in statuses


@pytest.mark.slow
def test_requests_below_http_are_refused(proxy: Proxy, service: LiveService) -> None:
    with ThreadPoolExecutor(8) as pool:
        exchanges = [(wire, pool.submit(exchange, proxy.port, wire)) for wire in wires()]
    assert len(exchanges) > 80
    for wire, exchanged in exchanges:
        answers, is_closed = exchanged.result()
        statuses = tuple(answer.status for answer in answers)
        assert max(statuses, default=0) < 500, wire.name
        if b"transfer-encoding" in b"".join(wire.parts).lower():
            assert statuses in {(411,), (400,), (415,)}, wire.name
        else:
            assert wire.expected in (None, statuses), wire.name
        assert is_closed or not wire.closes, wire.name
    assert '"smuggled"' not in service.log.read_text()


@pytest.mark.slow
def test_silent_connections(behind: StartProxy, shared_store: Path, tmp_path: Path) -> None:
    """300 silent connections from ten addresses; the service may open 256 files."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, hard))
    try:
        service = launch(shared_store, tmp_path / "service")
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    variables = {"PROXY_HEAD_TIMEOUT": "2s", "PROXY_REQUESTS": "1000000"}
    with service, behind(service, tmp_path / "log", **variables) as proxy, ExitStack() as stack:
        address, clients = ("127.0.0.1", proxy.port), [(f"127.0.0.{10 + k}", 0) for k in range(10)]
        opened = (socket.create_connection(address, 30, client) for client in clients * 30)
        silent = [stack.enter_context(connection) for connection in opened]
        for _ in range(20):
            assert httpx.get(f"{proxy.address}/health/live").status_code == 200
            assert service.client.get("/health/live").status_code == 200
        assert service.descriptors < 64
        # The proxy closes each of them, with status 408 or without an answer.
        for connection in silent:
            while part := connection.recv(4096):
                assert b"408" in part or b"request-timeout" in part


@pytest.mark.slow
def test_crashes_are_not_repeated(haproxy: StartProxy, configuration: Path, tmp_path: Path) -> None:
    """Three replicas close the connection of each question, as if it had crashed them."""
    questions = []

    class Crashing(BaseHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def do_GET(self) -> None:
            self.send_response(200)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def do_POST(self) -> None:
            questions.append(self.path)
            self.close_connection = True

    with http_server(Crashing) as url:
        address = url.removeprefix("http://")
        variables = {"PROXY_BACKEND": address, "PROXY_HEALTH_PORT": address.partition(":")[2]}
        with haproxy(configuration, tmp_path / "log", PROXY_REPLICAS="3", **variables) as proxy:
            answer = httpx.post(f"{proxy.address}/outliers", json=SCENE, timeout=PATIENCE)
    assert answer.status_code == 502
    assert questions == ["/outliers"]


def test_slow_bodies_are_ended_by_the_service(proxy: Proxy) -> None:
    """Every byte restarts the proxy's time-out; the service bounds the time of the whole body."""
    received = b""
    with socket.create_connection(("127.0.0.1", proxy.port)) as connection:
        connection.sendall(HEAD + b"Content-Length: 100000\r\n\r\n" + b" " * 50_000)
        connection.settimeout(0.2)
        for _ in range(1000):
            try:
                connection.sendall(b" ")
                if not (part := connection.recv(4096)):
                    break
            except TimeoutError:
                continue
            except ConnectionError:
                break
            received += part
    assert received.startswith(b"HTTP/1.1 408 ")
    assert b"/problems/request-timeout" in received


def test_limit_of_connections(behind: StartProxy, service: LiveService, tmp_path: Path) -> None:
    variables = {"PROXY_CONNECTIONS": str(CONNECTIONS), "PROXY_HEAD_TIMEOUT": "60s"}
    with behind(service, tmp_path / "log", **variables) as proxy:
        with ExitStack() as stack:
            answered = 0
            for _ in range(CONNECTIONS + 10):
                with suppress(ConnectionError):
                    place = ("127.0.0.1", proxy.port)
                    connection = socket.create_connection(place, timeout=PATIENCE)
                    stack.enter_context(connection)
                    # The begun second request keeps the connection.
                    connection.sendall(LIVE + b"GET ")
                    answered += connection.recv(4096).startswith(b"HTTP/1.1 200 ")
        assert CONNECTIONS - 5 <= answered <= CONNECTIONS
        wait_until(lambda: is_ready(proxy.port))


def test_limit_of_requests(behind: StartProxy, service: LiveService, tmp_path: Path) -> None:
    with (
        behind(service, tmp_path / "log", PROXY_REQUESTS=str(REQUESTS)) as proxy,
        httpx.Client(base_url=proxy.address, timeout=PATIENCE) as client,
    ):
        answers = [client.post("/missing", json=SCENE) for _ in range(REQUESTS + 50)]
    statuses = [answer.status_code for answer in answers]
    assert statuses.count(200) + statuses.count(429) == len(statuses)
    assert REQUESTS - 20 <= statuses.count(200) <= REQUESTS
    (refusal, *_) = (answer for answer in answers if answer.status_code == 429)
    assert refusal.headers["content-type"] == "application/problem+json"
    assert int(refusal.headers["retry-after"]) > 0


METRICS = b"GET %b HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n"
# The service would read trailers as headers: a key, a host, a media type.
CHUNKED = HEAD + b"Transfer-Encoding: chunked\r\n\r\n2\r\n{}\r\n0\r\n"
TRAILERS = CHUNKED + b"X-API-Key: 0123456789abcdef\r\nHost: evil.example\r\n\r\n"


@pytest.mark.parametrize(
    ("text", "status"),
    [
        *(
            (METRICS % path, 404)
            for path in (b"/metrics", b"/metric%73", b"/metrics/", b"//metrics")
        ),
        (TRAILERS, 411),
    ],
)
def test_metrics_and_trailers_reach_no_service(proxy, service, text, status):
    before = len(service.log.read_text().splitlines())
    (answer,), is_closed = exchange(proxy.port, Wire("", [text], (status,), closes=status == 404))
    assert (answer.status, is_closed) == (status, status == 404)
    assert answer.headers["content-type"] == "application/problem+json"
    assert status == 411 or json.loads(answer.body)["type"] == "/problems/not-found"
    added = service.log.read_text().splitlines()[before:]
    assert all("/health/" in line for line in added)


@pytest.mark.slow
def test_the_log_has_no_secrets(behind: StartProxy, shared_store: Path, tmp_path: Path) -> None:
    with (
        launch(shared_store, tmp_path / "service", SCENE_API_KEY=API_KEY) as service,
        behind(service, tmp_path / "log") as proxy,
        httpx.Client(base_url=proxy.address, timeout=PATIENCE) as client,
    ):
        for headers in ({"X-API-Key": API_KEY}, {"Authorization": f"Bearer {API_KEY}"}):
            known = headers | {"X-Request-Id": "find-me"}
            # The service refuses a query, so a key in a query is of no use.
            answer = client.post(f"/missing?key={API_KEY}", json=SCENE, headers=known)
            assert answer.status_code == 400
            assert client.get(f"/{API_KEY}", headers=headers).status_code == 404
        wait_until(lambda: proxy.log.read_text().count('"status": 404') >= 2)
        log = proxy.log.read_text()
    assert API_KEY not in log
    entries = [json.loads(line) for line in log.splitlines() if line.startswith("{")]
    assert [entry["request_id"] for entry in entries].count("find-me") == 2


CHECKED = """
import sys
from pathlib import Path
from app.__main__ import main
from app.api.health import HealthPort
from app.questions.missing import MISSING

ask, answer = MISSING.answer, HealthPort._answer
begun, checks = Path({begun!r}), Path({checks!r})

def busy(model, scene, *args, **parameters):
    if len(scene.objects) == 5:
        begun.touch()
        before = checks.stat().st_size
        while checks.stat().st_size < before + 4:
            pass
    return ask(model, scene, *args, **parameters)

def counted(self, head):
    with checks.open("ab") as file:
        file.write(b".")
    return answer(self, head)

MISSING.answer, HealthPort._answer = busy, counted
sys.exit(main())
"""
"""A program for `launch`: a question about five objects takes until four health checks later."""


def test_a_busy_replica_stays_up(behind: StartProxy, shared_store: Path, tmp_path: Path) -> None:
    program = CHECKED.format(begun=str(tmp_path / "begun"), checks=str(tmp_path / "checks"))
    health = str(free_port())
    with (
        launch(
            *(shared_store, tmp_path / "service"),
            program=("-c", program),
            SCENE_HEALTH_PORT=health,
        ) as service,
        behind(service, tmp_path / "log", PROXY_HEALTH_PORT=health) as proxy,
    ):
        five = {"objects": ["bed", "lamp", "desk", "chair", "sofa"]}
        answer = httpx.post(f"{proxy.address}/missing", json=five, timeout=PATIENCE)
        assert answer.status_code == 200
        assert (tmp_path / "begun").exists()
        assert "DOWN" not in proxy.log.read_text()


@pytest.mark.slow
def test_no_service_gives_503(behind: StartProxy, shared_store: Path, tmp_path: Path) -> None:
    with (
        launch(shared_store, tmp_path / "service") as service,
        behind(service, tmp_path / "log") as proxy,
    ):
        service.process.kill()
        service.process.wait(timeout=PATIENCE)
        wait_until(lambda: not is_ready(proxy.port))
        answer = httpx.post(f"{proxy.address}/missing", json=SCENE, timeout=PATIENCE)
        assert answer.status_code == 503
        assert answer.json()["type"] == "/problems/not-ready"
        assert int(answer.headers["retry-after"]) > 0


def test_the_proxy_opens_fewer_connections_than_the_service_accepts(configuration: Path) -> None:
    text = configuration.read_text("utf-8")
    (most,) = [int(line.split(" maxconn ")[1].split()[0])
               for line in text.splitlines() if "default-server" in line]  # fmt: skip
    assert most < Settings.model_fields["max_connections"].default
