"""Common fields of all answers, the limit on the size of an answer, and the conversion to JSON.

The schemas of `scene_client.schemas` describe the answers. An answer contains its fields in the
order of the schema, without null fields. Answers are dictionaries, because pydantic objects would
take twice the time (docs/decisions/http.md).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from typing import Any, Final, TypeAlias

import orjson
from pydantic_core import from_json, to_json, to_jsonable_python

from app import questions
from app.questions.ranking import DIGITS
from app.serving.errors import AnswerTooLargeError, Fault
from app.serving.reading import Reading
from scene_client.schemas import ModelReference, SceneRequest

Answer: TypeAlias = dict[str, Any]

# Upper bounds in bytes on the sizes of parts of an answer. Ids and labels are not included.
RELATION_BYTES: Final = 120
CAUSE_BYTES: Final = 60
OBJECT_BYTES: Final = 200  # one entry about one object
_ENVELOPE_BYTES: Final = 4096
_WARNING_BYTES: Final = 400
# Size in bytes of the longest id: 128 characters of at most four bytes, two quotes and a comma.
_LONGEST_NAME: Final = 4 * 128 + 3


def envelope(
    request: SceneRequest, request_id: str, model: ModelReference, reading: Reading
) -> Answer:
    """Return the fields that all answers share. `scene_client.schemas.Answer` describes them."""
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
    """Return the ignored labels, the mapped labels and the warnings of a scene."""
    return {
        "ignored": list(reading.unknown.ignored),
        "mapped": list(reading.unknown.mapped.values()),
        "warnings": reading.warnings,
    }


def reasons(
    causes: Sequence[questions.Because], ids: Sequence[str], numbered: Iterator[float]
) -> list[Answer]:
    """Return the reasons of one entry. The next values of `numbered` are the log-odds changes."""
    return [{"object": ids[place], "log_odds_change": next(numbered)} for place, _ in causes]


def rounded(number: float) -> float:
    """Round one number to `DIGITS` significant digits. Use `significant` for many numbers."""
    return float(f"{number:.{DIGITS}g}")


def require_size(size: Callable[[int], int], reading: Reading, limit: int, parameter: str) -> None:
    """Check that an answer will not be too large.

    Args:
        size: function that returns the size in bytes of the answer without its common fields. The
            argument of the function is the size in bytes of the longest id or label.
        reading: the scene of the request.
        limit: maximum size of the answer in bytes.
        parameter: name of the request's field that the client can lower for a smaller answer.

    Raises:
        AnswerTooLargeError: the answer would be larger than `limit`.
    """
    longest = max(_LONGEST_NAME, reading.unknown.vocabulary.longest_label + 1)
    if estimated_size(size, reading, longest) <= limit:
        return
    exact = estimated_size(size, reading, reading.longest_name())
    if exact > limit:
        message = (
            f"the answer could have {exact} bytes, but SCENE_MAX_ANSWER_BYTES allows only {limit} "
            f"bytes here. Lower `{parameter}`, send fewer objects, relations or scenes, or use "
            "shorter ids"
        )
        raise AnswerTooLargeError([Fault((parameter,), message)])


def estimated_size(size: Callable[[int], int], reading: Reading, name: int) -> int:
    """Return the size in bytes of a whole answer whose longest id or label has `name` bytes."""
    unknown = reading.unknown
    bare = _ENVELOPE_BYTES + size(name)
    if not (unknown.ignored or unknown.mapped or reading.observed or reading.warnings):
        return bare
    names = len(reading.ids) * len(reading.warnings)
    ignored = len(to_json(unknown.ignored))
    mapped = len(unknown.mapped) * _WARNING_BYTES
    observed = len(reading.observed or ()) * (RELATION_BYTES + 2 * name)
    return (
        bare + ignored + mapped + observed + len(reading.warnings) * _WARNING_BYTES + names * name
    )


def written(answer: Any) -> bytes:
    """Write an answer, or a container of answers, as JSON.

    Raises:
        ValueError: a number in the answer is not finite.
    """
    body = orjson.dumps(answer, default=_fields)
    if b"null" not in body:
        return body
    # orjson writes NaN, infinity and fields without a value as `null`. A name may also contain the
    # text "null". So convert the answer again, with a stricter function.
    body = to_json(answer, inf_nan_mode="constants", exclude_none=True)
    try:
        from_json(body, allow_inf_nan=False)
    except ValueError:
        raise ValueError("an answer contains a number that is not finite") from None
    return body


def _fields(part: Any) -> Any:
    return to_jsonable_python(part, exclude_none=True)
