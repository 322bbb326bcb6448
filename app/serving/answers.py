"""What the models say, in the names of a request, as JSON has it.

The schemas of `scene_client.schemas` describe these answers: fields in that order, and none that
would be null. They are made as plain dictionaries, since an answer holds a hundred parts, and to
make and write each as an object takes twice the time (docs/decisions/http.md).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, TypeAlias

from pydantic_core import from_json, to_json

from app import questions
from app.scene.relations import CANONICAL, canonicalise, opposite
from app.serving.reading import Reading
from app.serving.rounding import DIGITS, significant
from scene_client.schemas import ModelReference, SceneRequest

Answer: TypeAlias = dict[str, Any]


def envelope(
    request: SceneRequest, request_id: str, model: ModelReference, reading: Reading
) -> Answer:
    """See `scene_client.schemas.Answer`."""
    fields: Answer = {"model": model, "request_id": request_id}
    if request.frame_id is not None:
        fields["frame_id"] = request.frame_id
    if request.stamp is not None:
        fields["stamp"] = request.stamp
    fields |= scene_notes(reading)
    if reading.observed is not None:
        fields["observed_relations"] = reading.observed
    return fields


def scene_notes(reading: Reading) -> Answer:
    """What every answer says of how the scene was read."""
    return {
        "ignored": list(reading.unknown.ignored),
        "mapped": list(reading.unknown.mapped.values()),
        "warnings": reading.warnings,
    }


def relations(
    envelope: Answer,
    found: Sequence[questions.RelationAnswer],
    disagreements: Sequence[questions.Disagreement],
    reading: Reading,
    *,
    min_probability: float,
) -> Answer:
    """See `scene_client.schemas.RelationsAnswer`; what is less likely when rounded is left out."""
    ids = reading.ids
    rounded = significant([entry.probability for entry in found])
    envelope["relations"] = [
        {
            "subject": ids[x],
            "relation": relation,
            "object": ids[y],
            "probability": probability,
            "observed": observed,
        }
        for (x, relation, y, _, observed), probability in zip(found, rounded, strict=True)
        if probability >= min_probability
    ]
    envelope["disagreements"] = [_disagreement(entry, reading) for entry in disagreements]
    return envelope


def missing(
    envelope: Answer,
    coverage: float,
    found: Sequence[questions.MissingAnswer],
    reading: Reading,
) -> Answer:
    """See `scene_client.schemas.MissingAnswer`."""
    ids = reading.ids
    envelope["coverage"] = coverage
    numbers: list[float] = []
    for _, probability, log_odds, placements, because in found:
        numbers += probability, log_odds
        for _, _, share, offset in placements:
            numbers.append(share)
            if offset is not None:
                numbers += offset[0]
                numbers += offset[1]
        numbers += [change for _, change in because]
    rounded = iter(significant(numbers))
    envelope["missing"] = [
        {
            "label": label,
            "probability": next(rounded),
            "log_odds": next(rounded),
            "placements": [_placement(place, ids, rounded) for place in placements],
            "because": _because(because, ids, rounded),
        }
        for label, _, _, placements, because in found
    ]
    return envelope


def outliers(envelope: Answer, found: questions.OutliersFound, reading: Reading) -> Answer:
    """See `scene_client.schemas.OutliersAnswer`."""
    ids = reading.ids
    envelope["threshold"] = float(f"{found.threshold:.{DIGITS}g}")
    numbers: list[float] = []
    for entry in found.outliers:
        numbers += entry.probability, entry.log_odds
        numbers += [change for _, change in entry.because]
    numbers += [entry.probability for entry in found.misplaced]
    rounded = iter(significant(numbers))
    envelope["outliers"] = [
        {
            "object": ids[place],
            "label": label,
            "probability": next(rounded),
            "log_odds": next(rounded),
            "is_outlier": is_outlier,
            "because": _because(because, ids, rounded),
            "usually_with": list(usually_with),
        }
        for place, label, _, _, is_outlier, because, usually_with in found.outliers
    ]
    envelope["misplaced"] = [
        {
            **_spelled(entry.subject, entry.relation, entry.object, reading),
            "probability": next(rounded),
            "is_misplaced": entry.is_misplaced,
        }
        for entry in found.misplaced
    ]
    return envelope


def generate(envelope: Answer, seed: int, drawn: Sequence[questions.GeneratedScene]) -> Answer:
    """See `scene_client.schemas.GenerateAnswer`."""
    envelope["seed"] = seed
    envelope["scenes"] = [
        {
            "objects": scene.objects,
            "relations": [
                {"subject": subject, "relation": relation, "object": other}
                for subject, relation, other in scene.relations
            ],
            "log_score": float(f"{scene.log_score:.{DIGITS}g}"),
            "context": scene.context,
        }
        for scene in drawn
    ]
    return envelope


def written(answer: Any) -> bytes:
    """An answer, or a container of answers, as JSON.

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


def _because(
    causes: Sequence[questions.Because], ids: Sequence[str], rounded: Iterator[float]
) -> list[Answer]:
    return [{"object": ids[place], "log_odds_change": next(rounded)} for place, _ in causes]


def _placement(place: questions.Placement, ids: Sequence[str], rounded: Iterator[float]) -> Answer:
    relation, object_, _, offset = place
    entry: Answer = {"relation": relation, "object": ids[object_], "probability": next(rounded)}
    if offset is not None:
        mean = {"x": next(rounded), "y": next(rounded), "z": next(rounded)}
        std = {"x": next(rounded), "y": next(rounded), "z": next(rounded)}
        entry["offset"] = {"mean": mean, "std": std, "scenes": offset.scenes}
    return entry


def _spelled(subject: int, relation: str, object_: int, reading: Reading) -> Answer:
    """A canonical relation as the request spelled it."""
    ids = reading.ids
    if (CANONICAL.index(relation), subject, object_) in reading.flipped:
        subject, relation, object_ = object_, opposite(relation), subject
    return {"subject": ids[subject], "relation": relation, "object": ids[object_]}


def _disagreement(entry: questions.Disagreement, reading: Reading) -> Answer:
    """A disagreement from the end that the request spelled its relation from."""
    subject, object_, observed, expected, probability, observed_probability = entry
    triples = {canonicalise(subject, relation, object_) for relation in observed}
    # Canonical triples of the pair from this end are flipped if the request spelled the other end.
    from_here = {(triple[1] == subject) != (triple in reading.flipped) for triple in triples}
    if from_here == {False} and reading.flipped:
        subject, object_ = object_, subject
        observed, expected = tuple(map(opposite, observed)), opposite(expected)
    ids = reading.ids
    return {
        "subject": ids[subject],
        "object": ids[object_],
        "observed": list(observed),
        "expected": expected,
        "probability": float(f"{probability:.{DIGITS}g}"),
        "observed_probability": float(f"{observed_probability:.{DIGITS}g}"),
    }
