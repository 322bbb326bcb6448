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

# The schemas in the routes describe the answers. Validation of an answer would cost as much as its
# JSON; the tests validate.


def begin(http: Request) -> serving.Request:
    """The request as the models see it.

    Raises:
        NotReadyError: nothing has been loaded yet.
    """
    state, runtime = http.scope["state"], http.scope["app"].state.runtime
    found: serving.Request = runtime.request(
        state["deadline"], state["request_id"], state["record"], http.is_disconnected
    )
    return found


@router.post(
    "/relations",
    summary="How do these objects stand to each other?",
    response_model=RelationsAnswer,
)
async def relations(asked: RelationsRequest, http: Request) -> bytes:
    """The likeliest relations between the objects of a scene, best first."""
    return written(await questions.relations(begin(http), asked))


@router.post(
    "/missing",
    summary="What else should be here, and where?",
    response_model=MissingAnswer,
)
async def missing(asked: MissingRequest, http: Request) -> bytes:
    """The likeliest absent objects, and where each would stand.

    A class that is present is never proposed again: how many chairs a table wants is outside the
    models.
    """
    return written(await questions.missing(begin(http), asked))


@router.post(
    "/outliers",
    summary="What does not belong here, or stands in the wrong place?",
    response_model=OutliersAnswer,
)
async def outliers(asked: OutliersRequest, http: Request) -> bytes:
    """Every object, least fitting first, and every given relation, least likely first.

    Instances of one class are scored alike; only `misplaced` tells them apart.
    """
    return written(await questions.outliers(begin(http), asked))


@router.post(
    "/generate",
    summary="What would a scene like this look like?",
    response_model=GenerateAnswer,
)
async def generate(asked: GenerateRequest, http: Request) -> bytes:
    """Scenes drawn from the model that contain the evidence; the same seed draws the same ones."""
    return written(await questions.generate(begin(http), asked))
