"""Answers of the questions as named tuples, in which objects are indices instead of ids."""

from __future__ import annotations

from collections import namedtuple
from functools import wraps
from typing import Any

from app import questions
from app.questions.counts import more as _more
from app.scene import Scene


def _tuples(part: Any, places: dict[str, int]) -> Any:
    """Replace dictionaries by named tuples, lists by tuples and ids of objects by indices."""
    if isinstance(part, list):
        return tuple(_tuples(entry, places) for entry in part)
    if not isinstance(part, dict):
        return part
    fields = {
        name: places.get(value, value) if name in ("subject", "object") else _tuples(value, places)
        for name, value in part.items()
    }
    if "relation" in fields and "probability" in fields and "observed" not in fields:
        fields.setdefault("offset", None)
    return namedtuple("Entry", fields)(**fields)


def _asked(question: Any) -> Any:
    @wraps(question)
    def ask(artifact: Any, scene: Scene, **parameters: Any) -> Any:
        places = {thing.id: k for k, thing in enumerate(scene.objects)}
        return _tuples(question(artifact, scene, **parameters), places)

    return ask


more, misplaced, everything_missing = map(_asked, (_more, questions.misplaced, questions.missing))
outliers, related, generated = map(
    _asked, (questions.outliers, questions.relations, questions.generate)
)


def missing(artifact: Any, scene: Scene, **parameters: Any) -> Any:
    """The list `missing` of the answer."""
    return everything_missing(artifact, scene, **parameters).missing


def relations(artifact: Any, scene: Scene, **parameters: Any) -> Any:
    """The lists `relations` and `disagreements` of the answer."""
    return tuple(related(artifact, scene, **parameters))


def generate(artifact: Any, scene: Scene, **parameters: Any) -> Any:
    """The list `scenes` of the answer."""
    return generated(artifact, scene, **parameters).scenes
