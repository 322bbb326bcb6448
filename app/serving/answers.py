"""What the models say, in the names of a request, as JSON has it.

The schemas of `app.schemas` describe these answers: fields in that order, and none that would be
null. They are made as plain dictionaries, since an answer holds a hundred parts, and to make and
write each as an object takes twice the time (docs/decisions/answers.md).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, TypeAlias

from pydantic_core import from_json, to_json

from app import reasoning
from app.schemas import ModelReference, SceneRequest
from app.serving.reading import Reading

Answer: TypeAlias = dict[str, Any]


def envelope(
    request: SceneRequest, request_id: str, model: ModelReference, reading: Reading
) -> Answer:
    """See `app.schemas.Answer`."""
    fields: Answer = {"model": model, "request_id": request_id}
    if request.frame_id is not None:
        fields["frame_id"] = request.frame_id
    if request.stamp is not None:
        fields["stamp"] = request.stamp
    fields["ignored"] = list(reading.ignored)
    if reading.observed is not None:
        fields["observed_relations"] = reading.observed
    return fields


def relations(
    envelope: Answer,
    found: Sequence[reasoning.RelationAnswer],
    disagreements: Sequence[reasoning.Disagreement],
    reading: Reading,
) -> Answer:
    """See `app.schemas.RelationsAnswer`."""
    ids = reading.ids
    envelope["relations"] = _scored(found, ids)
    envelope["disagreements"] = [
        {
            "subject": ids[entry.subject],
            "object": ids[entry.object],
            "observed": list(entry.observed),
            "expected": entry.expected,
            "probability": entry.probability,
            "observed_probability": entry.observed_probability,
        }
        for entry in disagreements
    ]
    return envelope


def missing(envelope: Answer, found: Sequence[reasoning.MissingAnswer], reading: Reading) -> Answer:
    """See `app.schemas.MissingAnswer`."""
    ids = reading.ids
    envelope["missing"] = [
        {
            "label": label,
            "probability": probability,
            "log_odds": log_odds,
            "placements": [_placement(place, ids) for place in placements],
            "because": _because(because, ids),
        }
        for label, probability, log_odds, placements, because in found
    ]
    return envelope


def outliers(
    envelope: Answer,
    found: Sequence[reasoning.OutlierAnswer],
    misplaced: Sequence[reasoning.MisplacedAnswer],
    reading: Reading,
) -> Answer:
    """See `app.schemas.OutliersAnswer`."""
    ids = reading.ids
    envelope["outliers"] = [
        {
            "object": ids[place],
            "label": label,
            "probability": probability,
            "log_odds": log_odds,
            "is_outlier": is_outlier,
            "because": _because(because, ids),
        }
        for place, label, probability, log_odds, is_outlier, because in found
    ]
    envelope["misplaced"] = _scored(misplaced, ids)
    return envelope


def generate(envelope: Answer, seed: int, drawn: Sequence[reasoning.GeneratedScene]) -> Answer:
    """See `app.schemas.GenerateAnswer`."""
    envelope["seed"] = seed
    envelope["scenes"] = [
        {
            "objects": scene.objects,
            "relations": [
                {"subject": subject, "relation": relation, "object": other}
                for subject, relation, other in scene.relations
            ],
            "log_score": scene.log_score,
            "context": scene.context,
        }
        for scene in drawn
    ]
    return envelope


def written(answer: Any) -> bytes:
    """An answer, or whatever holds some, as JSON.

    Raises:
        ValueError: a number in it is not finite.
    """
    body = to_json(answer, inf_nan_mode="constants", exclude_none=True)
    if b"NaN" in body or b"Infinity" in body:  # as a number, or as part of a name
        try:
            from_json(body, allow_inf_nan=False)
        except ValueError:
            raise ValueError("a number of an answer is not finite") from None
    return body


def _because(causes: Sequence[reasoning.Because], ids: Sequence[str]) -> list[Answer]:
    return [{"object": ids[place], "log_odds_change": change} for place, change in causes]


def _scored(
    found: Sequence[reasoning.RelationAnswer | reasoning.MisplacedAnswer], ids: Sequence[str]
) -> list[Answer]:
    return [
        {"subject": ids[x], "relation": relation, "object": ids[y], "probability": probability}
        for x, relation, y, probability in found
    ]


def _placement(place: reasoning.Placement, ids: Sequence[str]) -> Answer:
    relation, object_, probability, offset = place
    entry: Answer = {"relation": relation, "object": ids[object_], "probability": probability}
    if offset is not None:
        (x, y, z), (u, v, w), scenes = offset
        mean, std = {"x": x, "y": y, "z": z}, {"x": u, "y": v, "z": w}
        entry["offset"] = {"mean": mean, "std": std, "scenes": scenes}
    return entry
