"""How many bytes an answer takes, estimated before it is built.

The estimates are upper bounds: entries have at most so many bytes beside the names in them, and no
name is longer than the longest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from pydantic_core import to_json

from app import reasoning
from app.serving.errors import Fault, Reason, RequestError
from app.serving.reading import Reading

_ENVELOPE: Final = 4096
_RELATION: Final = 120  # beside its two names
_CAUSE: Final = 60
_OBJECT: Final = 200  # missing, or judged
_OFFSET: Final = 250
_WARNING: Final = 400
_UNIT: Final = 12  # the number of a hidden unit


def of_relations(
    found: Sequence[reasoning.RelationAnswer],
    disagreements: Sequence[reasoning.Disagreement],
    reading: Reading,
) -> int:
    """Bytes of `scene_client.schemas.RelationsAnswer`."""
    entries = len(found) + 2 * len(disagreements)
    return _of_envelope(reading) + entries * (_RELATION + 2 * reading.longest_name)


def of_missing(found: Sequence[reasoning.MissingAnswer], reading: Reading) -> int:
    """Bytes of `scene_client.schemas.MissingAnswer`."""
    places = sum([len(entry.placements) for entry in found])
    causes = sum([len(entry.because) for entry in found])
    name = reading.longest_name
    each = places * (_RELATION + _OFFSET + name) + causes * (_CAUSE + name)
    return _of_envelope(reading) + len(found) * (_OBJECT + name) + each


def of_outliers(found: reasoning.OutliersFound, reading: Reading) -> int:
    """Bytes of `scene_client.schemas.OutliersAnswer`."""
    causes = sum([len(entry.because) + len(entry.usually_with) for entry in found.outliers])
    name = reading.longest_name
    judged = len(found.outliers) * (_OBJECT + 2 * name) + causes * (_CAUSE + name)
    return _of_envelope(reading) + judged + len(found.misplaced) * (_RELATION + 2 * name)


def of_generated(drawn: Sequence[reasoning.GeneratedScene], reading: Reading) -> int:
    """Bytes of `scene_client.schemas.GenerateAnswer`."""
    name = reading.unknown.vocabulary.longest_label
    objects = sum([len(scene.objects) for scene in drawn])
    relations = sum([len(scene.relations) for scene in drawn])
    units = sum([len(layer) for scene in drawn for layer in scene.context.values()])
    scenes = len(drawn) * _OBJECT + objects * name + relations * (_RELATION + 2 * name)
    return _of_envelope(reading) + scenes + units * _UNIT


def require(size: int, limit: int, parameter: str) -> None:
    """Refuse an answer that would be too large.

    Args:
        size: bytes of it.
        limit: bytes that it may have.
        parameter: what the client can lower.

    Raises:
        RequestError: it is too large.
    """
    if size > limit:
        message = (
            f"the answer would take up to {size} bytes, and {limit} are left of "
            f"SCENE_MAX_ANSWER_BYTES: lower `{parameter}`, send fewer objects, relations or "
            "scenes, or shorter ids"
        )
        raise RequestError(Reason.ANSWER_TOO_LARGE, [Fault((parameter,), message)])


def _of_envelope(reading: Reading) -> int:
    unknown = reading.unknown
    if not (unknown.ignored or unknown.mapped or reading.observed or reading.warnings):
        return _ENVELOPE
    name = reading.longest_name
    names = len(reading.ids) * len(reading.warnings)
    ignored = len(to_json(unknown.ignored))
    mapped = len(unknown.mapped) * _WARNING
    observed = len(reading.observed or ()) * (_RELATION + 2 * name)
    warnings = len(reading.warnings) * _WARNING + names * name
    return _ENVELOPE + ignored + mapped + observed + warnings
