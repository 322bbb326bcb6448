"""One running service for all examples, over a store of small machines."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from tests.http.conftest import LiveService, launch
from tests.http.stores import make_store


@pytest.fixture(scope="session")
def service(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """The service as a process of its own."""
    folder = tmp_path_factory.mktemp("live")
    service = launch(make_store(folder / "store"), folder / "log")
    yield service
    service.client.close()
    service.process.terminate()
    service.process.wait(timeout=30)
