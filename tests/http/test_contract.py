"""The OpenAPI document against a live service: what it promises is what comes, whatever is sent."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import requests
import schemathesis

from tests.http.contract import call, documented
from tests.http.stores import make_store
from tests.services import CHAOS, LiveService, launch

pytestmark = pytest.mark.system

# Batches differ in their scenes alone, whose forms are those of single requests. `make chaos` asks
# all of them, and sends many more requests.
api = documented(examples=5).exclude(path=["/relations/batch", "/outliers/batch"])
if CHAOS:
    api = documented(examples=60)


@pytest.fixture(scope="module")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """A service of its own: the administration's routes change its store."""
    folder = tmp_path_factory.mktemp("contract")
    with launch(make_store(folder / "store"), folder / "log") as service:
        yield service
        service.control()
        assert "Traceback" not in service.log.read_text()


@pytest.fixture(scope="module")
def session() -> Iterator[requests.Session]:
    with requests.Session() as session:
        yield session


@api.parametrize()
def test_every_operation_keeps_its_promises(
    case: schemathesis.Case, service: LiveService, session: requests.Session
) -> None:
    call(case, service, session)
