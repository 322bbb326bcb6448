"""One interface for all clients: a method and a request as JSON in, the answer as JSON out."""

import asyncio
import json
import os
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

import pytest
from pydantic import BaseModel

from scene_client import (
    AnswerError,
    AsyncClient,
    Client,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
)
from scene_client.schemas import FieldError
from tests.conftest import REPOSITORY, run_program
from tests.services import PATIENCE

LONG = 60.0
"""Seconds of a call, unless deadlines are the subject: the longest that a service accepts."""


class Caller(Protocol):
    """A client. It raises the exceptions of the Python clients."""

    def __call__(self, method: str, *request: Any, timeout: float | None = None) -> Any:
        """Return the answer as JSON."""


def _plain(answer: Any) -> Any:
    is_model = isinstance(answer, BaseModel)
    return json.loads(answer.model_dump_json(exclude_unset=True)) if is_model else answer


def _asked(client: Any, method: str, request: tuple[Any, ...], timeout: float | None) -> Any:
    """Call a method with a request as JSON. `where` takes label and rooms, not a whole request."""
    fields = {"timeout": timeout}
    if method == "where":
        return client.where(**request[0], **fields)
    return getattr(client, method)(*request, **fields)


@contextmanager
def sync_caller(place: Any, kind: type[Client] = Client, **options: Any) -> Iterator[Caller]:
    """`Client` at a URL, or `OfflineClient` with a store."""
    with kind(place, **{"timeout": LONG, **options}) as client:
        yield lambda method, *request, timeout=None: _plain(
            _asked(client, method, request, timeout)
        )


@contextmanager
def async_caller(url: str, **options: Any) -> Iterator[Caller]:
    """`AsyncClient`, on an event loop that runs during each call."""
    with asyncio.Runner() as runner:
        client = AsyncClient(url, **{"timeout": LONG, **options})
        try:
            yield lambda method, *request, timeout=None: _plain(
                runner.run(_asked(client, method, request, timeout))
            )
        finally:
            runner.run(client.close())


def compiled(
    find_tool: Callable[[str], Path], source: Path, program: Path, *headers_in: Path
) -> Path:
    """Compile a C++ program. Without its libraries, skip, or fail with REQUIRE_SYSTEM=1."""
    libraries = [find_tool("pkg-config"), "--cflags", "--libs", "cpp-httplib", "nlohmann_json"]
    flags = subprocess.run(libraries, capture_output=True, text=True)
    if flags.returncode:
        refuse = pytest.fail if os.environ.get("REQUIRE_SYSTEM") == "1" else pytest.skip
        refuse("cpp-httplib or nlohmann-json is not installed")
    run_program(
        *(find_tool("g++"), "-std=c++17", "-Wall", "-Wextra", "-Werror", "-pthread"),
        *(f"-I{folder}" for folder in (REPOSITORY / "clients" / "cpp", *headers_in)),
        *(source, "-o", program, *flags.stdout.split()),
    )
    return program


_ERRORS = {
    "deadline": DeadlineError,
    "unreachable": UnreachableError,
    "unreadable": AnswerError,
    "invalid": InvalidRequestError.about,
}


@contextmanager
def cpp_caller(
    program: Path, url: str, *, timeout: float = LONG, retries: int = 5, api_key: str = ""
) -> Iterator[Caller]:
    """`scene::Client`, in a separate process."""
    process = subprocess.Popen(
        [program, url, str(timeout), str(retries), api_key],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    assert process.stdin
    assert process.stdout

    def call(method: str, *request: Any, timeout: float | None = None) -> Any:
        line = {"method": method, "request": request[0] if request else None, "timeout": timeout}
        print(json.dumps(line), file=process.stdin, flush=True)
        result = json.loads(process.stdout.readline())
        outcome = result.pop("outcome")
        if outcome == "answer":
            return result["answer"]
        if outcome != "problem":
            raise _ERRORS[outcome](result["message"])
        result["errors"] = [FieldError.model_validate(error) for error in result["errors"]]
        text, problem = result.pop("text"), ProblemError(**result)
        assert text == str(problem)
        raise problem

    try:
        yield call
    finally:
        process.stdin.close()
        status = process.wait(timeout=PATIENCE)
        process.stdout.close()
    assert status == 0
