"""Routes of the questions: one `POST` route for one scene, and one for a batch of scenes.

The answer to a batch has one entry for each scene.
"""

from collections.abc import Callable, Mapping
from functools import partial
from time import monotonic
from typing import Any, Final, TypeAlias, TypeVar, cast

from fastapi import APIRouter
from pydantic_core import to_json
from starlette.requests import Request

from app.api.body import JSONRoute, validated
from app.api.gateway import SUCCESS, Record
from app.api.openapi import error_responses, operation_id
from app.api.problems import from_exception
from app.errors import AnswerTooLargeError, LocatedError, Location, RequestError
from app.questions import QUESTIONS, Question
from app.questions.alternatives import label_probabilities
from app.questions.answer import Fields, envelope, written_within
from app.questions.generate import STEPS
from app.questions.names import LookUps, Unknown, new_labels, objects_of
from app.questions.reading import Limits, Reading, read_scene, together
from app.questions.several_rooms import several_rooms
from app.registry import Artifact
from app.scene.vocabulary import Vocabulary
from app.serving.admission import Ticket, in_thread
from app.serving.models import ServedModels
from app.serving.runtime import Runtime
from scene_client.schemas import MAX_BATCH, BatchAnswer, BatchRequest, SceneRequest, WhereRequest

RequestT = TypeVar("RequestT", bound=SceneRequest | WhereRequest)

_FULL = "the batch has reached SCENE_MAX_ANSWER_BYTES. Send this scene in another request"

# Text and fields of an answer, and the seconds that its scene waited and that the model computed.
_Computed: TypeAlias = tuple[bytes, Fields, float, float]

router = APIRouter(route_class=JSONRoute, generate_unique_id_function=operation_id)

# The service does not validate its own answers: validation takes as long as writing the JSON.
# The tests validate answers against the schemas of the routes.


async def _answer(
    http: Request,
    question: Question[RequestT],
    scene: RequestT,
    models: ServedModels,  # the snapshot of the request
    look_ups: LookUps,  # shared by all scenes of the request
    most_bytes: int | None = None,
) -> bytes:
    """Ask the model in the field `model` of a scene one question. Return the answer as JSON.

    The answer has at most ``most_bytes`` bytes, by default the limit of the service.

    Raises:
        UnknownModelError: the model does not exist.
        ModelUnavailableError: the service refused to load the model.
        RequestError: the scene is invalid, or the answer would be too large.
        QueueFullError, DeadlinePassedError, DisconnectedError: see `admission`.
    """
    state = http.scope["state"]
    runtime: Runtime = http.scope["app"].state.runtime
    ticket: Ticket = state["ticket"]
    record: Record = state["record"]
    artifact = models.resolve(scene.model)
    record.models.add(artifact.key)
    admission = runtime.admission
    most = runtime.limits.answer_bytes if most_bytes is None else most_bytes
    read = partial(_read, question, scene, artifact, runtime.limits, look_ups)

    def compute(began: float, reading: Reading, ask: Callable[[], Fields]) -> _Computed:
        """Compute the answer and write it as JSON. Count the seconds that its scene waited."""
        fields = ask()
        seconds, waited = monotonic() - began, ticket.waited - (record.queue_seconds or 0.0)
        record.queue_seconds = ticket.waited
        record.compute_seconds = (record.compute_seconds or 0.0) + seconds
        answer = envelope(scene, state["request_id"], artifact.reference, reading) | fields
        answer["warnings"] = [*reading.warnings, *fields.get("warnings", ())]
        if (body := written_within(answer, most)) is None:
            raise _too_large(question, most)
        return body, answer, waited, seconds

    is_fast = is_quick(scene, artifact.model.vocabulary)
    if question.samples:
        reading, ask = read() if is_fast else await admission.in_worker(ticket, lambda _: read())
        weight = ask.keywords["count"] * (ask.keywords["steps"] or STEPS)
        # The models of a client take turns, too.
        await ticket.enter(admission.draws, weight, line=(ticket.client, artifact.key))
        computed = await in_thread(
            lambda stop: compute(monotonic(), reading, partial(ask, stop=stop)),
            ticket,
            admission.drawing,
        )
    elif is_fast:
        ticket.check()
        computed = compute(monotonic(), *read())
        ticket.check()
    else:
        computed = await admission.in_worker(ticket, lambda _: compute(monotonic(), *read()))
    body, answer, waited, seconds = computed
    runtime.metrics.computed(
        artifact.key, question.name, waited, seconds, len(objects_of(scene)), answer
    )
    return body


def _read(
    question: Question[RequestT],
    request: RequestT,
    artifact: Artifact,
    limits: Limits,
    look_ups: LookUps,
) -> tuple[Reading, partial[Fields]]:
    """Return the scene as the model reads it, and the call that computes the answer.

    Of the rooms of a home, only the notes are in the reading.
    """
    model = artifact.model
    unknown = Unknown(model.vocabulary, request.unknown_labels, look_ups)
    read = partial(read_for, artifact=artifact, limits=limits, unknown=unknown)
    if question.rooms_of is None:
        reading = read(cast("SceneRequest", request), may_be_empty=question.samples)
        options: dict[str, Any] = {"scene": reading.scene, **question.read(request, model, reading)}
    else:
        rooms = [read(room, at=("rooms", k)) for k, room in enumerate(question.rooms_of(request))]
        names = [room.id for room in cast("WhereRequest", request).rooms]
        reading = together(dict(zip(names, rooms, strict=True)))
        options = question.read(request, model, rooms)
    words = list(unknown.words.values())
    enlarged = model.with_words(words) if words else model
    if question.rooms_of is None and not question.samples:
        reading.warnings += several_rooms(enlarged, reading.scene)
    return reading, partial(question.answer, enlarged, **options)


def read_for(
    scene: SceneRequest,
    artifact: Artifact,
    limits: Limits,
    unknown: Unknown,
    at: Location = (),  # of the scene in the request
    *,
    may_be_empty: bool = False,
) -> Reading:
    """Read a scene for a model.

    Raises:
        RequestError: the scene is invalid.
    """
    model = artifact.model
    try:
        return read_scene(
            scene,
            model.vocabulary,
            limits,
            unknown,
            roles=model.roles,
            spread=model.spread,
            stands=None if model.places is None else model.places.stands,
            profiles=artifact.manifest.vocabulary.profiles,
            decide=lambda words, *about: label_probabilities(model.with_words(words), *about),
            may_be_empty=may_be_empty or bool(at),
        )
    except RequestError as error:
        raise (error.below(at) if at else error) from None


def _too_large(question: Question[Any], most: int) -> AnswerTooLargeError:
    """Return the error for an answer of too many bytes. It names the parameter to lower."""
    fields = question.request.model_fields
    field = next(name for name in ("count", "top_k", "objects") if name in fields)
    message = (
        f"the answer would have more than {most} bytes, the limit of SCENE_MAX_ANSWER_BYTES here. "
        f"Lower `{field}`, send fewer objects, relations or scenes, or use shorter ids"
    )
    return AnswerTooLargeError([LocatedError((field,), message)])


QUICK_OBJECTS: Final = 32
QUICK_ENTRIES: Final = 256
QUICK_LABELS: Final = 2
QUICK_ROOMS: Final = 4
"""Largest scene, lists, number of new labels and rooms of a question that the event loop computes.

Such a question takes about 2 ms.
"""


def is_quick(request: SceneRequest | WhereRequest, vocabulary: Vocabulary) -> bool:
    """Return whether the event loop may compute a question about a scene or a home."""
    objects = objects_of(request)
    details = [one for one in objects if not isinstance(one, str)]
    several = sum(len(one.alternatives) for one in details)
    is_little = len(objects) <= QUICK_OBJECTS and several <= QUICK_OBJECTS
    if isinstance(request, WhereRequest):
        is_little &= len(request.rooms) <= QUICK_ROOMS
    is_little &= is_small(vars(request))
    return is_little and new_labels(request, objects, vocabulary) <= QUICK_LABELS


def is_small(scene: Mapping[str, Any]) -> bool:
    """Return whether the event loop may validate a scene or a home, given by its fields."""
    for name, value in scene.items():
        if isinstance(value, list):
            if name == "rooms":
                rooms = [room for room in value if isinstance(room, dict)]
                if len(value) > QUICK_ROOMS or not all(map(is_small, rooms)):
                    return False
            elif len(value) > (QUICK_OBJECTS if name == "objects" else QUICK_ENTRIES):
                return False
        elif name == "top_k" and isinstance(value, int) and value > QUICK_ENTRIES:
            return False
    return True


async def _answer_each(
    http: Request, batch: BatchRequest[RequestT], question: Question[RequestT]
) -> bytes:
    """Answer the scenes of a batch one by one. Return the JSON list of results and problems."""
    state = http.scope["state"]
    runtime: Runtime = http.scope["app"].state.runtime
    ticket, request_id, admission = state["ticket"], state["request_id"], runtime.admission
    models, look_ups, results = runtime.models, LookUps(), list[bytes]()
    # The rest is for the problems of the scenes that the batch does not answer.
    left_bytes = runtime.limits.answer_bytes // 16 * 15
    await ticket.enter(admission.slow, len(batch.scenes))
    for number, scene in enumerate(batch.scenes):
        try:
            if left_bytes <= 0:
                raise AnswerTooLargeError([LocatedError((), _FULL)])
            ticket.check()
            data = await _validated(scene, question, number, runtime, ticket)
            answer = await _answer(http, question, data, models, look_ups, left_bytes)
            outcome, result = SUCCESS, b'{"status":200,"result":%b}' % answer
        except Exception as error:  # noqa: BLE001 — any error fails only this scene
            outcome, result = _failed(error, number, scene, request_id)
        runtime.metrics.entry_answered(question.name, outcome)
        results.append(result)
        # After the first answer that is too large, the batch stops.
        left_bytes = 0 if outcome == AnswerTooLargeError.slug else left_bytes - len(result)
        await admission.quick.let_pass()
    return b'{"request_id":%b,"results":[%b]}' % (to_json(request_id), b",".join(results))


async def _validated(
    scene: Any, question: Question[RequestT], number: int, runtime: Runtime, ticket: Ticket
) -> RequestT:
    """Validate a scene of a batch. The worker thread validates large scenes."""
    at = "scenes", number
    validate = partial(validated, scene, question.request, runtime.limits, at=at)
    if not isinstance(scene, dict) or is_small(scene):
        return validate()
    return await runtime.admission.in_worker(ticket, lambda _: validate())


def _failed(error: Exception, number: int, scene: Any, request_id: str) -> tuple[str, bytes]:
    """Return the outcome of a failed scene, and its entry in the answer: status and problem."""
    if isinstance(error, RequestError):
        error.locate(scene, ("scenes", number))
    failure = from_exception(error, request_id)
    body = failure.describe(request_id).model_dump_json(exclude_none=True).encode()
    return failure.slug, b'{"status":%d,"problem":%b}' % (failure.status, body)


def _add_route(question: Question[Any]) -> None:
    """Add the route `POST /NAME` of a question, which answers one scene."""

    async def answer(data: Any, http: Request) -> bytes:
        models = http.scope["app"].state.runtime.models
        return await _answer(http, question, data, models, LookUps())

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
    """Add the route `POST /NAME/batch` of a question, which answers a list of scenes."""

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
