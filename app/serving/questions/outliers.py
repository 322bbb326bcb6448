"""The route of the question `outliers`."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

from app import questions
from app.questions.ranking import significant
from app.registry import Artifact, Calibration
from app.scene.relations import CANONICAL, opposite
from app.scene.scene import Scene
from app.serving import answers
from app.serving.questions.question import REFUSED, SCENES, WITH_TOILET, Example, Question
from app.serving.reading import Reading
from app.serving.request import Request
from scene_client.schemas import OutliersAnswer, OutliersRequest, SceneWarning


async def outliers(request: Request, asked: OutliersRequest) -> answers.Answer:
    """Return probabilities that each object is an outlier and that each observed relation is false.

    The list `outliers` starts with the most probable outlier. All instances of a class have the
    same probability. The list `misplaced` starts with the relation that is most probably false.
    """
    model, reading = await request.read(asked)
    found = await request.ask(
        model,
        "outliers",
        questions.outliers,
        reading.scene,
        sensitivity=asked.sensitivity,
        threshold=asked.threshold,
        details=asked.detail == "full",
    )
    answers.require_size(_size(found), reading, request.limits.answer_bytes, "objects")
    answer = answers.envelope(asked, request.id, model.reference, reading)
    ids = reading.ids
    if unjudged := _unjudged(model.artifact.calibration, reading.scene):
        answer["warnings"] = [*reading.warnings, *unjudged]
    if found.threshold is not None:
        answer["threshold"] = answers.rounded(found.threshold)
    numbers: list[float] = []
    for entry in found.outliers:
        numbers += entry.probability, entry.log_odds
        numbers += [change for _, change in entry.because]
    numbers += [entry.probability for entry in found.misplaced]
    numbered = iter(significant(numbers))
    answer["outliers"] = []
    for place, label, _, _, is_outlier, because, usually_with in found.outliers:
        judged = {
            "object": ids[place],
            "label": label,
            "probability": next(numbered),
            "log_odds": next(numbered),
            "is_outlier": is_outlier,
        }
        if asked.detail == "full":
            judged["because"] = answers.reasons(because, ids, numbered)
            judged["usually_with"] = list(usually_with)
        answer["outliers"].append(judged)
    answer["misplaced"] = [
        {
            **_spelled(entry.subject, entry.relation, entry.object, reading),
            "probability": next(numbered),
            "is_misplaced": entry.is_misplaced,
        }
        for entry in found.misplaced
    ]
    return answer


def _size(found: questions.OutliersFound) -> Callable[[int], int]:
    causes = 0
    for entry in found.outliers:
        causes += len(entry.because) + len(entry.usually_with)
    judged, misplaced = len(found.outliers), len(found.misplaced)
    fixed = (
        judged * answers.OBJECT_BYTES
        + causes * answers.CAUSE_BYTES
        + misplaced * answers.RELATION_BYTES
    )
    return lambda name: fixed + (2 * judged + causes + 2 * misplaced) * name


def _spelled(subject: int, relation: str, object_: int, reading: Reading) -> answers.Answer:
    """Convert a canonical relation to the name, subject and object that the request uses."""
    ids = reading.ids
    if (CANONICAL.index(relation), subject, object_) in reading.flipped:
        subject, relation, object_ = object_, opposite(relation), subject
    return {"subject": ids[subject], "relation": relation, "object": ids[object_]}


def _unjudged(calibration: Calibration, scene: Scene) -> list[SceneWarning]:
    """Return a warning for objects, and one for relations, if the model gives no judgement."""
    parts = {
        "objects": bool(scene.objects) and calibration.outlier is None,
        "relations": bool(scene.relations) and calibration.misplaced is None,
    }
    return [
        SceneWarning(
            code="not-judged",
            message=f"the model does not judge {part}, because its calibration had too few scenes",
            objects=[],
        )
        for part, is_unjudged in parts.items()
        if is_unjudged
    ]


def _warm_up(artifact: Artifact, scenes: tuple[Scene, ...]) -> list[float]:
    # With threshold 0, every object is an outlier. So the function also computes `usually_with`.
    _, found, misplaced = questions.outliers(artifact, scenes[0], threshold=0.0)
    for scene in scenes[1:]:
        found += questions.outliers(artifact, scene).outliers
    numbers = [number for entry in found for number in (entry.probability, entry.log_odds)]
    return numbers + [entry.probability for entry in misplaced]


_EXAMPLES: Final = {
    "intruder": Example("a toilet in a bedroom", WITH_TOILET),
    **SCENES,
    "misplaced": Example(
        "relations that the request states, as arrays, and that may be wrong",
        {
            "objects": ["bed", "pillow", "nightstand"],
            "relations": [["pillow", "on-top", "bed"], ["bed", "on-top", "nightstand"]],
        },
    ),
    "sensitivity": Example(
        "high sensitivity: a lower threshold",
        {**WITH_TOILET, "sensitivity": "high"},
    ),
    "threshold": Example(
        "a threshold set by the client",
        {**WITH_TOILET, "threshold": 0.5},
    ),
    "scores": Example(
        "probabilities only, for a fast and short answer",
        {**WITH_TOILET, "detail": "scores"},
    ),
    **REFUSED,
}
_EXAMPLE_ANSWER: Final = {
    "threshold": 0.7,
    "outliers": [
        {
            "object": "toilet",
            "label": "toilet",
            "probability": 0.94,
            "log_odds": -5.2,
            "is_outlier": True,
            "because": [{"object": "bed", "log_odds_change": -2.7}],
            "usually_with": ["toilet paper", "sink", "faucet"],
        },
        {
            "object": "bed",
            "label": "bed",
            "probability": 0.03,
            "log_odds": 2.4,
            "is_outlier": False,
            "because": [{"object": "lamp_1", "log_odds_change": 0.9}],
            "usually_with": [],
        },
    ],
    "misplaced": [
        {
            "subject": "lamp_1",
            "relation": "on-top",
            "object": "nightstand_1",
            "probability": 0.05,
            "is_misplaced": False,
        }
    ],
}

OUTLIERS: Final = Question(
    outliers,
    _warm_up,
    OutliersRequest,
    OutliersAnswer,
    _EXAMPLES,
    _EXAMPLE_ANSWER,
)
