"""Every client, behind one face: a method, a request as in the HTTP contract, an answer in JSON."""

from __future__ import annotations

import asyncio
import json
import os
import subprocess
from collections.abc import Iterator
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
    OfflineClient,
    ProblemError,
    UnreachableError,
)
from scene_client.schemas import FieldError
from tests.conftest import REPOSITORY, run_program


class Caller(Protocol):
    """A client. What goes wrong is raised as the Python clients raise it."""

    def __call__(self, method: str, request: Any = None, *, timeout: float | None = None) -> Any:
        """The answer, as it stood in JSON."""


def _plain(answer: Any) -> Any:
    if isinstance(answer, BaseModel):
        return json.loads(answer.model_dump_json(exclude_unset=True))
    return answer


def _arguments(request: Any) -> tuple[Any, ...]:
    return () if request is None else (request,)


def blocking(client: Client) -> Caller:
    """`Client` and what derives from it."""

    def call(method: str, request: Any = None, *, timeout: float | None = None) -> Any:
        return _plain(getattr(client, method)(*_arguments(request), timeout=timeout))

    return call


@contextmanager
def sync_caller(url: str, **options: Any) -> Iterator[Caller]:
    """`Client`."""
    with Client(url, **options) as client:
        yield blocking(client)


@contextmanager
def async_caller(url: str, **options: Any) -> Iterator[Caller]:
    """`AsyncClient`, on a loop that runs while it is asked."""
    with asyncio.Runner() as runner:
        client = AsyncClient(url, **options)

        def call(method: str, request: Any = None, *, timeout: float | None = None) -> Any:
            asked = getattr(client, method)(*_arguments(request), timeout=timeout)
            return _plain(runner.run(asked))

        try:
            yield call
        finally:
            runner.run(client.close())


@contextmanager
def offline_caller(store: Path, **options: Any) -> Iterator[Caller]:
    """`OfflineClient`."""
    with OfflineClient(store, **options) as client:
        yield blocking(client)


def compiled(
    source: Path, program: Path, compiler: Path, pkg_config: Path, *headers_in: Path
) -> Path:
    """A C++ program over ``scene_client.hpp``, and headers in further folders.

    Where its libraries are missing the test is skipped, or fails under REQUIRE_SYSTEM=1.
    """
    found = subprocess.run(
        [pkg_config, "--cflags", "--libs", "cpp-httplib"], capture_output=True, text=True
    )
    headers = "#include <httplib.h>\n#include <nlohmann/json.hpp>\n"
    probe = subprocess.run(
        [compiler, "-std=c++17", "-fsyntax-only", "-x", "c++", "-"],
        input=headers,
        capture_output=True,
        text=True,
    )
    if found.returncode or probe.returncode:
        message = "cpp-httplib or nlohmann-json is not installed"
        if os.environ.get("REQUIRE_SYSTEM") == "1":
            pytest.fail(message, pytrace=False)
        pytest.skip(message)
    command = [
        compiler,
        *("-std=c++17", "-Wall", "-Wextra", "-Werror", "-pthread"),
        *(f"-I{folder}" for folder in (REPOSITORY / "clients" / "cpp", *headers_in)),
        *(source, "-o", program),
        *found.stdout.split(),
    ]
    run_program(*command)
    return program


@contextmanager
def cpp_caller(
    program: Path, url: str, *, timeout: float = 10.0, retries: int = 5, api_key: str = ""
) -> Iterator[Caller]:
    """`scene::Client`, in a process of its own."""
    process = subprocess.Popen(
        [program, url, str(timeout), str(retries), api_key],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    to, of = process.stdin, process.stdout
    assert to is not None
    assert of is not None

    def call(method: str, request: Any = None, *, timeout: float | None = None) -> Any:
        to.write(json.dumps({"method": method, "request": request, "timeout": timeout}) + "\n")
        to.flush()
        said = json.loads(of.readline())
        match said.pop("outcome"):
            case "answer":
                return said["answer"]
            case "problem":
                errors = [FieldError.model_validate(error) for error in said.pop("errors")]
                text, problem = said.pop("text"), ProblemError(**said, errors=errors)
                assert text == str(problem)
                raise problem
            case "deadline":
                raise DeadlineError(said["message"])
            case "unreachable":
                raise UnreachableError(said["message"])
            case "unreadable":
                raise AnswerError(said["message"])
            case "invalid":
                raise InvalidRequestError([FieldError(pointer="#", message=said["message"])])
            case other:
                raise AssertionError(other)

    try:
        yield call
    finally:
        to.close()
        status = process.wait(timeout=10)
        of.close()
    assert status == 0
