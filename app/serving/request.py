"""A request in the serving layer: its deadline, its models, and its record for log and metrics."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Any, Final, TypeVar

from app.errors import ServiceError
from app.questions.answer import Fields, SizeLimit, envelope
from app.questions.names import LookUps
from app.questions.question import Question
from app.questions.reading import Limits, Reading, read_scene
from app.scene.scene import Scene
from app.serving.admission import Done, Ticket
from app.serving.metrics import Metrics
from app.serving.models import Key, ServedModel, ServedModels
from scene_client.schemas import SceneRequest

RequestT = TypeVar("RequestT", bound=SceneRequest)

SUCCESS: Final = "success"

MANY_OBJECTS: Final = 64
MANY_RELATIONS: Final = 256
"""Largest scene that the event loop reads without a look at its expected time.

To read such a scene takes about 1 ms: the service derives the relations from the poses.
"""


@dataclass(slots=True)
class Record:
    """Values of a request for log and metrics. The gateway reads these values after the response.

    Attributes:
        outcome: `SUCCESS`, or the slug (short name) of the problem type in the response.
        status: HTTP status of the response, or 0 before the response starts.
        models: pairs (name, version) of the models that the request used. A batch may use several
            models.
        queue_seconds: total time in seconds that the scenes of the request waited, or None if the
            request used no model.
        compute_seconds: total computation time of the models in seconds, or None if the request
            used no model.
        answered_at: time of the last answer of a model, as a value of `time.perf_counter`.
        serialise_seconds: time in seconds from the last answer of a model to the response.
    """

    outcome: str = SUCCESS
    status: int = 0
    models: set[Key] = field(default_factory=set)
    queue_seconds: float | None = None
    compute_seconds: float | None = None
    answered_at: float | None = None
    serialise_seconds: float | None = None

    def begin(self, status: int) -> None:
        """Record that the response starts."""
        self.status = status
        if self.answered_at is not None and status < 400:
            self.serialise_seconds = perf_counter() - self.answered_at

    def log_fields(self) -> dict[str, str | float]:
        """Return the fields for the access log line, with times in milliseconds.

        The dictionary contains the model only if the request used exactly one model.
        """
        entry: dict[str, str | float] = {"outcome": self.outcome}
        if len(self.models) == 1:
            ((entry["model"], entry["version"]),) = self.models
        if self.queue_seconds is not None:
            entry["queue_ms"] = round(self.queue_seconds * 1e3, 3)
        if self.compute_seconds is not None:
            entry["compute_ms"] = round(self.compute_seconds * 1e3, 3)
        return entry


@dataclass(slots=True)
class Request(Ticket):
    """One request. It uses the same snapshot of the models from beginning to end.

    Attributes:
        id: request id. Every answer contains it.
        models: snapshot of the models.
        limits: limits on the scenes and answers of the request.
        metrics: metrics of the service.
        record: values for the log and the metrics.
        holding: whether the request has already reserved rows (scenes) in the queues of the models.
        look_ups: searches for classes similar to unknown labels, shared by all scenes of the
            request.
    """

    id: str = ""
    models: ServedModels = field(kw_only=True)
    limits: Limits = field(kw_only=True)
    metrics: Metrics = field(kw_only=True)
    record: Record = field(default_factory=Record)
    holding: bool = False
    look_ups: LookUps = field(default_factory=LookUps)

    async def answer(self, question: Question[RequestT], scene: RequestT) -> Fields:
        """Ask the model in the field `model` of a scene one question.

        The answer has the fields of `scene_client.schemas.Answer` and of the question.

        Raises:
            UnknownModelError: the model does not exist.
            ModelUnavailableError: the service refused to load the model.
            RequestError: the scene is invalid, or the answer would be too large.
            QueueFullError, DeadlinePassedError, DisconnectedError: see `WorkQueue`.
        """
        model = self.models.resolve(scene.model)
        self.record.models.add(model.key)
        reading = await self._read(model, scene, may_be_empty=question.samples)
        options = question.read(scene, model.artifact, reading)
        limit = SizeLimit(reading, self.limits.answer_bytes)
        ask = partial(question.answer, model.artifact, reading.scene, **options, size_limit=limit)
        rows = options["count"] if question.samples else 1
        reserved = 0 if self.holding else rows
        model.queue.take(reserved)
        try:
            if question.samples:
                done = await model.queue.draw(lambda stop: ask(stop=stop), self)
            else:
                kind = _kind_of_cost(question.name, reading.scene, options)
                # The time for relations grows with the number of pairs of objects.
                size = (1 + len(reading.scene.objects)) ** 2
                done = await model.queue.run(ask, self, kind=kind, size=size)
        finally:
            model.queue.give_back(reserved)
        self._record(model, question.name, rows, done)
        answer = envelope(scene, self.id, model.reference, reading)
        warnings = [*reading.warnings, *done.result.pop("warnings", ())]
        return answer | done.result | {"warnings": warnings}

    async def _read(
        self, model: ServedModel, scene: SceneRequest, *, may_be_empty: bool
    ) -> Reading:
        """Return a scene converted for a model. The queue of the model reads large scenes."""
        arguments = scene, model.vocabulary, self.limits, self.look_ups
        artifact = model.artifact
        read = partial(
            read_scene,
            *arguments,
            roles=None if artifact.places is None else artifact.places.roles,
            profiles=artifact.manifest.vocabulary.profiles,
            may_be_empty=may_be_empty,
        )
        relations = len(scene.relations or ())
        if len(scene.objects) <= MANY_OBJECTS and relations <= MANY_RELATIONS:
            return read()
        posed = sum(
            not isinstance(thing, str) and thing.position is not None for thing in scene.objects
        )
        # The time for the relations from poses grows with the number of pairs of objects.
        size = len(scene.objects) + relations + posed**2
        kind = f"read {posed.bit_length()}"
        return (await model.queue.run(read, self, kind=kind, size=size)).result

    def _record(self, model: ServedModel, name: str, rows: int, done: Done[Any]) -> None:
        """Record the times of a computation, for log and metrics."""
        record = self.record
        record.queue_seconds = (record.queue_seconds or 0.0) + done.waited
        record.compute_seconds = (record.compute_seconds or 0.0) + done.computed
        record.answered_at = perf_counter()
        self.metrics.computed(model.key, name, rows, done.waited, done.computed)

    def with_answer_bytes(self, left: int) -> Request:
        """Return a copy of the request that limits the next answer to ``left`` bytes."""
        return replace(self, limits=replace(self.limits, answer_bytes=left))

    @contextmanager
    def for_batch(self, references: Sequence[str]) -> Iterator[Request]:
        """Reserve one row for each scene of a batch in its model's queue, until the block ends.

        ``references`` are the values of the field `model` of the scenes. An unusable model gets no
        rows: the answers to its scenes contain the error, and the other scenes are answered.

        Yields:
            A copy of the request that does not reserve further rows.

        Raises:
            QueueFullError: the queue of a model is full.
        """
        with ExitStack() as reservations:
            for reference, rows in Counter(references).items():
                try:
                    model = self.models.resolve(reference)
                except ServiceError:
                    continue
                model.queue.take(rows)
                reservations.callback(model.queue.give_back, rows)
            yield replace(self, holding=True)


def _kind_of_cost(name: str, scene: Scene, parameters: Mapping[str, object]) -> str:
    """Return the kind of a question, which is the key for its expected computation time.

    Questions of the same kind and with the same number of objects take a similar time. The key
    contains the orders of magnitude of the numbers of classes, related classes and related pairs
    in the scene, and of the question's options. A string option counts by its length.
    """
    classes = [thing.class_index for thing in scene.objects]
    orders = [len(set(classes)).bit_length(), 0, 0]
    if scene.relations:
        pairs = {(classes[subject], classes[object_]) for _, subject, object_ in scene.relations}
        related_classes = {index for pair in pairs for index in pair}
        orders[1:] = len(related_classes).bit_length(), len(pairs).bit_length()
    for value in parameters.values():
        if isinstance(value, int) and not isinstance(value, bool):
            value = value.bit_length()
        elif isinstance(value, float):
            value = round(value, 2)
        elif isinstance(value, Sized):
            value = len(value).bit_length()
        orders.append(value)  # type: ignore[arg-type]
    return f"{name} {orders}"
