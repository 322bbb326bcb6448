"""One request's view of the service: the set of models it started with, and the way to ask them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence, Sized
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Concatenate, ParamSpec, TypeVar

from app.registry import Artifact
from app.scene.scene import Scene
from app.serving.errors import ServingError
from app.serving.metrics import Metrics
from app.serving.models import ServedModel, ServedModels
from app.serving.queue import Done, Ticket
from app.serving.reading import Limits, LookUps, Reading, check_scene, read_scene
from app.serving.record import RequestRecord
from scene_client.schemas import SceneRequest

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(slots=True)
class Session:
    """What one request sees from beginning to end, whatever is promoted or refreshed meanwhile.

    Made once for every request and never changed.

    Attributes:
        models: the snapshot of models.
        limits: what one scene may hold.
        request_id: goes into every answer.
        ticket: what the request may take.
        metrics: what the service counts.
        record: what is known about the request.
        holding: whether rows of the models' queues are held for it already.
        known: what `read` found, where several questions are asked about one scene.
        gives_way: its questions let those of others go first.
        look_ups: of labels that the models do not know.
    """

    models: ServedModels
    limits: Limits
    request_id: str
    ticket: Ticket
    metrics: Metrics
    record: RequestRecord
    holding: bool = False
    known: tuple[ServedModel, Reading] | None = None
    gives_way: bool = False
    look_ups: LookUps = field(default_factory=LookUps)

    def read(
        self, request: SceneRequest, *, may_be_empty: bool = False
    ) -> tuple[ServedModel, Reading]:
        """The model a request names, and its scene in the classes of that model.

        Raises:
            UnknownModelError: no such model.
            ModelUnavailableError: the model was refused when it was loaded.
            RequestError: the scene does not fit; see `read_scene`.
        """
        if self.known is not None:
            return self.known
        model = self.models.resolve(request.model)
        self.record.asked(model.reference)
        return model, read_scene(
            request, model.vocabulary, self.limits, self.look_ups, may_be_empty=may_be_empty
        )

    def check(self, request: SceneRequest) -> None:
        """Check a scene, which may be empty, without its poses.

        Raises:
            UnknownModelError, ModelUnavailableError, RequestError: see `read`.
        """
        model = self.models.resolve(request.model)
        check_scene(request, model.vocabulary, self.limits)

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
        # Pairs of objects are what the relation part is computed for, stated relations or not.
        size = (1 + len(scene.objects)) ** 2
        name = question.__name__
        kind = _kind_of_cost(name, scene, kwargs)
        rows = 0 if self.holding else 1
        self._take(model, rows)
        try:
            done = await model.queue.run(
                partial(question, model.artifact, scene, *args, **kwargs),
                self.ticket,
                kind=kind,
                size=size,
                gives_way=self.gives_way,
            )
        finally:
            self._give_back(model, rows)
        return self._noted(model, name, 1, done)

    async def draw(
        self, rows: int, model: ServedModel, name: str, draw: Callable[[Callable[[], bool]], T]
    ) -> T:
        """Let so many scenes be drawn, never where others would wait for it.

        Args:
            name: of the question.
            draw: the work; what it is given says whether nobody wants it any more.

        Raises:
            QueueFullError, DeadlinePassedError, DisconnectedError: see `WorkQueue`.
        """
        taken = 0 if self.holding else rows
        self._take(model, taken)
        try:
            done = await model.queue.draw(draw, self.ticket)
        finally:
            self._give_back(model, taken)
        return self._noted(model, name, rows, done)

    def _noted(self, model: ServedModel, name: str, rows: int, done: Done[T]) -> T:
        self.metrics.waited(model.reference, done.waited)
        self.metrics.computed(model.reference, name, rows, done.computed)
        self.record.waited(done.waited)
        self.record.computed(done.computed)
        return done.result

    def _take(self, model: ServedModel, rows: int) -> None:
        model.queue.take(rows)
        self.metrics.pending(model.reference, model.queue.rows)

    def _give_back(self, model: ServedModel, rows: int) -> None:
        model.queue.give_back(rows)
        self.metrics.pending(model.reference, model.queue.rows)

    def with_answer_bytes(self, left: int) -> Session:
        """The view whose next answer may have so many bytes."""
        return replace(self, limits=replace(self.limits, answer_bytes=left))

    @contextmanager
    def for_batch(self, references: Sequence[str]) -> Iterator[Session]:
        """The view of a batch, for whose scenes there is room in all the queues at once.

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
                self._take(model, rows)
                held.callback(self._give_back, model, rows)
            yield replace(self, holding=True)


def _kind_of_cost(name: str, scene: Scene, parameters: Mapping[str, object]) -> str:
    """The same for questions that cost alike, whatever the number of objects.

    Without it a costly question would be taken for a cheap one of that size: of the same number of
    objects, one class is cheap and thirty are not, and so are relations of one pair and of all.
    """
    of = [thing.class_index for thing in scene.objects]
    pairs = {(of[subject], of[object_]) for _, subject, object_ in scene.relations or ()}
    related = {end for pair in pairs for end in pair}
    orders = [len(found).bit_length() for found in (set(of), related, pairs)]
    asked = [f"{key}={_order(value)}" for key, value in parameters.items()]
    return " ".join((name, *map(str, orders), *asked))


def _order(value: object) -> object:
    """What a parameter's value may mean for the cost."""
    if isinstance(value, int) and not isinstance(value, bool):
        return value.bit_length()
    if isinstance(value, float):
        return round(value, 2)
    return len(value).bit_length() if isinstance(value, Sized) else value
