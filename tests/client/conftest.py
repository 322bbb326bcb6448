"""Every client of a live service with small machines."""

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path

import pytest

from scene_client import OfflineClient
from tests.client import callers
from tests.client.callers import Caller
from tests.client.peers import Peer
from tests.conftest import FindTool
from tests.services import in_thread


@pytest.fixture(scope="session")
def bridge(tmp_path_factory: pytest.TempPathFactory, find_tool: FindTool) -> Path:
    source = Path(__file__).parent / "bridge.cpp"
    program = tmp_path_factory.mktemp("bridge") / "bridge"
    return callers.compiled(find_tool, source, program)


@pytest.fixture
def peer() -> Iterator[Callable[[Callable[[socket.socket], None]], Peer]]:
    """Return a function that starts a server, which calls a function for each connection."""
    with ExitStack() as stack:
        yield lambda behave: stack.enter_context(in_thread(Peer(behave)))


# The contract tests ask every client of these lists.
OVER_HTTP = ("sync", "async", pytest.param("cpp", marks=pytest.mark.system))
EVERY = (*OVER_HTTP, "offline")


def opener(request: pytest.FixtureRequest) -> Callable[..., AbstractContextManager[Caller]]:
    """Return a function that opens a client at a URL; the parameter of the test is its kind."""
    if request.param == "cpp":
        return partial(callers.cpp_caller, request.getfixturevalue("bridge"))
    return callers.async_caller if request.param == "async" else callers.sync_caller


open_caller = pytest.fixture(opener)


@pytest.fixture(scope="session")
def caller(request: pytest.FixtureRequest, url: str, shared_store: Path) -> Iterator[Caller]:
    """A client of the live service; the parameter of the test is its kind."""
    if request.param == "offline":
        opened = callers.sync_caller(shared_store, OfflineClient)
    else:
        opened = opener(request)(url)
    with opened as caller:
        yield caller
