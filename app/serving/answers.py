"""What the models say, in the names of a request, as JSON has it.

The schemas of `scene_client.schemas` describe these answers: fields in that order, and none that
would be null. They are made as plain dictionaries, since an answer holds a hundred parts, and to
make and write each as an object takes twice the time (docs/decisions/http.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeAlias

import orjson
from pydantic_core import from_json, to_json, to_jsonable_python

from app import questions
from app.scene.relations import CANONICAL, canonicalise, opposite
from app.serving.errors import Fault, Reason, RequestError
from app.serving.reading import Reading
from app.serving.rounding import DIGITS, significant
from scene_client.schemas import ModelReference, SceneRequest

Answer: TypeAlias = dict[str, Any]

# Bytes of parts of an answer, names aside.
_ENVELOPE: Final = 4096
_RELATION: Final = 120  # beside its two names
_CAUSE: Final = 60
_OBJECT: Final = 200  # missing, or judged
_OFFSET: Final = 250
_WARNING: Final = 400
_UNIT: Final = 12  # the number of a hidden unit
# Of an id: 128 characters, the most that the contract allows, each of at most four bytes.
_LONGEST_NAME: Final = 4 * 128 + 3


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


def size_of_relations(
    found: Sequence[questions.RelationAnswer], disagreements: Sequence[questions.Disagreement]
) -> Callable[[int], int]:
    """Bytes of a `RelationsAnswer` without its envelope, by the bytes of the longest name."""
    entries = len(found) + 2 * len(disagreements)
    return lambda name: entries * (_RELATION + 2 * name)


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


def size_of_missing(found: Sequence[questions.MissingAnswer]) -> Callable[[int], int]:
    """Bytes of a `MissingAnswer`, as in `size_of_relations`."""
    places = causes = 0
    for entry in found:
        places += len(entry.placements)
        causes += len(entry.because)
    fixed = places * (_RELATION + _OFFSET) + causes * _CAUSE + len(found) * _OBJECT
    return lambda name: fixed + (places + causes + len(found)) * name


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


def size_of_outliers(found: questions.OutliersFound) -> Callable[[int], int]:
    """Bytes of an `OutliersAnswer`, as in `size_of_relations`."""
    causes = 0
    for entry in found.outliers:
        causes += len(entry.because) + len(entry.usually_with)
    judged, misplaced = len(found.outliers), len(found.misplaced)
    fixed = judged * _OBJECT + causes * _CAUSE + misplaced * _RELATION
    return lambda name: fixed + (2 * judged + causes + 2 * misplaced) * name


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


def size_of_generated(drawn: Sequence[questions.GeneratedScene]) -> Callable[[int], int]:
    """Bytes of a `GenerateAnswer`, as in `size_of_relations`."""
    objects = sum([len(scene.objects) for scene in drawn])
    relations = sum([len(scene.relations) for scene in drawn])
    units = sum([len(layer) for scene in drawn for layer in scene.context.values()])
    fixed = len(drawn) * _OBJECT + relations * _RELATION + units * _UNIT
    return lambda name: fixed + (objects + 2 * relations) * name


def require_size(size: Callable[[int], int], reading: Reading, limit: int, parameter: str) -> None:
    """Refuse an answer that would be too large.

    Args:
        size: bytes of it beside its envelope, by the bytes of the longest name.
        reading: of the scene that it is about.
        limit: bytes that it may have.
        parameter: what the client can lower.

    Raises:
        RequestError: it is too large.
    """
    longest = max(_LONGEST_NAME, reading.unknown.vocabulary.longest_label + 1)
    if estimated_size(size, reading, longest) <= limit:
        return
    exact = estimated_size(size, reading, reading.longest_name())
    if exact > limit:
        message = (
            f"the answer would take up to {exact} bytes, and {limit} are left of "
            f"SCENE_MAX_ANSWER_BYTES: lower `{parameter}`, send fewer objects, relations or "
            "scenes, or shorter ids"
        )
        raise RequestError(Reason.ANSWER_TOO_LARGE, [Fault((parameter,), message)])


def estimated_size(size: Callable[[int], int], reading: Reading, name: int) -> int:
    """Bytes of a whole answer whose longest name has so many."""
    unknown = reading.unknown
    bare = _ENVELOPE + size(name)
    if not (unknown.ignored or unknown.mapped or reading.observed or reading.warnings):
        return bare
    names = len(reading.ids) * len(reading.warnings)
    ignored = len(to_json(unknown.ignored))
    mapped = len(unknown.mapped) * _WARNING
    observed = len(reading.observed or ()) * (_RELATION + 2 * name)
    return bare + ignored + mapped + observed + len(reading.warnings) * _WARNING + names * name


def written(answer: Any) -> bytes:
    """An answer, or a container of answers, as JSON.

    Raises:
        ValueError: a number in it is not finite.
    """
    body = orjson.dumps(answer, default=_fields)
    if b"null" not in body:
        return body
    # A number that is not finite, a field without a value, or a part of a name.
    body = to_json(answer, inf_nan_mode="constants", exclude_none=True)
    try:
        from_json(body, allow_inf_nan=False)
    except ValueError:
        raise ValueError("a number of an answer is not finite") from None
    return body


def _fields(part: Any) -> Any:
    return to_jsonable_python(part, exclude_none=True)


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
