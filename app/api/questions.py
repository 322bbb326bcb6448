"""The four questions about one scene."""

from __future__ import annotations

from typing import Final

from fastapi import APIRouter
from starlette.responses import Response

from app.api import catalogue
from app.api.answers import respond
from app.api.body import JSONRoute
from app.api.dependencies import SessionDep
from app.api.openapi import queued
from app.serving import questions
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

router = APIRouter(tags=["questions"], route_class=JSONRoute, responses=PROBLEMS)


@router.post(
    "/relations",
    summary="How do these objects stand to each other?",
    response_model=RelationsAnswer,
)
async def relations(request: RelationsRequest, session: SessionDep) -> Response:
    """The likeliest relations between the objects of a scene, best first."""
    return respond(await questions.relations(session, request))


@router.post(
    "/missing",
    summary="What else should be here, and where?",
    response_model=MissingAnswer,
)
async def missing(request: MissingRequest, session: SessionDep) -> Response:
    """The likeliest absent objects, and where each would stand.

    A class that is present is never proposed again: how many chairs a table wants is outside the
    models.
    """
    return respond(await questions.missing(session, request))


@router.post(
    "/outliers",
    summary="What does not belong here, or stands in the wrong place?",
    response_model=OutliersAnswer,
)
async def outliers(request: OutliersRequest, session: SessionDep) -> Response:
    """Every object, least fitting first, and every given relation, least likely first.

    Instances of one class are scored alike; only `misplaced` tells them apart.
    """
    return respond(await questions.outliers(session, request))


@router.post(
    "/generate",
    summary="What would a scene like this look like?",
    response_model=GenerateAnswer,
)
async def generate(request: GenerateRequest, session: SessionDep) -> Response:
    """Scenes drawn from the model that contain the evidence; the same seed draws the same ones."""
    return respond(await questions.generate(session, request))
