"""Routes of the questions about one scene: one `POST` route for each entry of `QUESTIONS`."""

from __future__ import annotations

from collections.abc import Awaitable, Callable
from typing import Any, Final

from fastapi import APIRouter
from starlette.requests import Request

from app.api import catalogue
from app.api.body import JSONRoute
from app.api.openapi import operation_id, queued
from app.serving import request as serving
from app.serving.answers import written
from app.serving.questions import QUESTIONS, Question

PROBLEMS: Final = queued(
    catalogue.NOT_JSON,
    catalogue.MODEL_NOT_FOUND,
    catalogue.REQUEST_TIMEOUT,
    catalogue.BODY_TOO_LARGE,
    catalogue.BODIES_FULL,
    catalogue.UNSUPPORTED_MEDIA_TYPE,
    catalogue.INVALID_REQUEST,
    catalogue.UNKNOWN_LABELS,
    catalogue.CONTRADICTORY_EVIDENCE,
    catalogue.ANSWER_TOO_LARGE,
    catalogue.NOT_READY,
    catalogue.MODEL_UNAVAILABLE,
)

router = APIRouter(
    tags=["questions"],
    route_class=JSONRoute,
    responses=PROBLEMS,
    generate_unique_id_function=operation_id,
)

# The service does not validate its own answers: validation takes as long as writing the JSON.
# The tests validate answers against the schemas of the routes.


def begin(http: Request) -> serving.Request:
    """Create the serving request of an HTTP request.

    Raises:
        NotReadyError: the models have not been loaded yet.
    """
    state, runtime = http.scope["state"], http.scope["app"].state.runtime
    found: serving.Request = runtime.request(
        state["deadline"], state["request_id"], state["record"], http.is_disconnected
    )
    return found


def _answering(question: Question[Any]) -> Callable[..., Awaitable[bytes]]:
    """Create the endpoint function of a question."""

    async def answer(asked: Any, http: Request) -> bytes:
        return written(await question.answer(begin(http), asked))

    # FastAPI reads the schema of the body from the annotations.
    answer.__annotations__ |= {"asked": question.request, "http": Request}
    return answer


for _question in QUESTIONS:
    router.add_api_route(
        f"/{_question.name}",
        _answering(_question),
        methods=["POST"],
        name=_question.name,
        summary=_question.summary,
        description=_question.description,
        response_model=_question.response,
    )
