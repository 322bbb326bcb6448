"""Hostile requests to a live service: wrong values at every place, and requests below HTTP."""

import pytest

from app.questions import QUESTIONS
from scene_client import schemas
from tests.chaos import corpus
from tests.chaos.attack import attack, faults_of_answer
from tests.chaos.wire import exchange, framing
from tests.services import LiveService, live_service

pytestmark = pytest.mark.system

MAX_GROWTH = 8 * 2**20
"""Bytes that the last 4,000 requests may add to what the allocator keeps of the first ones."""

service = live_service(SCENE_CLIENT_TIMEOUT="5")


# A prime, so that each wrong value comes to stand at many places.
@pytest.mark.parametrize("every", [37, pytest.param(5, marks=pytest.mark.slow)])
def test_hostile_requests(service: LiveService, every: int) -> None:
    before = service.control()
    requests = list(corpus.requests())[::every]
    # The first round takes some eighty megabytes, the later ones next to nothing.
    for _ in range(2 if every == 5 else 0):
        attack(service.port, requests)
    resident, files = service.memory, service.descriptors
    report = attack(service.port, requests)
    assert report.faults == []
    assert report.statuses.total() >= 10_000 / every
    assert 500 not in report.statuses
    assert service.control() == before
    assert every > 5 or service.memory - resident < MAX_GROWTH
    assert service.descriptors <= files + 8
    assert corpus.MARKER.split()[0] not in service.log.read_text()


def test_framing_without_a_proxy(service: LiveService) -> None:
    for wire in framing():
        answers, closed = exchange(service.port, wire)
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
