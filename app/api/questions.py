"""The four questions about one scene."""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter
from starlette.requests import Request

from app.api import catalogue
from app.api.body import JSONRoute
from app.api.openapi import operation_id, queued
from app.serving import questions
from app.serving import request as serving
from app.serving.answers import written
from scene_client.schemas import (
    GenerateAnswer,
    GenerateRequest,
    MissingAnswer,
    MissingRequest,
    OutliersAnswer,
    OutliersRequest,
    RelationsAnswer,
    RelationsRequest,
)

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

# The schemas in the routes only document the answers. Validating an answer would take as long as
# writing its JSON, so the tests do it instead.


def begin(http: Request) -> serving.Request:
    """Return the request as the serving layer uses it.

    Raises:
        NotReadyError: the models are not loaded yet.
    """
    state, runtime = http.scope["state"], http.scope["app"].state.runtime
    found: serving.Request = runtime.request(
        state["deadline"], state["request_id"], state["record"], http.is_disconnected
    )
    return found


@router.post(
    "/relations",
    summary="Which relations hold between these objects?",
    response_model=RelationsAnswer,
)
async def relations(asked: RelationsRequest, http: Request) -> bytes:
    """The most probable relations between the objects of a scene, best first."""
    return written(await questions.relations(begin(http), asked))


@router.post(
    "/missing",
    summary="Which objects are missing, and where would they stand?",
    response_model=MissingAnswer,
)
async def missing(asked: MissingRequest, http: Request) -> bytes:
    """The most probable missing objects, each with its most probable places.

    The answer proposes only classes that the scene does not contain: the models do not count
    objects of one class.
    """
    return written(await questions.missing(begin(http), asked))


@router.post(
    "/outliers",
    summary="Which objects do not belong here, or stand in the wrong place?",
    response_model=OutliersAnswer,
)
async def outliers(asked: OutliersRequest, http: Request) -> bytes:
    """All objects, least fitting first, and all observed relations, least probable first.

    Objects of the same class get the same score; only `misplaced` differs between them.
    """
    return written(await questions.outliers(begin(http), asked))


@router.post(
    "/generate",
    summary="What does a scene like this look like?",
    response_model=GenerateAnswer,
)
async def generate(asked: GenerateRequest, http: Request) -> bytes:
    """Scenes sampled from the model, given the evidence; the same seed gives the same scenes."""
    return written(await questions.generate(begin(http), asked))
