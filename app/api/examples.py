"""Example requests and answers of the HTTP operations, for the documentation.

The dictionaries map an operation id to its examples. The documentation page and the tests send the
example requests unchanged. Figures in the example answers are only illustrative. The module of each
question in `app.questions` contains the examples of this question.
"""

from collections.abc import Mapping
from typing import Any, Final

from app import __version__
from app.errors import UnknownLabelsError
from app.questions import QUESTIONS
from app.questions.question import Example

REQUEST_ID: Final = "0b0f5b1e-6b1f-4a52-9d5c-3f7a2f1f6c11"
_MODEL: Final = {
    "name": "home", "version": "1.0.0", "variant": "triway",
    "digest": "4e706b9f30e062589ec5cace2744da497a49f08f095626ee533c50f22dad94d4",
}  # fmt: skip
_LISTS: Final[dict[str, Any]] = {"ignored": [], "mapped": [], "warnings": []}
_ENVELOPE: Final = {"model": _MODEL, "request_id": REQUEST_ID, **_LISTS}

_VERSION: Final = {"version": "1.0.0", "status": "ready", "aliases": ["default"]} | {
    name: _MODEL[name] for name in ("variant", "digest")
}
_CAUSE: Final = {
    "reason": "checksum_mismatch",
    "detail": "model.safetensors does not match the manifest",
}
_PLAIN: Final = {"aliases": [], "structure": False, "anywhere": False, "hangs": False}
_BIN: Final = {
    **_PLAIN, "label": "garbage bin", "aliases": ["trash can"],
    "size": {"x": 0.3, "y": 0.3, "z": 0.5}, "parent": "container",
}  # fmt: skip
_REFUSED: Final = {"version": "1.1.0", "status": "refused", "aliases": [], **_CAUSE}
_FAILURE: Final = {"subject": "home@1.1.0", **_CAUSE}
_SUMMARY: Final = {"name": "home", "versions": [_REFUSED, _VERSION]}


def _batch(result: dict[str, Any]) -> dict[str, Any]:
    """Return the answer to a batch of two scenes: a result, and an unknown label."""
    (unknown,) = UnknownLabelsError.example
    error = unknown.model_copy(update={"pointer": f"#/scenes/1{unknown.pointer[1:]}"})
    problem = UnknownLabelsError(errors=[error]).describe(REQUEST_ID)
    failed = {"status": 422, "problem": problem.model_dump(mode="json", exclude_none=True)}
    return {"request_id": REQUEST_ID, "results": [{"status": 200, "result": result}, failed]}


def _batches(cases: Mapping[str, Example]) -> dict[str, Example]:
    """Return example batches from the example requests of a question."""
    valid = [case.value for case in cases.values() if case.problem is None]
    unknown = next(case.value for case in cases.values() if case.problem == "unknown-labels")
    return {
        "scenes": Example("two scenes", {"scenes": valid[:2]}),
        "bad-entry": Example(
            "an invalid scene, which does not affect the other scenes",
            {"scenes": [valid[0], unknown]},
        ),
        "empty": Example("an empty list of scenes", {"scenes": []}, "invalid-request"),
    }


REQUESTS: Final[dict[str, dict[str, Example]]] = {
    **{question.name: dict(question.examples) for question in QUESTIONS},
    **{
        f"{question.name}_batch": _batches(question.examples)
        for question in QUESTIONS
        if not question.samples
    },
    "confirm": {
        "bedroom": Example(
            "a bedroom in which everything is right",
            {"objects": ["bed", "lamp", "chair"], "room_type": "bedroom"},
        ),
        "unknown-labels": Example(
            "a label that the model does not know",
            {"objects": ["bed", "nigthstand"]},
            "unknown-labels",
        ),
    },
    "scenes": {
        "table": Example(
            "a table of detections",
            {"name": "detections.csv", "text": "label,x,y,z\ndesk,2.0,0.0,0.37\n"},
        ),
        "class-ids": Example(
            "boxes of a detector with class ids",
            {"name": "a.txt", "text": "56 0.5 0.5 0.2 0.4\n", "label_map": "coco80"},
        ),
        "unreadable-file": Example(
            "a file without a known format", {"name": "a.txt", "text": "{}"}, "unreadable-file"
        ),
    },
}
_OF_QUESTIONS: Final = {
    question.name: {**_ENVELOPE, **question.example_answer} for question in QUESTIONS
}
ANSWERS: Final[dict[str, dict[str, Any] | str]] = {
    **_OF_QUESTIONS,
    **{
        f"{question.name}_batch": _batch(_OF_QUESTIONS[question.name])
        for question in QUESTIONS
        if not question.samples
    },
    "confirm": {"request_id": REQUEST_ID, "scene_id": "2026-01-02T03-9f2c1e0a4b7d6c58"},
    "scenes": {
        "request_id": REQUEST_ID,
        "scenes": [{"name": "42", "scene": {"objects": [{"id": "desk_1", "label": "desk"}]}}],
        "notes": [{
            "scene": 0, "detection": 1, "reason": "no-label", "detail": "class '12' has no label",
        }],
    },
    "list_models": {
        "generation": "3f6d0f4be1a25c77", "models": [_SUMMARY],
        "aliases": {"default": "home@1.0.0"}, "failures": [_FAILURE],
    },
    "show_model": _SUMMARY,
    "show_version": _VERSION
    | {
        "name": "home", "created": "2026-01-02T03:04:05Z", "parameters": 136000,
        "metrics": [
            {"task": "T2", "source": "procthor", "metric": "MRR"}
            | {"value": 0.5, "low": 0.49, "high": 0.51, "n": 1000},
        ],
        "data": [
            {"source": "procthor", "scenes": 4936, "digest": _MODEL["digest"]}
            | {"terms": "Apache-2.0", "research_only": False},
        ],
        "terms": "Apache-2.0", "card": "# home 1.0.0\n",
    },
    "show_vocabulary": {
        "model": _MODEL,
        "objects": [
            _BIN,
            {**_PLAIN, "label": "container"},
            {**_PLAIN, "label": "floor", "structure": True},
        ],
        "relations": [
            *("left", "front", "on-top", "above", "inside"),
            *("right", "behind", "under", "below", "contains"),
        ],
        "room_types": ["bedroom", "garage"], "rare_room_types": ["garage"],
        "written_room_types": [], "profiles": ["sunrgbd", "procthor"],
        "examples": [{
            "name": "A bedroom",
            "scene": {
                "room_type": "bedroom",
                "objects": [{"label": "floor"}, {"label": "garbage bin"}],
            },
        }],
    },
    "show_word": {
        "model": _MODEL, "word": "trash can", "class": _BIN, "rule": "alias", "certain": True,
        "suggestions": [],
    },
    "health_live": {"status": "live", "version": __version__},
    "health_ready": {"status": "ready"},
    "show_metrics": (
        "# HELP scene_requests_total Requests answered\n"
        "# TYPE scene_requests_total counter\n"
        'scene_requests_total{method="POST",outcome="success",route="/missing"} 1027.0\n'
        'scene_requests_total{method="POST",outcome="unknown-labels",route="/missing"} 3.0\n'
    ),
}  # fmt: skip
