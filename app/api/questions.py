"""Routes of the questions: one `POST` route for one scene, and one for a batch of scenes.

The answer to a batch has one entry for each scene.
"""

from typing import Any, TypeVar

from fastapi import APIRouter
from pydantic_core import to_json
from starlette.requests import Request

from app.api.body import JSONRoute, validated
from app.api.openapi import error_responses, operation_id
from app.api.problems import from_exception
from app.errors import AnswerTooLargeError, LocatedError, RequestError
from app.questions import QUESTIONS, Question
from app.serving import request as serving
from scene_client.schemas import MAX_BATCH, BatchAnswer, BatchRequest, SceneRequest

RequestT = TypeVar("RequestT", bound=SceneRequest)

_FULL = "the batch has reached SCENE_MAX_ANSWER_BYTES. Send this scene in another request"

router = APIRouter(route_class=JSONRoute, generate_unique_id_function=operation_id)

# The service does not validate its own answers: validation takes as long as writing the JSON.
# The tests validate answers against the schemas of the routes.


def serving_request(http: Request) -> serving.Request:
    """Create the serving request of an HTTP request. It uses one snapshot of the models."""
    state, runtime = http.scope["state"], http.scope["app"].state.runtime
    return serving.Request(
        state["request_id"], state["ticket"], state["record"], runtime, runtime.models
    )


async def _answer_each(
    http: Request, batch: BatchRequest[RequestT], question: Question[RequestT]
) -> bytes:
    request = serving_request(http)
    results: list[bytes] = []
    admission = request.runtime.admission
    # The rest is for the problems of the scenes that the batch does not answer.
    left = request.runtime.limits.answer_bytes // 16 * 15
    await request.ticket.enter(admission.slow, len(batch.scenes))
    for number, scene in enumerate(batch.scenes):
        try:
            if left <= 0:
                raise AnswerTooLargeError([LocatedError((), _FULL)])
            request.ticket.check()
            data = await _validated(scene, question, number, request)
            answer = await request.answer(question, data, left)
            outcome, result = serving.SUCCESS, b'{"status":200,"result":%b}' % answer
        except Exception as error:  # noqa: BLE001 — any error fails only this scene
            outcome, result = _failed(error, number, scene, request.id)
        request.runtime.metrics.entry_answered(question.name, outcome)
        results.append(result)
        # After the first answer that is too large, the batch stops.
        left = 0 if outcome == AnswerTooLargeError.slug else left - len(result)
        await admission.quick.let_pass()
    return b'{"request_id":%b,"results":[%b]}' % (to_json(request.id), b",".join(results))


async def _validated(
    scene: Any, question: Question[RequestT], number: int, request: serving.Request
) -> RequestT:
    """Validate a scene of a batch. The worker thread validates large scenes."""

    def validate(_: object) -> RequestT:
        return validated(scene, question.request, at=("scenes", number))

    if not isinstance(scene, dict) or serving.is_small(scene):
        return validate(None)
    return await request.runtime.admission.in_worker(request.ticket, validate)


def _failed(error: Exception, number: int, scene: Any, request_id: str) -> tuple[str, bytes]:
    """Return outcome and answer entry of a failed scene, without a cycle; see `gateway._fail`."""
    if isinstance(error, RequestError):
        error.locate(scene, ("scenes", number))
    failure = from_exception(error, request_id)
    body = failure.describe(request_id).model_dump_json(exclude_none=True).encode()
    return failure.slug, b'{"status":%d,"problem":%b}' % (failure.status, body)


def _add_route(question: Question[Any]) -> None:
    async def answer(data: Any, http: Request) -> bytes:
        return await serving_request(http).answer(question, data)

    # FastAPI reads the schema of the body from the annotations.
    answer.__annotations__["data"] = question.request
    router.add_api_route(
        f"/{question.name}",
        answer,
        methods=["POST"],
        name=question.name,
        tags=["questions"],
        summary=question.summary,
        description=question.description,
        response_model=question.response,
        responses=error_responses("admission", "body", "models", "name", "model", "scene"),
    )


def _add_batch_route(question: Question[Any]) -> None:
    async def answer(data: Any, http: Request) -> bytes:
        return await _answer_each(http, data, question)

    answer.__annotations__["data"] = BatchRequest[question.request]  # type: ignore[name-defined]
    router.add_api_route(
        f"/{question.name}/batch",
        answer,
        methods=["POST"],
        name=f"{question.name}_batch",
        tags=["batches"],
        summary=f"POST /{question.name} for many scenes",
        description=f"Answer up to {MAX_BATCH} scenes, each like `POST /{question.name}`.",
        response_model=BatchAnswer[question.response],  # type: ignore[name-defined]
        responses=error_responses("admission", "body", "models"),
    )


for _question in QUESTIONS:
    _add_route(_question)
for _question in QUESTIONS:
    if not _question.samples:
        _add_batch_route(_question)
