"""A request in the serving layer: its deadline, its models, and its record for log and metrics."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from time import monotonic
from typing import Any, Final, TypeVar

from app.errors import AnswerTooLargeError, LocatedError
from app.questions.answer import Fields, envelope, written_within
from app.questions.generate import STEPS
from app.questions.names import LookUps, new_labels
from app.questions.question import Question
from app.questions.reading import Reading, read_scene
from app.registry import Artifact
from app.scene.vocabulary import Vocabulary
from app.serving.admission import Ticket, in_thread
from app.serving.models import Key, ServedModels
from app.serving.runtime import Runtime
from scene_client.schemas import SceneRequest

RequestT = TypeVar("RequestT", bound=SceneRequest)

SUCCESS: Final = "success"

# Text and fields of an answer, and the seconds that its scene waited and that the model computed.
_Computed = tuple[bytes, Fields, float, float]


@dataclass(slots=True)
class Record:
    """Values of a request for log and metrics. The gateway reads them after the response."""

    outcome: str = SUCCESS  # or the slug of the problem type in the response
    status: int = 0  # HTTP status; 0 before the response starts
    models: set[Key] = field(default_factory=set)  # models that the request used
    queue_seconds: float | None = None  # total time that scenes waited; None without a model
    compute_seconds: float | None = None  # total time that models computed; None without a model

    def log_fields(self) -> dict[str, str | float]:
        """Return the fields for the access log line, and the model if the request used only one."""
        entry: dict[str, str | float] = {"outcome": self.outcome}
        if len(self.models) == 1:
            ((entry["model"], entry["version"]),) = self.models
        if self.queue_seconds is not None:
            entry["queue_ms"] = round(self.queue_seconds * 1e3, 3)
        if self.compute_seconds is not None:
            entry["compute_ms"] = round(self.compute_seconds * 1e3, 3)
        return entry


@dataclass(slots=True)
class Request:
    """One request. It uses the same snapshot of the models from beginning to end."""

    id: str  # part of every answer
    ticket: Ticket
    record: Record
    runtime: Runtime
    models: ServedModels
    look_ups: LookUps = field(default_factory=LookUps)  # shared by all scenes of the request

    async def answer(
        self, question: Question[RequestT], scene: RequestT, most_bytes: int | None = None
    ) -> bytes:
        """Ask the model in the field `model` of a scene one question. Return the answer as JSON.

        The answer has at most ``most_bytes`` bytes, by default the limit of the service.

        Raises:
            UnknownModelError: the model does not exist.
            ModelUnavailableError: the service refused to load the model.
            RequestError: the scene is invalid, or the answer would be too large.
            QueueFullError, DeadlinePassedError, DisconnectedError: see `admission`.
        """
        artifact, record = self.models.resolve(scene.model), self.record
        record.models.add(artifact.key)
        admission, ticket = self.runtime.admission, self.ticket
        most = self.runtime.limits.answer_bytes if most_bytes is None else most_bytes

        def read(_: object) -> tuple[Reading, partial[Fields]]:
            return self._read(question, scene, artifact)

        def finish(reading: Reading, ask: Callable[[], Fields], began: float) -> _Computed:
            fields = ask()
            seconds, waited = monotonic() - began, ticket.waited - (record.queue_seconds or 0.0)
            record.queue_seconds = ticket.waited
            record.compute_seconds = (record.compute_seconds or 0.0) + seconds
            answer = envelope(scene, self.id, artifact.reference, reading) | fields
            answer["warnings"] = [*reading.warnings, *fields.get("warnings", ())]
            if (body := written_within(answer, most)) is None:
                raise _too_large(question, most)
            return body, answer, waited, seconds

        def compute(_: object) -> _Computed:
            began = monotonic()
            return finish(*read(None), began)

        is_fast = is_quick(scene, artifact.model.vocabulary)
        if question.samples:
            reading, ask = read(None) if is_fast else await admission.in_worker(ticket, read)
            weight = ask.keywords["count"] * (ask.keywords["steps"] or STEPS)
            # The models of a client take turns, too.
            await ticket.enter(admission.draws, weight, line=(ticket.client, artifact.key))
            computed = await in_thread(
                lambda stop: finish(reading, partial(ask, stop=stop), monotonic()),
                ticket,
                admission.drawing,
            )
        elif is_fast:
            ticket.check()
            computed = compute(None)
            ticket.check()
        else:
            computed = await admission.in_worker(ticket, compute)
        body, answer, waited, seconds = computed
        self.runtime.metrics.computed(
            artifact.key, question.name, waited, seconds, len(scene.objects), answer
        )
        return body

    def _read(
        self, question: Question[RequestT], scene: RequestT, artifact: Artifact
    ) -> tuple[Reading, partial[Fields]]:
        """Return the scene as the model reads it, and the call that computes the answer."""
        model = artifact.model
        reading = read_scene(
            scene,
            model.vocabulary,
            self.runtime.limits,
            self.look_ups,
            roles=None if model.places is None else model.places.roles,
            profiles=artifact.manifest.vocabulary.profiles,
            may_be_empty=question.samples,
        )
        options = question.read(scene, model, reading)
        words = list(reading.unknown.words.values())
        enlarged = model.with_words(words) if words else model
        return reading, partial(question.answer, enlarged, reading.scene, **options)


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
"""Largest scene, lists and number of new labels of a question that the event loop computes.

Such a question takes about 2 ms.
"""


def is_quick(scene: SceneRequest, vocabulary: Vocabulary) -> bool:
    """Return whether the event loop may compute a question about a scene."""
    return is_small(vars(scene)) and new_labels(scene, vocabulary) <= QUICK_LABELS


def is_small(scene: Mapping[str, Any]) -> bool:
    """Return whether the event loop may validate a scene, given by its fields."""
    for name, value in scene.items():
        if isinstance(value, list):
            if len(value) > (QUICK_OBJECTS if name == "objects" else QUICK_ENTRIES):
                return False
        elif name == "top_k" and isinstance(value, int) and value > QUICK_ENTRIES:
            return False
    return True
