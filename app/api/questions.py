"""Routes of the questions: one `POST` route for one scene, and one for a batch of scenes.

The answer to a batch has one entry for each scene.
"""

from collections.abc import Awaitable, Callable
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
from app.serving.admission import in_thread
from scene_client.schemas import MAX_BATCH, BatchAnswer, BatchRequest, SceneRequest

RequestT = TypeVar("RequestT", bound=SceneRequest)
_Endpoint = Callable[..., Awaitable[bytes]]

_FULL = "the batch has reached SCENE_MAX_ANSWER_BYTES. Send this scene in another request"

router = APIRouter(
    tags=["questions"],
    route_class=JSONRoute,
    responses=error_responses("admission", "body", "models", "name", "model", "scene"),
    generate_unique_id_function=operation_id,
)
batches = APIRouter(
    tags=["batches"],
    route_class=JSONRoute,
    responses=error_responses("admission", "body", "models"),
    generate_unique_id_function=operation_id,
)

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
    admission = request.runtime.admission
    return (await in_thread(validate, request.ticket, admission.worker))[0]


def _failed(error: Exception, number: int, scene: Any, request_id: str) -> tuple[str, bytes]:
    """Return the outcome for the metrics and the answer's entry of a failed scene.

    This is a separate function, because an error refers to the frame of `_answer_each`. A local
    variable of that frame must not refer to the error, to avoid a reference cycle.
    """
    if isinstance(error, RequestError):
        error.locate(scene, ("scenes", number))
    failure = from_exception(error, request_id)
    body = failure.describe(request_id).model_dump_json(exclude_none=True).encode()
    return failure.slug, b'{"status":%d,"problem":%b}' % (failure.status, body)


def _endpoints(question: Question[Any]) -> tuple[_Endpoint, _Endpoint]:
    """Create the endpoint functions of a question: for one scene, and for a batch."""

    async def answer(data: Any, http: Request) -> bytes:
        return await serving_request(http).answer(question, data)

    async def answer_batch(data: Any, http: Request) -> bytes:
        return await _answer_each(http, data, question)

    # FastAPI reads the schema of the body from the annotations.
    answer.__annotations__ |= {"data": question.request, "http": Request}
    schema = BatchRequest[question.request]  # type: ignore[name-defined]
    answer_batch.__annotations__ |= {"data": schema, "http": Request}
    return answer, answer_batch


for _question in QUESTIONS:
    _answer, _answer_batch = _endpoints(_question)
    router.add_api_route(
        f"/{_question.name}",
        _answer,
        methods=["POST"],
        name=_question.name,
        summary=_question.summary,
        description=_question.description,
        response_model=_question.response,
    )
    if not _question.samples:
        batches.add_api_route(
            f"/{_question.name}/batch",
            _answer_batch,
            methods=["POST"],
            name=f"{_question.name}_batch",
            summary=f"POST /{_question.name} for many scenes",
            description=f"Answer up to {MAX_BATCH} scenes, each like `POST /{_question.name}`.",
            response_model=BatchAnswer[_question.response],  # type: ignore[name-defined]
        )
