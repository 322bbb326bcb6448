"""A live service over a store of small machines, and every client of it."""

from __future__ import annotations

import socket
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path

import pytest

from tests.client import callers
from tests.client.callers import Caller
from tests.client.peers import Peer
from tests.services import LiveService


@pytest.fixture(scope="session")
def url(live: LiveService) -> str:
    """Where the service is."""
    return live.url


@pytest.fixture(scope="session")
def bridge(
    tmp_path_factory: pytest.TempPathFactory, require_system_tool: Callable[[str], Path]
) -> Path:
    """The program that puts calls to the C++ client."""
    source = Path(__file__).parent / "bridge.cpp"
    program = tmp_path_factory.mktemp("bridge") / "bridge"
    compiler, pkg_config = require_system_tool("g++"), require_system_tool("pkg-config")
    return callers.compiled(source, program, compiler, pkg_config)


@pytest.fixture
def peer() -> Iterator[Callable[[Callable[[socket.socket], None]], Peer]]:
    """Starts services that do with each connection what they are told; see `peers`."""
    with ExitStack() as stack:

        def start(behave: Callable[[socket.socket], None]) -> Peer:
            started = Peer(behave)
            stack.callback(started.close)
            return started

        yield start


# Every client there is: whoever adds one adds it here, and the contract is asked of it too.
OVER_HTTP = ("sync", "async", pytest.param("cpp", marks=pytest.mark.system))
EVERY = (*OVER_HTTP, "offline")


@pytest.fixture
def open_caller(request: pytest.FixtureRequest) -> Callable[..., AbstractContextManager[Caller]]:
    """Opens a client of the kind that the test is parametrised with, at a URL."""
    return opener(request)


def opener(request: pytest.FixtureRequest) -> Callable[..., AbstractContextManager[Caller]]:
    if request.param == "cpp":
        return partial(callers.cpp_caller, request.getfixturevalue("bridge"))
    return {"sync": callers.sync_caller, "async": callers.async_caller}[request.param]


@pytest.fixture(scope="session")
def caller(request: pytest.FixtureRequest, url: str, shared_store: Path) -> Iterator[Caller]:
    """A client of the kind that the test is parametrised with, of the live service."""
    is_offline = request.param == "offline"
    opened = callers.offline_caller(shared_store) if is_offline else opener(request)(url)
    with opened as caller:
        yield caller
