"""Answers of the questions as named tuples, with the indices of objects instead of their ids."""

from collections import namedtuple
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import lru_cache, partial
from importlib import import_module
from typing import Any

import pytest

from app import questions
from app.model import SceneModel
from app.questions.missing import more as more_instances
from app.questions.posterior import present
from app.scene import Scene

_entry = lru_cache(partial(namedtuple, "Entry"))


def _converted(part: Any, indices: dict[str, int]) -> Any:
    if isinstance(part, list):
        return tuple(_converted(entry, indices) for entry in part)
    if not isinstance(part, dict):
        return part
    values = (
        indices.get(value, value) if name in {"subject", "object"} else _converted(value, indices)
        for name, value in part.items()
    )
    return _entry(tuple(part))(*values)


def _question(function: Callable[..., Any], *path: str) -> Callable[..., Any]:
    def ask(artifact: SceneModel, scene: Scene, **options: Any) -> Any:
        answer = function(artifact, scene, **options)
        for name in path:
            answer = answer[name]
        return _converted(answer, {thing.id: k for k, thing in enumerate(scene.objects)})

    return ask


def _more(artifact: SceneModel, scene: Scene, **options: Any) -> Any:
    return more_instances(artifact, scene, present(scene, artifact.spec), **options)


def outliers(artifact: SceneModel, scene: Scene, **options: Any) -> Any:
    """Return the answer, with `log_odds` None for objects that are not judged."""
    answer = questions.outliers(artifact, scene, **options)
    for entry in answer["outliers"]:
        entry.setdefault("log_odds", None)
    return _converted(answer, {thing.id: k for k, thing in enumerate(scene.objects)})


# These functions return one list of an answer.
misplaced = _question(questions.misplaced)
missing = _question(questions.missing, "missing")
more = _question(_more)
relations = _question(questions.relations, "relations")
disagreements = _question(questions.relations, "disagreements")
rooms = _question(questions.rooms, "room_types")
generate = _question(questions.generate, "scenes")


@contextmanager
def without_minimums() -> Iterator[None]:
    """List also improbable placements, weak reasons and improbable expected relations."""
    with pytest.MonkeyPatch.context() as patch:
        for module, minimum in (
            ("relations", "EXPECTED"),
            ("missing", "LEAST_CHANGE"),
            ("rooms", "LEAST_CHANGE"),
            ("placements", "LEAST_SHARE"),
            ("placements", "LEAST_LIKELY"),
        ):
            patch.setattr(import_module(f"app.questions.{module}"), minimum, 0)
        yield
