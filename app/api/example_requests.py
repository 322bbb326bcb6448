"""Worked example requests for the documentation: every case of every route that takes a body.

They are asked of the service as they stand, by whoever presses a button in /docs and by the tests;
the default model knows the labels. An example names the problem that it meets, if any.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

from app.api import catalogue
from app.api.catalogue import ProblemType


@dataclass(frozen=True, slots=True)
class Example:
    """A request and its outcome.

    Attributes:
        summary: what it shows, for a list of them.
        value: the body.
        problem: why it is refused; None where it is answered.
    """

    summary: str
    value: dict[str, Any]
    problem: ProblemType | None = None

    def describe(self) -> dict[str, Any]:
        """The example as an Example Object of OpenAPI."""
        if self.problem is None:
            return {"summary": self.summary, "value": self.value}
        return {
            "summary": f"{self.summary}: {self.problem.status}",
            "description": f"Refused: {self.problem.title} (`{self.problem.uri}`).",
            "value": self.value,
        }


_LABELS: Final[dict[str, Any]] = {"objects": ["bed", "nightstand", "lamp"]}
_BEDROOM: Final[dict[str, Any]] = {
    "objects": [
        "bed",
        {"id": "nightstand_1", "label": "nightstand"},
        {"id": "lamp_1", "label": "lamp", "confidence": 0.92},
    ],
    "relations": [{"subject": "lamp_1", "relation": "on-top", "object": "nightstand_1"}],
    "room_type": "bedroom",
}
_POSES: Final[dict[str, Any]] = {
    "objects": [
        {
            "id": "desk_1",
            "label": "desk",
            "position": {"x": 2.0, "y": 0.0, "z": 0.4},
            "size": {"x": 0.7, "y": 1.4, "z": 0.8},
        },
        {
            "id": "lamp_1",
            "label": "lamp",
            "position": {"x": 2.0, "y": 0.5, "z": 1.0},
            "size": {"x": 0.2, "y": 0.2, "z": 0.4},
        },
        {
            "id": "chair_1",
            "label": "chair",
            "position": {"x": 1.2, "y": 0.0, "z": 0.45},
            "size": {"x": 0.5, "y": 0.5, "z": 0.9},
            "orientation": {"x": 0.0, "y": 0.0, "z": 1.0, "w": 0.0},
        },
    ],
    "frame_id": "base_link",
    "stamp": {"sec": 12, "nanosec": 500000000},
}
_CAMERA: Final[dict[str, Any]] = {
    "objects": [
        {"label": "desk", "position": {"x": 0.0, "y": 0.6, "z": 2.0}},
        {"label": "keyboard", "position": {"x": 0.1, "y": 0.3, "z": 1.9}},
    ],
    "frame_id": "camera_color_optical_frame",
}
_MAP: Final[dict[str, Any]] = {
    **_POSES,
    "frame_id": "map",
    "viewpoint": {"x": 0.0, "y": 0.0, "yaw": 0.0},
}
_IGNORED: Final[dict[str, Any]] = {
    "objects": ["bed", "nightstand", "flux capacitor"],
    "unknown_labels": "ignore",
}
_NEAREST: Final[dict[str, Any]] = {
    "objects": ["bed", "nigthstand", "big lamp"],
    "unknown_labels": "nearest",
}
_UNKNOWN: Final = Example(
    "a label that the model does not know",
    {"objects": ["bed", "nigthstand"]},
    catalogue.UNKNOWN_LABELS,
)
_CONTRADICTION: Final = Example(
    "a scene that contradicts itself",
    {
        "objects": ["bed", "lamp"],
        "relations": [
            {"subject": "lamp", "relation": "left", "object": "bed"},
            {"subject": "lamp", "relation": "right", "object": "bed"},
        ],
    },
    catalogue.CONTRADICTORY_EVIDENCE,
)
_NO_MODEL: Final = Example(
    "a model that is not there", {**_LABELS, "model": "nobody@9.9.9"}, catalogue.MODEL_NOT_FOUND
)
_SCENES: Final[dict[str, Example]] = {
    "labels": Example("labels alone", _LABELS),
    "relations": Example("ids, a confidence, a given relation, the room type", _BEDROOM),
    "poses": Example("poses, from which relations are derived", _POSES),
    "camera": Example("poses in a camera's optical frame, without sizes", _CAMERA),
    "map": Example("poses in a map, seen from a viewpoint", _MAP),
    "ignore": Example("without the labels that the model does not know", _IGNORED),
    "nearest": Example("unknown labels mapped to the nearest class", _NEAREST),
}
_REFUSED: Final[dict[str, Example]] = {
    "unknown-labels": _UNKNOWN,
    "contradictory-evidence": _CONTRADICTION,
    "model-not-found": _NO_MODEL,
}
_BATCH: Final[dict[str, Example]] = {
    "scenes": Example("two scenes", {"scenes": [_LABELS, _BEDROOM]}),
    "bad-entry": Example(
        "a bad scene spoils its own entry alone",
        {"scenes": [_LABELS | {"room_type": "bedroom"}, {"objects": ["desk", "nigthstand"]}]},
    ),
    "empty": Example("no scene at all", {"scenes": []}, catalogue.INVALID_REQUEST),
}

REQUESTS: Final[dict[str, dict[str, Example]]] = {
    "relations": {
        **_SCENES,
        "instances": Example(
            "two of a class, told apart by their ids",
            {"objects": ["chair", "chair", "desk"], "top_k": 10},
        ),
        "pairs": Example(
            "one ordered pair, all eight relations",
            {
                **_BEDROOM,
                "pairs": [{"subject": "lamp_1", "object": "bed"}],
                "include_opposites": True,
            },
        ),
        "likely": Example(
            "what is likelier than not, all unlisted relations known not to hold",
            {**_BEDROOM, "relations_complete": True, "min_probability": 0.5},
        ),
        **_REFUSED,
        "invalid-request": Example(
            "a pair that is not in the scene",
            {**_LABELS, "pairs": [{"subject": "lamp", "object": "desk"}]},
            catalogue.INVALID_REQUEST,
        ),
    },
    "missing": {
        **_SCENES,
        "at": Example(
            "what is missing from the desk?",
            {"objects": ["desk", "chair"], "at": {"relation": "on-top", "object": "desk"}},
        ),
        "coverage": Example(
            "the whole scene is listed: what is not listed is absent",
            {**_LABELS, "coverage": 1.0},
        ),
        "candidates": Example(
            "which of these is missing?",
            {**_LABELS, "candidates": ["pillow", "sink", "toilet"], "top_k": 3},
        ),
        **_REFUSED,
        "invalid-request": Example(
            "a place that is not in the scene",
            {**_LABELS, "at": {"relation": "on-top", "object": "desk"}},
            catalogue.INVALID_REQUEST,
        ),
    },
    "outliers": {
        "intruder": Example("a toilet in a bedroom", {"objects": [*_LABELS["objects"], "toilet"]}),
        **_SCENES,
        "misplaced": Example(
            "relations that may be wrong",
            {
                "objects": ["bed", "pillow", "nightstand"],
                "relations": [
                    {"subject": "pillow", "relation": "on-top", "object": "bed"},
                    {"subject": "bed", "relation": "on-top", "object": "nightstand"},
                ],
            },
        ),
        "sensitivity": Example(
            "alarms more readily",
            {"objects": [*_LABELS["objects"], "toilet"], "sensitivity": "high"},
        ),
        "threshold": Example(
            "a threshold of one's own",
            {"objects": [*_LABELS["objects"], "toilet"], "threshold": 0.5},
        ),
        **_REFUSED,
    },
    "generate": {
        "room": Example("a bedroom", {"room_type": "bedroom", "count": 2, "seed": 7}),
        "evidence": Example(
            "scenes that hold these objects and this relation",
            {**_BEDROOM, "count": 2, "seed": 7},
        ),
        "poses": Example("scenes around what the robot sees", {**_POSES, "seed": 7}),
        "context": Example(
            "hidden units held on, as GET /models/{name}/contexts shows them",
            {"context": {"h1": [0, 3]}, "seed": 7},
        ),
        "varied": Example(
            "longer and hotter chains: more varied scenes",
            {"objects": ["desk"], "steps": 100, "temperature": 1.5, "count": 4, "seed": 7},
        ),
        **_REFUSED,
    },
    "relations_batch": _BATCH,
    "missing_batch": _BATCH,
    "outliers_batch": _BATCH,
    "move_alias": {
        "promote": Example("to a version", {"model": "home@1.1.0"}),
        "guarded": Example(
            "only if it leads where it led when I looked",
            {"model": "home@1.1.0", "expected": "home@1.0.0"},
        ),
        "create": Example(
            "a new one, which must not exist", {"model": "home@1.0.0", "expected": None}
        ),
        "model-not-found": Example(
            "to a model that is not there", {"model": "nobody@9.9.9"}, catalogue.MODEL_NOT_FOUND
        ),
    },
}
