"""One request: its deadline, the models that it sees, and what becomes known about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from time import perf_counter
from typing import Concatenate, Final, ParamSpec, TypeVar

from app.registry import Artifact
from app.scene.scene import Scene
from app.serving.admission import Done, Ticket
from app.serving.errors import ServingError
from app.serving.metrics import Metrics
from app.serving.models import Key, ServedModel, ServedModels
from app.serving.reading import Limits, LookUps, Reading, read_scene
from scene_client.schemas import SceneRequest

P = ParamSpec("P")
T = TypeVar("T")

SUCCESS: Final = "success"


@dataclass(slots=True)
class Record:
    """Values of a request for log and metrics, read when its response has been sent.

    Attributes:
        outcome: `SUCCESS`, or the name of the problem it was answered with.
        status: of its response; 0 before that begins.
        models: those it asked, by (name, version); a batch may ask several.
        queue_seconds: how long its scenes waited, together; None where none had to.
        compute_seconds: how long the models computed for it; None where none was asked.
        answered_at: `time.perf_counter` when the last answer of a model came.
        serialise_seconds: from the last answer of a model to the response.
        stream: of a stream its messages, answers, superseded updates and the code of its close.
    """

    outcome: str = SUCCESS
    status: int = 0
    models: set[Key] = field(default_factory=set)
    queue_seconds: float | None = None
    compute_seconds: float | None = None
    answered_at: float | None = None
    serialise_seconds: float | None = None
    stream: dict[str, int] | None = None

    def begin(self, status: int) -> None:
        """The response begins."""
        self.status = status
        if self.answered_at is not None and status < 400:
            self.serialise_seconds = perf_counter() - self.answered_at

    def known(self) -> dict[str, str | float]:
        """The record for a line of the log: times in milliseconds, the model if there is one."""
        entry: dict[str, str | float] = {"outcome": self.outcome, **(self.stream or {})}
        if len(self.models) == 1:
            ((entry["model"], entry["version"]),) = self.models
        if self.queue_seconds is not None:
            entry["queue_ms"] = round(self.queue_seconds * 1e3, 3)
        if self.compute_seconds is not None:
            entry["compute_ms"] = round(self.compute_seconds * 1e3, 3)
        return entry


@dataclass(slots=True)
class Request(Ticket):
    """One request, with one snapshot of the models from beginning to end.

    Attributes:
        id: goes into every answer.
        models: the snapshot of models.
        limits: of its scenes and answers.
        metrics: of the service.
        record: what becomes known about it.
        holding: whether rows of the models' queues are held for it already.
        known: what `read` found, where several questions are asked about one scene.
        low_priority: its questions run after those of other requests.
        look_ups: of labels that the models do not know.
    """

    id: str = ""
    models: ServedModels = field(kw_only=True)
    limits: Limits = field(kw_only=True)
    metrics: Metrics = field(kw_only=True)
    record: Record = field(default_factory=Record)
    holding: bool = False
    known: tuple[ServedModel, Reading] | None = None
    low_priority: bool = False
    look_ups: LookUps = field(default_factory=LookUps)

    def read(
        self, scene: SceneRequest, *, may_be_empty: bool = False
    ) -> tuple[ServedModel, Reading]:
        """The model that a scene names, and the scene in the classes of that model.

        Raises:
            UnknownModelError: no such model.
            ModelUnavailableError: the model was refused when it was loaded.
            RequestError: the scene does not fit; see `read_scene`.
        """
        if self.known is not None:
            return self.known
        model = self.models.resolve(scene.model)
        self.record.models.add(model.key)
        return model, read_scene(
            scene, model.vocabulary, self.limits, self.look_ups, may_be_empty=may_be_empty
        )

    async def ask(
        self,
        model: ServedModel,
        question: Callable[Concatenate[Artifact, Scene, P], T],
        scene: Scene,
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Put one question about one scene to one model.

        Raises:
            QueueFullError, DeadlinePassedError, DisconnectedError: see `WorkQueue`.
        """
        name = question.__name__
        call = partial(question, model.artifact, scene, *args, **kwargs)
        rows = 0 if self.holding else 1
        model.queue.take(rows)
        try:
            done = await model.queue.run(
                call,
                self,
                kind=_kind_of_cost(name, scene, kwargs),
                # The relation part is computed for pairs of objects.
                size=(1 + len(scene.objects)) ** 2,
                low_priority=self.low_priority,
            )
        finally:
            model.queue.give_back(rows)
        return self._noted(model, name, 1, done)

    async def draw(
        self, rows: int, model: ServedModel, name: str, draw: Callable[[Callable[[], bool]], T]
    ) -> T:
        """Draw so many scenes.

        Args:
            name: of the question.
            draw: the work; its argument says whether the result has been given up.

        Raises:
            QueueFullError, DeadlinePassedError, DisconnectedError: see `WorkQueue`.
        """
        taken = 0 if self.holding else rows
        model.queue.take(taken)
        try:
            done = await model.queue.draw(draw, self)
        finally:
            model.queue.give_back(taken)
        return self._noted(model, name, rows, done)

    def _noted(self, model: ServedModel, name: str, rows: int, done: Done[T]) -> T:
        record = self.record
        record.queue_seconds = (record.queue_seconds or 0.0) + done.waited
        record.compute_seconds = (record.compute_seconds or 0.0) + done.computed
        record.answered_at = perf_counter()
        self.metrics.computed(model.key, name, rows, done.waited, done.computed)
        return done.result

    def with_answer_bytes(self, left: int) -> Request:
        """The same request, whose next answer may have so many bytes."""
        return replace(self, limits=replace(self.limits, answer_bytes=left))

    @contextmanager
    def for_batch(self, references: Sequence[str]) -> Iterator[Request]:
        """The same request with room for all its scenes in the queues.

        Args:
            references: the models that its scenes name; those that lead nowhere take no room.

        Raises:
            QueueFullError: there is no room.
        """
        with ExitStack() as held:
            for reference, rows in Counter(references).items():
                try:
                    model = self.models.resolve(reference)
                except ServingError:
                    continue
                model.queue.take(rows)
                held.callback(model.queue.give_back, rows)
            yield replace(self, holding=True)


def _kind_of_cost(name: str, scene: Scene, parameters: Mapping[str, object]) -> str:
    """The same for questions of about one cost for any number of objects.

    The cost also depends on the number of classes, of related classes and of related pairs: one
    class is cheap and thirty are not, and so are relations of one pair and of all.
    """
    of = [thing.class_index for thing in scene.objects]
    orders = [len(set(of)).bit_length(), 0, 0]
    if scene.relations:
        pairs = {(of[subject], of[object_]) for _, subject, object_ in scene.relations}
        related = {end for pair in pairs for end in pair}
        orders[1:] = len(related).bit_length(), len(pairs).bit_length()
    for value in parameters.values():
        if isinstance(value, int) and not isinstance(value, bool):
            value = value.bit_length()
        elif isinstance(value, float):
            value = round(value, 2)
        elif isinstance(value, Sized):
            value = len(value).bit_length()
        orders.append(value)  # type: ignore[arg-type]
    return f"{name} {orders}"
