"""The whole hostile corpus against one live service, which is none the worse for it."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.chaos import corpus
from tests.chaos.attack import attack
from tests.chaos.wire import exchange, wires
from tests.http.stores import make_store
from tests.services import LiveService, launch

MAX_GROWTH = 8 * 2**20
"""Bytes that 20,000 requests may add to what the largest of them left with the allocator."""


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    folder = tmp_path_factory.mktemp("hostile")
    with launch(make_store(folder / "store"), folder / "log", SCENE_CLIENT_TIMEOUT="5") as service:
        yield service


def test_no_request_of_the_corpus_breaks_the_service(service: LiveService) -> None:
    before = service.control()
    # Twice before: what the allocator keeps for the largest is kept once. The first round takes
    # some eighty megabytes, the later ones next to nothing.
    for _ in range(2):
        attack(service.port, corpus.everything())
    resident, files = service.memory, service.descriptors
    report = attack(service.port, corpus.everything())
    assert report.faults == []
    assert report.total >= 10_000
    assert 500 not in report.statuses
    assert service.control() == before
    assert service.memory - resident < MAX_GROWTH
    assert service.descriptors <= files + 8
    assert "Traceback" not in service.log.read_text()
    assert corpus.MARKER.split()[0] not in service.log.read_text()


def test_nothing_below_http_breaks_the_service(service: LiveService) -> None:
    """Without a proxy; tests/system/test_proxy.py says what the proxy refuses."""
    before = service.control()
    for wire in wires():
        answers, _ = exchange(service.port, wire, patience=6)
        assert all(answer.status < 500 for answer in answers), wire.name
    assert service.control() == before
    assert "Traceback" not in service.log.read_text()
    assert '"smuggled"' not in service.log.read_text()
