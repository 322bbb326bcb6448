"""What does not belong here, or stands in the wrong place?"""

from __future__ import annotations

from collections.abc import Callable

from app import questions
from app.questions.ranking import significant
from app.scene.relations import CANONICAL, opposite
from app.serving.answers import (
    CAUSE_BYTES,
    OBJECT_BYTES,
    RELATION_BYTES,
    Answer,
    envelope,
    reasons,
    require_size,
    rounded,
)
from app.serving.reading import Reading
from app.serving.request import Request
from scene_client.schemas import OutliersRequest


async def outliers(request: Request, asked: OutliersRequest) -> Answer:
    """See `scene_client.schemas.OutliersAnswer`."""
    model, reading = request.read(asked)
    found = await request.ask(
        model,
        questions.outliers,
        reading.scene,
        sensitivity=asked.sensitivity,
        threshold=asked.threshold,
    )
    require_size(_size(found), reading, request.limits.answer_bytes, "objects")
    answer = envelope(asked, request.id, model.reference, reading)
    ids = reading.ids
    answer["threshold"] = rounded(found.threshold)
    numbers: list[float] = []
    for entry in found.outliers:
        numbers += entry.probability, entry.log_odds
        numbers += [change for _, change in entry.because]
    numbers += [entry.probability for entry in found.misplaced]
    numbered = iter(significant(numbers))
    answer["outliers"] = [
        {
            "object": ids[place],
            "label": label,
            "probability": next(numbered),
            "log_odds": next(numbered),
            "is_outlier": is_outlier,
            "because": reasons(because, ids, numbered),
            "usually_with": list(usually_with),
        }
        for place, label, _, _, is_outlier, because, usually_with in found.outliers
    ]
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
    fixed = judged * OBJECT_BYTES + causes * CAUSE_BYTES + misplaced * RELATION_BYTES
    return lambda name: fixed + (2 * judged + causes + 2 * misplaced) * name


def _spelled(subject: int, relation: str, object_: int, reading: Reading) -> Answer:
    """A canonical relation as the request spelled it."""
    ids = reading.ids
    if (CANONICAL.index(relation), subject, object_) in reading.flipped:
        subject, relation, object_ = object_, opposite(relation), subject
    return {"subject": ids[subject], "relation": relation, "object": ids[object_]}
