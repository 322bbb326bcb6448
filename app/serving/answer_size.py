"""How many bytes an answer takes, estimated before it is built.

The estimates are upper bounds: entries have at most so many bytes beside the names in them, and no
name is longer than the longest.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Final

from pydantic_core import to_json

from app import questions
from app.serving.errors import Fault, Reason, RequestError
from app.serving.reading import Reading

_ENVELOPE: Final = 4096
_RELATION: Final = 120  # beside its two names
_CAUSE: Final = 60
_OBJECT: Final = 200  # missing, or judged
_OFFSET: Final = 250
_WARNING: Final = 400
_UNIT: Final = 12  # the number of a hidden unit
# Of an id: 128 characters, the most that the contract allows, each of at most four bytes.
_LONGEST_NAME: Final = 4 * 128 + 3


def of_relations(
    found: Sequence[questions.RelationAnswer], disagreements: Sequence[questions.Disagreement]
) -> Callable[[int], int]:
    """Bytes of a `RelationsAnswer` without its envelope, by the bytes of the longest name."""
    entries = len(found) + 2 * len(disagreements)
    return lambda name: entries * (_RELATION + 2 * name)


def of_missing(found: Sequence[questions.MissingAnswer]) -> Callable[[int], int]:
    """The same of a `MissingAnswer`."""
    places = causes = 0
    for entry in found:
        places += len(entry.placements)
        causes += len(entry.because)
    fixed = places * (_RELATION + _OFFSET) + causes * _CAUSE + len(found) * _OBJECT
    return lambda name: fixed + (places + causes + len(found)) * name


def of_outliers(found: questions.OutliersFound) -> Callable[[int], int]:
    """The same of an `OutliersAnswer`."""
    causes = 0
    for entry in found.outliers:
        causes += len(entry.because) + len(entry.usually_with)
    judged, misplaced = len(found.outliers), len(found.misplaced)
    fixed = judged * _OBJECT + causes * _CAUSE + misplaced * _RELATION
    return lambda name: fixed + (2 * judged + causes + 2 * misplaced) * name


def of_generated(drawn: Sequence[questions.GeneratedScene]) -> Callable[[int], int]:
    """The same of a `GenerateAnswer`."""
    objects = sum([len(scene.objects) for scene in drawn])
    relations = sum([len(scene.relations) for scene in drawn])
    units = sum([len(layer) for scene in drawn for layer in scene.context.values()])
    fixed = len(drawn) * _OBJECT + relations * _RELATION + units * _UNIT
    return lambda name: fixed + (objects + 2 * relations) * name


def require(size: Callable[[int], int], reading: Reading, limit: int, parameter: str) -> None:
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
    if estimate(size, reading, longest) <= limit:
        return
    exact = estimate(size, reading, reading.longest_name())
    if exact > limit:
        message = (
            f"the answer would take up to {exact} bytes, and {limit} are left of "
            f"SCENE_MAX_ANSWER_BYTES: lower `{parameter}`, send fewer objects, relations or "
            "scenes, or shorter ids"
        )
        raise RequestError(Reason.ANSWER_TOO_LARGE, [Fault((parameter,), message)])


def estimate(size: Callable[[int], int], reading: Reading, name: int) -> int:
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
