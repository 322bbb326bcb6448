"""One request's view of the service: the set of models it started with, and the way to ask them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Concatenate, ParamSpec, TypeVar

from app.registry import Artifact
from app.scene.scene import Scene
from app.schemas import SceneRequest
from app.serving.models import ServedModel, ServedModels
from app.serving.reading import Limits, Reading, read_scene

P = ParamSpec("P")
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Session:
    """What one request sees from beginning to end, whatever is promoted or refreshed meanwhile.

    Attributes:
        models: the snapshot of models.
        limits: what one scene may hold.
        request_id: goes into every answer.
    """

    models: ServedModels
    limits: Limits
    request_id: str

    def read(
        self, request: SceneRequest, *, may_be_empty: bool = False
    ) -> tuple[ServedModel, Reading]:
        """The model a request names, and its scene in the classes of that model.

        Raises:
            UnknownModelError: no such model.
            ModelUnavailableError: the model was refused when it was loaded.
            RequestError: the scene does not fit; see `read_scene`.
        """
        model = self.models.resolve(request.model)
        return model, read_scene(request, model.vocabulary, self.limits, may_be_empty=may_be_empty)

    async def ask(
        self,
        model: ServedModel,
        question: Callable[Concatenate[Artifact, Scene, P], T],
        scene: Scene,
        *args: P.args,
        **kwargs: P.kwargs,
    ) -> T:
        """Put one question about one scene to one model.

        The only place where the service computes. Inference is cheaper than a hop to a thread, so
        it runs where it stands.
        """
        return question(model.artifact, scene, *args, **kwargs)

    def envelope(
        self, request: SceneRequest, model: ServedModel, reading: Reading
    ) -> dict[str, Any]:
        """The fields that every answer carries."""
        return {
            "model": model.reference,
            "request_id": self.request_id,
            "frame_id": request.frame_id,
            "stamp": request.stamp,
            "ignored": list(reading.ignored),
            "observed_relations": None if reading.observed is None else list(reading.observed),
        }
