"""A part of the hostile corpus against a live service; `make chaos` sends all of it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.chaos import corpus
from tests.chaos.attack import attack, faults_of_answer
from tests.chaos.wire import exchange, framing
from tests.http.stores import make_store
from tests.services import LiveService, launch

pytestmark = pytest.mark.system

EVERY = 53  # a prime, so that each wrong value comes to stand at many places


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    folder = tmp_path_factory.mktemp("hostile")
    with launch(make_store(folder / "store"), folder / "log", SCENE_CLIENT_TIMEOUT="5") as service:
        yield service


def test_requests_of_the_corpus_are_refused_in_order(service: LiveService) -> None:
    before = service.control()
    report = attack(service.port, list(corpus.everything())[::EVERY])
    assert report.faults == []
    assert report.total >= 300
    assert service.control() == before
    log = service.log.read_text()
    assert "Traceback" not in log
    assert corpus.MARKER.split()[0] not in log


def test_bodies_are_read_without_a_proxy_too(service: LiveService) -> None:
    for wire in framing():
        answers, closed = exchange(service.port, wire)
        for answer in answers:
            # What is not HTTP the server refuses itself, in plain text.
            if answer.body != b"Invalid HTTP request received.":
                assert not faults_of_answer(answer.status, answer.headers, answer.body), wire.name
        assert wire.expected in (None, tuple(answer.status for answer in answers)), wire.name
        assert closed or not wire.closes, wire.name


def test_every_field_of_every_request_is_attacked() -> None:
    from app.serving.questions import QUESTIONS
    from scene_client import schemas

    forms = {f"/{question.name}": question.request for question in QUESTIONS}
    forms[corpus.ALIAS] = schemas.AliasRequest
    for path, form in forms.items():
        assert set(corpus.VALID[path]) == set(form.model_fields)
    detection = corpus.SCENE["objects"][1]
    assert set(detection) == set(schemas.Detection.model_fields)
