"""The tasks of the evaluation. A task asks a model questions about scenes and returns metrics.

A task returns None if the model does not support it, or if the scenes lack the required data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from training.evaluation import count_task as counts
from training.evaluation import evidence_tasks as evidence
from training.evaluation import offset_task as offsets
from training.evaluation.asking import SENSITIVITIES
from training.evaluation.calibration_task import NAMES, calibration_task
from training.evaluation.everyday_task import LINES, everyday_task
from training.evaluation.generated_rooms_task import (
    FREE,
    REFUSED,
    ROOMS,
    SIZE,
    generated_rooms_task,
)
from training.evaluation.generation_task import generation_task
from training.evaluation.intruders import LAWS
from training.evaluation.missing_tasks import SIZES, missing_task, placed_task
from training.evaluation.model import Model
from training.evaluation.moved_task import METRICS, moved_task
from training.evaluation.outlier_tasks import LENGTHS, alarms_task, outliers_task
from training.evaluation.pair_task import pairs_task
from training.evaluation.relation_tasks import completion_task, placement_task, relations_task
from training.evaluation.room_task import FIGURES, LISTS, rooms_task
from training.evaluation.setting import Outcome, Setting


@dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
        words: name of the task in the tables of the command line.
        field: attribute of `Model` that answers the questions. "" means the whole model.
        ask: function that takes this attribute and the questions (`Setting`), and returns the
            metrics.
        shown: names of the metrics in Markdown tables. JSON files contain all metrics.
        card: names of the metrics in a model card.
        of_objects: True if the task uses only scenes with complete object lists.
    """

    words: str
    field: str
    ask: Callable[[Any, Setting], Outcome | None]
    shown: tuple[str, ...]
    card: tuple[str, ...]
    of_objects: bool

    def __call__(self, model: Model, setting: Setting) -> Outcome | None:
        """Return the metrics, or None if the task cannot be measured."""
        answers = getattr(model, self.field) if self.field else model
        setting = setting.complete if self.of_objects else setting
        if answers is None or (self.of_objects and not len(setting.scenes)):
            return None
        return self.ask(answers, setting)


def _task(
    words: str,
    field: str,
    ask: Callable[[Any, Setting], Outcome | None],
    shown: tuple[str, ...],
    card: tuple[str, ...] | None = None,
    *,
    of_objects: bool = True,
) -> Task:
    """Return a task. By default, tables and model cards have the same metrics."""
    return Task(words, field, ask, shown, shown if card is None else card, of_objects)


def _each(names: Iterable[str], kinds: Iterable[str]) -> tuple[str, ...]:
    """Return the metric names "name, kind" for all pairs of a name and a kind."""
    kinds = tuple(kinds)
    return tuple(f"{name}, {kind}" for name in names for kind in kinds)


_MRR = _each(("MRR",), SIZES)
_ROOMS = tuple(f"{figure}, {lists}" for lists in LISTS for figure in FIGURES)

TASKS: dict[str, Task] = {
    "T1a relations": _task(
        *("relations of a scene", "relations", relations_task),
        _each(("R-precision",), ("distinct classes", "instance counts")),
        of_objects=False,
    ),
    "T1 pairs": _task(
        *("relation of two objects", "", pairs_task),
        (
            *("accuracy", "log-loss", "accuracy, unseen pairs", "accuracy, rare classes"),
            "accuracy of ten, inside pairs",
        ),
        ("accuracy", "log-loss", "accuracy of ten, inside pairs"),
        of_objects=False,
    ),
    "T1 with evidence": _task(
        *("relations, with more evidence", "scene_model", evidence.relations_evidence_task),
        _each(("change of R-precision",), evidence.OF_RELATIONS),
        of_objects=False,
    ),
    "T1b completion": _task(
        *("remaining relations", "completion", completion_task), ("R-precision",), of_objects=False
    ),
    "T2 missing": _task(
        *("missing objects", "missing", missing_task),
        (*_MRR, *_each(_MRR, ("structure listed",))),
        (*_MRR, "top-1", "top-10"),
    ),
    "T2 with evidence": _task(
        *("missing object, with the room type", "scene_model", evidence.missing_evidence_task),
        _each(("change of MRR",), evidence.OF_OBJECTS),
    ),
    "T2-at missing at a place": _task(
        *("missing object at a place", "at_place", placed_task), ("MRR", "MRR, on-top"), ("MRR",)
    ),
    "Rooms": _task(
        *("room type", "rooms", rooms_task),
        (
            *_ROOMS,
            *(f"top-1, {lists}, profile named" for lists in LISTS),
            *_each(_ROOMS, ("real rooms",)),
        ),
        _ROOMS,
    ),
    "T3 outliers": _task("intruder", "", outliers_task, _each(("hit@1", "flagged"), LAWS)),
    "T3 alarms": _task(
        *("alarms in untouched parts", "flags", alarms_task),
        tuple(f"alarms, {name}, {n} classes" for n in LENGTHS for name in SENSITIVITIES),
    ),
    "T3b placement": _task(
        "false relation", "false_relations", placement_task, ("hit@1",), of_objects=False
    ),
    "T3c moved": _task("moved object", "misplaced", moved_task, METRICS, of_objects=False),
    "T4 generate": _task(
        *("generated scenes", "generate", generation_task),
        (
            "MMD², free",
            "MMD², given room types",
            "pair correlation, free",
            "marginal error, free",
            "copies of training scenes, free",
            "mirrored relations, free",
            "on-top cycles, free",
        ),
        ("MMD², free", "pair correlation, free"),
    ),
    "T4 rooms": _task(
        *("generated rooms", "scene_model", generated_rooms_task),
        (REFUSED, *_each((REFUSED,), ROOMS), *_each((SIZE,), (FREE, *ROOMS))),
        (REFUSED, *_each((SIZE,), (FREE,))),
    ),
    "Calibration": _task(
        *("calibration", "scene_model", calibration_task),
        _each(("ECE", "Brier skill"), NAMES),
        tuple(f"{figure}, {name}" for name in NAMES for figure in ("ECE", "Brier skill")),
        of_objects=False,
    ),
    "Everyday": _task("everyday facts", "scene_model", everyday_task, LINES, of_objects=False),
}


# The statistics depend only on the training scenes, not on the machine. They appear in model cards,
# but not in tables that compare machines.
STATISTICS: dict[str, Task] = {
    "Offsets": _task(
        *("offsets of placements", "scene_model", offsets.offsets_task),
        (),
        offsets.METRICS,
        of_objects=False,
    ),
    "Counts": _task("numbers of instances", "scene_model", counts.counts_task, (), counts.METRICS),
}

EVERY_TASK = TASKS | STATISTICS


def in_words(task: str) -> str:
    """Return the name of a task in tables for people. JSON files and manifests use the key."""
    return EVERY_TASK[task].words if task in EVERY_TASK else task


ONCE = ("Everyday",)
"""Tasks that do not depend on the held-out scenes. They are measured once, not per data source."""

WHOLE_SET = ("T4 generate", *ONCE)
"""Tasks that are measured on the scenes of all data sources together.

For all other tasks, the results on the data sources are pooled.
"""
