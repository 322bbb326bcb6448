"""The OpenAPI document against a live service: what it promises is what comes, whatever is sent."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import requests
import schemathesis

from tests.http.contract import call, documented
from tests.services import CHAOS, LiveService, live_service

pytestmark = pytest.mark.system

# Batches differ in their scenes alone, whose forms are those of single requests. `make chaos` asks
# all of them, and sends many more requests.
api = documented(examples=5).exclude(path=["/relations/batch", "/outliers/batch", "/rooms/batch"])
if CHAOS:
    api = documented(examples=60)


# A service of its own: the administration's routes change its store.
service = live_service()


@pytest.fixture(scope="module")
def session() -> Iterator[requests.Session]:
    with requests.Session() as session:
        yield session


@api.parametrize()
def test_every_operation_matches_the_document(
    case: schemathesis.Case, service: LiveService, session: requests.Session
) -> None:
    call(case, service, session)
