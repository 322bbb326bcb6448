"""The class `Question`: a function, its schemas and its examples."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from inspect import cleandoc, getdoc
from typing import Any, Final, Generic, TypeAlias, TypeVar

from app.model.scene_model import SceneModel
from app.questions.answer import Fields
from app.scene.scene import Scene
from scene_client import schemas

RequestT = TypeVar("RequestT", bound=schemas.SceneRequest | schemas.WhereRequest)

Options: TypeAlias = dict[str, Any]
"""Keyword arguments of the function of a question."""


@dataclass(frozen=True, slots=True)
class Example:
    """An example request for the documentation."""

    summary: str
    value: dict[str, Any]  # the request body
    problem: str | None = None  # slug of the problem in the response; None: a valid request


@dataclass(eq=False)
class Question(Generic[RequestT]):
    """One question about a scene. Routes, documentation, warm-up and metrics use this record.

    The name of the function ``answer`` is the name of the question. The function takes a model, a
    scene and keyword arguments. It returns the fields of the answer that are not common to all
    answers. ``read`` returns its keyword arguments for a request, or raises `RequestError`.
    ``rooms_of`` returns the scenes of a request about a home. ``read`` then gets a list of
    readings, and their scenes are keyword arguments.

    If the question ``samples`` scenes, the scene of a request may be empty, the request has a field
    ``count``, and ``answer`` has an argument ``stop``, a function that returns True after the end
    of the request. There is no route for batches.
    """

    answer: Callable[..., Fields]
    read: Callable[[RequestT, SceneModel, Any], Options]
    request: type[RequestT]
    response: type[schemas.Answer]
    examples: Mapping[str, Example]  # by name; the default model knows their labels
    example_answer: Fields  # with illustrative figures, without the common fields
    description: str  # of the route
    # Asks a model about scenes with all options that need kernels of their own.
    ask_all: Callable[[SceneModel, tuple[Scene, ...]], Iterable[Fields]] | None = None
    samples: bool = False
    rooms_of: Callable[[RequestT], list[schemas.SceneRequest]] | None = None

    def __post_init__(self) -> None:
        self.name = self.answer.__name__
        self.summary = getdoc(self.request) or ""
        self.description = cleandoc(self.description)

    def warm_up(self, model: SceneModel, scenes: tuple[Scene, ...]) -> Iterable[Fields]:
        """Ask a model about scenes, and return the answers. The first call compiles the kernels."""
        if self.ask_all is not None:
            return self.ask_all(model, scenes)
        return (self.answer(model, scene) for scene in scenes)


LABELS: Final[dict[str, Any]] = {"objects": ["bed", "nightstand", "lamp"]}
WITH_TOILET: Final[dict[str, Any]] = {"objects": [*LABELS["objects"], "toilet"]}
BEDROOM: Final[dict[str, Any]] = {
    "objects": [
        "bed",
        {"id": "nightstand_1", "label": "nightstand"},
        {"id": "lamp_1", "label": "lamp", "confidence": 0.92},
    ],
    "relations": [{"subject": "lamp_1", "relation": "on-top", "object": "nightstand_1"}],
    "room_type": "bedroom",
}
POSES: Final[dict[str, Any]] = {
    "objects": [
        {
            "id": "desk_1", "label": "desk", "position": {"x": 2.0, "y": 0.0, "z": 0.4},
            "size": {"x": 0.7, "y": 1.4, "z": 0.8},
        },
        {
            "id": "lamp_1", "label": "lamp", "position": {"x": 2.0, "y": 0.5, "z": 1.0},
            "size": {"x": 0.2, "y": 0.2, "z": 0.4},
        },
        {
            "id": "chair_1", "label": "chair", "position": {"x": 1.2, "y": 0.0, "z": 0.45},
            "size": {"x": 0.5, "y": 0.5, "z": 0.9},
            "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0},
        },
    ],
    "frame_id": "base_link", "stamp": {"sec": 12, "nanosec": 500000000},
}  # fmt: skip
_CAMERA: Final[dict[str, Any]] = {
    "objects": [
        {"label": "desk", "position": {"x": 0.0, "y": 0.6, "z": 2.0}},
        {"label": "keyboard", "position": {"x": 0.1, "y": 0.3, "z": 1.9}},
    ],
    "frame_id": "camera_color_optical_frame",
}
_MAP: Final[dict[str, Any]] = {
    **POSES,
    "frame_id": "map",
    "viewpoint": {"x": 0.0, "y": 0.0, "yaw": 0.0},
}
_Y_UP: Final[dict[str, Any]] = {
    "objects": [
        {"label": "desk", "position": [0.0, 0.0, -200.0], "size": [140.0, 80.0, 70.0]},
        {"label": "lamp", "position": [-50.0, 80.0, -200.0], "size": [20.0, 40.0, 20.0]},
    ],
    "up": "y",
    "units": "cm",
    "box_origin": "bottom",
}
SCENES: Final[dict[str, Example]] = {
    "labels": Example("labels only", LABELS),
    "relations": Example("ids, a confidence, a stated relation, the room type", BEDROOM),
    "poses": Example("poses; the service derives the relations", POSES),
    "camera": Example("poses in a camera's optical frame, without sizes", _CAMERA),
    "map": Example("poses in a map, seen from a viewpoint", _MAP),
    "conventions": Example("poses in other units, with another axis up", _Y_UP),
    "ignore": Example(
        "unknown labels are ignored",
        {"objects": ["bed", "nightstand", "flux capacitor"], "unknown_labels": "ignore"},
    ),
    "nearest": Example(
        "unknown labels are mapped to the nearest class, or ignored",
        {
            "objects": ["bed", "nigthstand", "a big lamp", "chair_12", "flux capacitor"],
            "unknown_labels": "nearest-or-ignore",
        },
    ),
    "by-meaning": Example(
        "labels without a class are read by their meaning",
        {"objects": ["sofa", "tv", "tractor", "nigthstand"], "unknown_labels": "by-meaning"},
    ),
    "training": Example(
        "a scene in the format of the training",
        {
            "scene_id": "bench-3",
            "objects": [
                {"id": 0, "label": "desk", "position": [2.0, 0.0, 0.4], "size": [0.7, 1.4, 0.8]},
                {"id": 1, "label": "lamp", "supported_by": 0},
            ],
            "relations": [[1, "on-top", 0]],
            "room_type": "office",
        },
    ),
}
"""Valid example requests for every question that needs a list of objects."""

REFUSED: Final[dict[str, Example]] = {
    "unknown-labels": Example(
        "a label that the model does not know", {"objects": ["bed", "nigthstand"]}, "unknown-labels"
    ),
    "contradictory-evidence": Example(
        "two relations that contradict each other",
        {
            "objects": ["bed", "lamp"],
            "relations": [
                {"subject": "lamp", "relation": "left", "object": "bed"},
                {"subject": "lamp", "relation": "right", "object": "bed"},
            ],
        },
        "contradictory-evidence",
    ),
    "model-not-found": Example(
        "a model that does not exist", {**LABELS, "model": "nobody@9.9.9"}, "model-not-found"
    ),
}
"""Invalid example requests for every question."""
