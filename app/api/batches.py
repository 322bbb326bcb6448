"""Many scenes in one request, answered in order, each as if it had come alone."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Final, TypeVar

from fastapi import APIRouter
from pydantic import ValidationError
from starlette.responses import Response

from app.api import catalogue
from app.api.answers import entry, failed_entry, respond_all
from app.api.body import JSONRoute
from app.api.dependencies import SessionDep
from app.api.openapi import queued
from app.api.problems import from_exception, report_defect, unfit
from app.serving import questions
from app.serving.answers import Answer
from app.serving.models import DEFAULT
from app.serving.record import SUCCESS
from app.serving.session import Session
from scene_client.schemas import (
    BatchAnswer,
    BatchRequest,
    MissingAnswer,
    MissingRequest,
    OutliersAnswer,
    OutliersRequest,
    RelationsAnswer,
    RelationsRequest,
    SceneRequest,
)

RequestT = TypeVar("RequestT", bound=SceneRequest)

_PROBLEMS: Final = queued(
    catalogue.NOT_JSON,
    catalogue.REQUEST_TIMEOUT,
    catalogue.BODY_TOO_LARGE,
    catalogue.BODIES_FULL,
    catalogue.UNSUPPORTED_MEDIA_TYPE,
    catalogue.INVALID_REQUEST,
    catalogue.NOT_READY,
)

router = APIRouter(tags=["batches"], route_class=JSONRoute, responses=_PROBLEMS)


async def _answer_each(
    session: Session,
    batch: BatchRequest[RequestT],
    kind: type[RequestT],
    question: Callable[[Session, RequestT], Awaitable[Answer]],
) -> Response:
    def count(outcome: str) -> None:
        session.metrics.entry_answered(question.__name__, outcome)

    results: list[bytes] = []
    left = session.limits.answer_bytes
    with session.for_batch([_reference(scene) for scene in batch.scenes]) as held:
        for place, scene in enumerate(batch.scenes):
            try:
                held.ticket.check()
                asked = held.with_answer_bytes(left)
                result = await question(asked, _validated(scene, place, kind))
                results.append(entry(result))
                count(SUCCESS)
            except Exception as error:  # noqa: BLE001 — a defect too spoils one entry only
                outcome, failed = _failed(error, place, session.request_id)
                count(outcome)
                results.append(failed)
            left = max(0, left - len(results[-1]))
            # Others are served between two scenes, health checks first of all.
            await asyncio.sleep(0)
    return respond_all(session.request_id, results)


def _failed(error: Exception, place: int, request_id: str) -> tuple[str, bytes]:
    """The outcome and the entry of a scene that could not be answered.

    The error stays in this frame: it knows that of the batch, and would keep it from being freed.
    """
    failure = from_exception(error, at=("scenes", place))
    problem = failure.describe(request_id)
    if problem.status == 500:
        report_defect(error, request_id)
    return failure.kind.slug, failed_entry(problem)


def _reference(scene: Any) -> str:
    """The model that a scene names, before it has been validated."""
    found = scene.get("model", DEFAULT) if isinstance(scene, dict) else DEFAULT
    return found if isinstance(found, str) else DEFAULT


def _validated(scene: Any, place: int, kind: type[RequestT]) -> RequestT:
    try:
        return kind.model_validate(scene)
    except ValidationError as error:
        # Here, not below: what fails to validate later is an answer, and no fault of the client's.
        raise unfit(error, scene, at=("scenes", place)) from None


@router.post(
    "/relations/batch",
    summary="Relations of many scenes",
    response_model=BatchAnswer[RelationsAnswer],
)
async def relations_batch(request: BatchRequest[RelationsRequest], session: SessionDep) -> Response:
    """As `POST /relations`, for up to 256 scenes."""
    return await _answer_each(session, request, RelationsRequest, questions.relations)


@router.post(
    "/missing/batch",
    summary="Missing objects of many scenes",
    response_model=BatchAnswer[MissingAnswer],
)
async def missing_batch(request: BatchRequest[MissingRequest], session: SessionDep) -> Response:
    """As `POST /missing`, for up to 256 scenes."""
    return await _answer_each(session, request, MissingRequest, questions.missing)


@router.post(
    "/outliers/batch",
    summary="Outliers of many scenes",
    response_model=BatchAnswer[OutliersAnswer],
)
async def outliers_batch(request: BatchRequest[OutliersRequest], session: SessionDep) -> Response:
    """As `POST /outliers`, for up to 256 scenes."""
    return await _answer_each(session, request, OutliersRequest, questions.outliers)
