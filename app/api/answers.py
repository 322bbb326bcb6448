"""Answers of models as responses."""

from __future__ import annotations

from collections.abc import Iterable

from pydantic_core import to_json
from starlette.responses import Response

from app.serving.answers import Answer, written
from scene_client.schemas import Problem

# Their schemas, which the routes declare, describe them: to validate an answer would cost as much
# as to write it, and could only fail after the work. The tests do.


def respond(answer: Answer) -> Response:
    """An answer as it is.

    Raises:
        ValueError: a number in it is not finite.
    """
    return _response(written(answer))


def entry(answer: Answer) -> bytes:
    """What became of a scene of a batch that was answered.

    Raises:
        ValueError: a number in it is not finite.
    """
    return b'{"status":200,"result":%b}' % written(answer)


def failed_entry(problem: Problem) -> bytes:
    """What became of a scene of a batch that was not."""
    body = problem.model_dump_json(exclude_none=True).encode()
    return b'{"status":%d,"problem":%b}' % (problem.status, body)


def respond_all(request_id: str, entries: Iterable[bytes]) -> Response:
    """The answer to a batch."""
    return _response(
        b'{"request_id":%b,"results":[%b]}' % (to_json(request_id), b",".join(entries))
    )


def _response(body: bytes) -> Response:
    return Response(body, media_type="application/json")
