"""The service without a proxy: slow, incomplete, hostile and concurrent requests."""

import json
import select
import socket
from contextlib import ExitStack, suppress
from pathlib import Path

import pytest
from httpx import Response

from app.questions import QUESTIONS
from benchmarks.load.connections import prepared
from scene_client import schemas
from tests.chaos import corpus
from tests.chaos.attack import attack, faults_of_answer
from tests.chaos.load import ConstantLoad
from tests.chaos.wire import BODY, LIVE, Wire, exchange, framing
from tests.http.test_problems import problem
from tests.services import PATIENCE, LiveService, launch, live_service, wait_until

pytestmark = pytest.mark.system

HEAD = (
    b"POST /outliers HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
    b"Content-Length: %d\r\n\r\n"
)

service = live_service(SCENE_CLIENT_TIMEOUT="1", logs_errors=True)
patient = live_service(SCENE_CLIENT_TIMEOUT="5")


@pytest.mark.parametrize(
    "part",
    [HEAD % len(BODY), HEAD % len(BODY) + BODY[:-1], HEAD % 250_000 + b" " * 200_000],
    ids=["no body", "part of a body", "part of a large body"],
)
def test_an_unfinished_body_gets_408(service: LiveService, part: bytes) -> None:
    (answer,), closed = exchange(service.port, Wire("", [part], None))
    slug = json.loads(answer.body)["type"].removeprefix("/problems/")
    assert (answer.status, slug) == (408, "request-timeout")
    assert closed


@pytest.mark.parametrize(
    ("path", "status"), [(b"/health/live", 200), (b"/missing", 405), (b"/stream", 404)]
)
def test_upgrade_requests_get_plain_answers(service: LiveService, path: bytes, status: int) -> None:
    upgrade = (
        b"Host: localhost\r\nConnection: Upgrade\r\nUpgrade: websocket\r\n"
        b"Sec-WebSocket-Version: 13\r\nSec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ=="
    )
    request = LIVE.replace(b"/health/live", path).replace(b"Host: localhost", upgrade)
    # The second part is a body that the parser would read as a request of its own.
    (answer,), closed = exchange(service.port, Wire("", [request, LIVE], None))
    assert answer.status == status
    assert closed
    assert "upgrade" not in answer.headers
    assert answer.headers["content-type"].startswith("application/")
    assert "WebSocket" not in service.log.read_text()


@pytest.mark.slow
def test_unfinished_bodies_use_bounded_memory(shared_store: Path, tmp_path: Path) -> None:
    """Sixty bodies of 2 MiB less one byte: the service holds as many as its budget allows."""
    settings = {"SCENE_CLIENT_TIMEOUT": "60", "SCENE_HELD_BODY_BYTES": str(8 * 2**20)}
    size = 2 * 2**20
    with launch(shared_store, tmp_path / "log", **settings) as service, ExitStack() as stack:
        before, answers = service.memory, service.control()
        waiting, head = list[socket.socket](), HEAD.replace(b"outliers", b"missing/batch") % size

        def hold() -> None:
            connection = socket.create_connection(("127.0.0.1", service.port), timeout=PATIENCE)
            waiting.append(stack.enter_context(connection))
            with suppress(ConnectionError):  # refused before the end of the body
                connection.sendall(head + b" " * (size - 1))

        for _ in range(60):
            hold()
        while len(waiting) > 4:
            answered, _, _ = select.select(waiting, [], [], PATIENCE)
            assert answered, "the service holds too many bodies"
            for connection in answered:
                assert connection.recv(4096).startswith(b"HTTP/1.1 503 ")
                waiting.remove(connection)
        assert service.memory - before < 32 * 2**20
        # Small bodies that arrive at once are accepted.
        assert service.control() == answers
        batch = json.dumps({"scenes": [{"objects": ["bed"]}]}) + " " * 100_000

        def post_batch() -> Response:
            headers = {"Content-Type": "application/json"}
            return service.client.post("/missing/batch", content=batch, headers=headers)

        def is_full() -> bool:
            return any(post_batch().status_code == 503 for _ in range(50))

        # Of bodies that arrive together, the service may refuse all, so one more comes alone.
        wait_until(lambda: is_full() or hold())
        refused = post_batch()
        problem(refused, 503, "bodies-full")
        assert int(refused.headers["retry-after"]) > 0
        stack.close()
        # The service notices the end of the connections after the client.
        wait_until(lambda: post_batch().status_code == 200)


MAX_GROWTH = 8 * 2**20
"""Bytes that the last 4,000 requests may add to what the allocator keeps of the first ones."""


# A prime, so that each wrong value comes to stand at many places.
@pytest.mark.parametrize("every", [37, pytest.param(5, marks=pytest.mark.slow)])
def test_hostile_requests(patient: LiveService, every: int) -> None:
    before = patient.control()
    requests = list(corpus.requests())[::every]
    # The first round takes some eighty megabytes, the later ones next to nothing.
    for _ in range(2 if every == 5 else 0):
        attack(patient.port, requests)
    resident, files = patient.memory, patient.descriptors
    report = attack(patient.port, requests)
    assert report.faults == []
    assert report.statuses.total() >= 10_000 / every
    assert 500 not in report.statuses
    assert patient.control() == before
    assert every > 5 or patient.memory - resident < MAX_GROWTH
    assert patient.descriptors <= files + 8
    assert corpus.MARKER.split()[0] not in patient.log.read_text()


def test_framing_without_a_proxy(patient: LiveService) -> None:
    for wire in framing():
        answers, closed = exchange(patient.port, wire)
        for answer in answers:
            # What is not HTTP the server refuses itself, in plain text.
            if answer.body != b"Invalid HTTP request received.":
                assert not faults_of_answer(answer.status, answer.headers, answer.body), wire.name
        assert wire.expected in (None, tuple(answer.status for answer in answers)), wire.name
        assert closed or not wire.closes, wire.name


def test_the_corpus_has_every_field() -> None:
    forms = {f"/{question.name}": question.request for question in QUESTIONS}
    for path, form in forms.items():
        assert set(corpus.VALID[path]) == set(form.model_fields)
    assert set(corpus.SCENE["objects"][1]) == set(schemas.Detection.model_fields)


BATCHES = [f"/{question}/batch" for question in ("relations", "missing", "outliers", "rooms")]
SINGLE = ["/relations", "/missing", "/outliers", "/rooms", "/generate"]
LABELS = ("bed", "lamp", "desk", "chair", "sofa", "sink", "book", "pillow", "table")


def others() -> list[bytes]:
    """Requests of each kind that differ from each other."""
    made = []
    for path in (*SINGLE, *BATCHES):
        for k in range(8):
            scene = {"objects": [LABELS[(k + j) % 9] for j in range(1 + k)], "seed": k}
            if path == "/generate":
                scene |= {"count": 1 + k % 3, "steps": 5 + k}
            made.append(prepared(path, {"scenes": [scene]} if path in BATCHES else scene))
    return made


def test_answers_under_load_are_the_same(live: LiveService) -> None:
    def judge(_: int, status: int, __: object) -> str | None:
        return None if status == 200 else f"status {status}"

    alone = live.control()
    with ConstantLoad(live.port, others(), judge, connections=24):
        for _ in range(3):
            assert live.control() == alone
