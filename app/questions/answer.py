"""Parts of all answers: common fields, rounded numbers, reasons, ranking, and JSON.

The schemas of `scene_client.schemas` describe the answers. An answer contains its fields in the
order of the schema, without null fields. Answers are dictionaries, because pydantic objects would
take twice the time (docs/decisions/http.md).
"""

from typing import Any, Final, TypeAlias

import numpy as np
import orjson
from jaxtyping import Bool, Float, Int
from numpy.typing import NDArray
from pydantic_core import from_json, to_json, to_jsonable_python

from app.compiling import compiled
from app.questions.posterior import Present
from app.questions.reading import Decision, Reading
from app.scene.scene import Scene
from scene_client.schemas import ModelReference, SceneRequest, WhereRequest

Fields: TypeAlias = dict[str, Any]
"""Fields of an answer, or of a part of an answer."""

DIGITS: Final = 6  # significant digits of probabilities, log-odds and metres
# Doubles represent these powers of ten exactly. So an integer divided by such a power is the double
# that is nearest to the decimal number.
_POWERS: Final = np.array([10.0**power for power in range(23)])

REASONS: Final = 3  # maximum number of reasons for one entry of an answer

EXPLAINED: Final = 32
"""Maximum number of entries with reasons in an answer. The first entries have reasons."""

_PART: Final = 512  # number of entries that `written_within` writes in a step
_ROUNDING: Final = 1e-6  # a smaller change of log-odds is a rounding error


def envelope(
    request: SceneRequest | WhereRequest, request_id: str, model: ModelReference, reading: Reading
) -> Fields:
    """Return the fields that all answers share. `scene_client.schemas.Answer` describes them."""
    fields: Fields = {"model": model, "request_id": request_id}
    if request.frame_id is not None:
        fields["frame_id"] = request.frame_id
    if request.stamp is not None:
        fields["stamp"] = request.stamp
    fields["ignored"] = list(reading.unknown.ignored)
    fields["mapped"] = list(reading.unknown.mapped.values())
    fields["warnings"] = reading.warnings
    if reading.observed is not None:
        fields["observed_relations"] = reading.observed
    if reading.resolved:
        fields["resolved"] = [_resolved(one) for one in reading.resolved]
    return fields


def _resolved(decision: Decision) -> Fields:
    """Return the fields of `scene_client.schemas.Resolved`."""
    fields: Fields = {"object": decision.object}
    if decision.room is not None:
        fields["room"] = decision.room
    pairs = zip(decision.labels, decision.probabilities, strict=True)
    fields["labels"] = [{"label": x, "probability": rounded_number(p)} for x, p in pairs]
    return fields


def named(label: str, word: str | None) -> Fields:
    """Return the field `label`, and `listed_as` if the request has another word for the class."""
    return {"label": label} if word in {None, label} else {"label": label, "listed_as": word}


def reasons(
    scene: Scene,
    present: Present,
    change: Float[NDArray[np.floating[Any]], "N n"],
    rows: Int[NDArray[np.int64], "N"] | None = None,  # in the scene; None: they are absent
    *,
    least: float = 0.0,  # minimum absolute change
    scale: float = 1.0,  # slope of the calibration, so that changes are those of `log_odds`
) -> list[list[Fields]]:
    """Return the strongest reasons for the log-odds of each of N explained classes.

    A reason is a class of the scene and its change of these log-odds. The largest absolute changes
    come first. `scene_client.schemas.Because` defines the fields; the object is the first of its
    class.
    """
    columns, values = _strongest(change, np.zeros(0, np.int64) if rows is None else rows, REASONS)
    values = scale * values
    strong = np.abs(values) >= max(least, _ROUNDING)
    entries: list[list[Fields]] = [[] for _ in change]
    numbers, changes = present.first[columns[strong]].tolist(), significant(values[strong])
    for row, number, value in zip(strong.nonzero()[0].tolist(), numbers, changes, strict=True):
        entries[row].append({"object": scene.objects[number].id, "log_odds_change": value})
    return entries


def significant(numbers: Float[NDArray[np.floating[Any]], "n"]) -> list[float]:
    """Round numbers to `DIGITS` significant digits."""
    values = numbers.astype(np.float64)
    exact = _round_to_digits(values)  # in place, except very small and very large numbers
    rounded: list[float] = values.tolist()
    return rounded if exact else [rounded_number(value) for value in rounded]


def rounded_number(number: float) -> float:
    """Round one number to `DIGITS` significant digits. Use `significant` for many numbers."""
    return float(f"{number:.{DIGITS}g}")


def written_within(answer: Fields, most: int) -> bytes | None:
    """Return an answer as JSON, or None above ``most`` bytes.

    Parts are written first, so that an answer far too large never exists as a whole.
    """
    size = 0
    for entries in answer.values():
        if isinstance(entries, list) and len(entries) > _PART:
            for start in range(0, len(entries), _PART):
                size += len(written(entries[start : start + _PART])) - 1  # brackets, no comma
                if size > most:
                    return None
    body = written(answer)
    return body if len(body) <= most else None


def written(answer: Any) -> bytes:
    """Return an answer, or a container of answers, as JSON. Fields without a value are left out.

    Raises:
        ValueError: a number in the answer is not finite.
    """
    body = orjson.dumps(answer, default=lambda part: to_jsonable_python(part, exclude_none=True))
    if b"null" not in body:
        return body
    # A `null` in the fast conversion is NaN, infinity, a field without a value, or part of a name.
    # pydantic's slower conversion leaves out the fields, and writes NaN as `NaN`.
    body = to_json(answer, inf_nan_mode="constants", exclude_none=True)
    try:
        from_json(body, allow_inf_nan=False)
    except ValueError:
        raise ValueError("an answer contains a number that is not finite") from None
    return body


@compiled
def _strongest(
    change: Float[NDArray, "N n"],  # of the log-odds of each explained class by each class
    rows: Int[NDArray, " N"],
    count: int,
) -> tuple[Int[NDArray, "N k"], Float[NDArray, "N k"]]:
    """Return the indices and values of the k <= `count` largest absolute changes by other classes.

    `rows` has the index of each explained class in the scene; it is empty if they are absent.
    """
    N, n = change.shape
    most = min(count, n - (len(rows) > 0))
    columns, values = np.empty((N, most), np.int64), np.empty((N, most), np.float64)
    usable = np.ones(n, np.bool_)
    for c in range(N):
        if len(rows):  # without the class itself
            usable[rows[c]] = False
        indices = best(np.abs(change[c]), usable, most)
        if len(rows):
            usable[rows[c]] = True
        for k in range(most):
            columns[c, k], values[c, k] = indices[k], change[c, indices[k]]
    return columns, values


@compiled
def _round_to_digits(values: Float[NDArray, " n"]) -> bool:
    """Round float64 numbers to `DIGITS` significant digits in place.

    Numbers too small or too large for exact powers of ten stay unchanged; the result is then False.
    """
    exact = True
    for k in range(len(values)):
        size = np.abs(values[k])
        if 1e-16 < size < 1e5:
            # A number with d digits before the point keeps DIGITS - d decimal places.
            places = DIGITS - 1 - np.int64(np.floor(np.log10(size)))
            scale = _POWERS[places]
            values[k] = np.rint(values[k] * scale) / scale
        elif size != 0.0:
            exact = False
    return exact


@compiled
def best(
    values: Float[NDArray, " N"], usable: Bool[NDArray, " N"], count: int
) -> Int[NDArray, " k"]:
    """Return the indices of the k <= `count` largest usable values, largest first.

    Of equal values, the value with the lower index comes first. The time is O(N log count).
    """
    size, rest, capacity = 0, 0, min(count, len(values))
    # A heap of the best indices so far. Its root is the worst: the smallest value, and of equal
    # values the largest index.
    heap = np.empty(capacity, np.int64)
    while size < capacity and rest < len(values):
        if usable[rest]:
            heap[size] = rest
            size += 1
        rest += 1
    for node in range(size // 2 - 1, -1, -1):
        _sink(values, heap, size, node, heap[node])
    for index in range(rest, len(values)):
        if size and usable[index] and values[index] > values[heap[0]]:
            _sink(values, heap, size, 0, index)
    for last in range(size - 1, 0, -1):
        worst, moved = heap[0], heap[last]
        _sink(values, heap, last, 0, moved)
        heap[last] = worst
    return heap[:size]


@compiled
def _sink(
    values: Float[NDArray, " N"], heap: Int[NDArray, " k"], size: int, node: int, index: int
) -> None:
    """Replace a node of the heap by an index, and restore the heap order below the node."""
    value = values[index]
    while 2 * node + 1 < size:
        child = 2 * node + 1
        if child + 1 < size:
            left, right = heap[child], heap[child + 1]
            if values[right] < values[left] or (values[right] == values[left] and right > left):
                child += 1
        worse = heap[child]
        if not (values[worse] < value or (values[worse] == value and worse > index)):
            break
        heap[node] = worse
        node = child
    heap[node] = index
