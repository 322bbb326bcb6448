"""The tasks of the evaluation. A task asks a model questions about scenes and returns metrics.

A task returns None if the model does not support it, or if the scenes lack the required data.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

from training.evaluation.asking import SENSITIVITIES
from training.evaluation.calibration_task import NAMES, calibration_task
from training.evaluation.everyday_task import LINES, everyday_task
from training.evaluation.generation_task import (
    FREE,
    REFUSED,
    ROOMS,
    SIZE,
    generated_rooms_task,
    generation_task,
)
from training.evaluation.object_tasks import (
    FIGURES,
    LISTS,
    OF_OBJECTS,
    SIZES,
    missing_evidence_task,
    missing_task,
    placed_task,
    rooms_task,
)
from training.evaluation.outlier_tasks import (
    LAWS,
    LENGTHS,
    MOVED,
    alarms_task,
    moved_task,
    outliers_task,
)
from training.evaluation.pair_task import pairs_task
from training.evaluation.relation_tasks import (
    OF_RELATIONS,
    completion_task,
    placement_task,
    relations_evidence_task,
    relations_task,
)
from training.evaluation.setting import Model, Outcome, Setting
from training.evaluation.statistics_tasks import COUNTS, OFFSETS, counts_task, offsets_task
from training.evaluation.where_task import RIVALS, WHERE, where_task


@dataclass(frozen=True)
class Task:
    """One task."""

    words: str  # name of the task in the tables of the command line
    ask: Callable[[Any, Setting], Outcome | None]  # function of `field` and the questions
    field: str  # attribute of `Model` that answers the questions. "" means the whole model
    card: tuple[str, ...]  # metrics in a model card
    tables: tuple[str, ...] | None = None  # metrics in Markdown tables; None means those of a card
    of_objects: bool = True  # True if the task uses only scenes with complete object lists

    @property
    def shown(self) -> tuple[str, ...]:
        """Names of the metrics in Markdown tables."""
        return self.card if self.tables is None else self.tables

    def __call__(self, model: Model, setting: Setting) -> Outcome | None:
        """Return the metrics, or None if the task cannot be measured."""
        answers = getattr(model, self.field) if self.field else model
        setting = setting.complete if self.of_objects else setting
        if answers is None or (self.of_objects and not len(setting.scenes)):
            return None
        return self.ask(answers, setting)


def _each(names: Iterable[str], kinds: Iterable[str]) -> tuple[str, ...]:
    """Return the metric names "name, kind" for all pairs of a name and a kind."""
    kinds = tuple(kinds)
    return tuple(f"{name}, {kind}" for name in names for kind in kinds)


_R_PRECISION = _each(["R-precision"], ["distinct classes", "instance counts"])
_PAIRS = ("accuracy", "log-loss", "accuracy of ten, inside pairs")
_PAIRS_SHOWN = (*_PAIRS[:2], *_each(["accuracy"], ["unseen pairs", "rare classes"]), _PAIRS[2])
_MRR = _each(["MRR"], SIZES)
_ROOMS = tuple(f"{figure}, {lists}" for lists in LISTS for figure in FIGURES)
_ROOMS_SHOWN = (
    *_ROOMS,
    *_each(_each(["top-1"], LISTS), ["profile named"]),
    *_each(_ROOMS, ["real rooms"]),
)
_ALARMS = tuple(f"alarms, {name}, {n} classes" for n in LENGTHS for name in SENSITIVITIES)

TASKS: dict[str, Task] = {
    "T1a relations": Task(
        "relations of a scene", relations_task, "relations", _R_PRECISION, of_objects=False
    ),
    "T1 pairs": Task(
        "relation of two objects", pairs_task, "", _PAIRS, _PAIRS_SHOWN, of_objects=False
    ),
    "T1 with evidence": Task(
        "relations, with more evidence",
        relations_evidence_task,
        "scene_model",
        card=_each(["change of R-precision"], OF_RELATIONS),
        of_objects=False,
    ),
    "T1b completion": Task(
        "remaining relations", completion_task, "completion", ("R-precision",), of_objects=False
    ),
    "T2 missing": Task(
        "missing objects",
        missing_task,
        "missing",
        card=(*_MRR, "top-1", "top-10"),
        tables=(*_MRR, *_each(_MRR, ["structure listed"])),
    ),
    "T2 with evidence": Task(
        "missing object, with the room type",
        missing_evidence_task,
        "scene_model",
        card=_each(["change of MRR"], OF_OBJECTS),
    ),
    "T2-at missing at a place": Task(
        "missing object at a place", placed_task, "at_place", ("MRR",), ("MRR", "MRR, on-top")
    ),
    "Rooms": Task("room type", rooms_task, "rooms", card=_ROOMS, tables=_ROOMS_SHOWN),
    "Where": Task("room of a thing", where_task, "scene_model", WHERE, (*WHERE, *RIVALS)),
    "T3 outliers": Task("intruder", outliers_task, "", _each(["hit@1", "flagged"], LAWS)),
    "T3 alarms": Task("alarms in untouched parts", alarms_task, "flags", card=_ALARMS),
    "T3b placement": Task(
        "false relation", placement_task, "false_relations", ("hit@1",), of_objects=False
    ),
    "T3c moved": Task("moved object", moved_task, "misplaced", MOVED, of_objects=False),
    "T4 generate": Task(
        "generated scenes",
        generation_task,
        "generate",
        card=("MMD², free", "pair correlation, free"),
        tables=(
            "MMD², free",
            "MMD², given room types",
            "pair correlation, free",
            "marginal error, free",
            "copies of training scenes, free",
            "mirrored relations, free",
            "on-top cycles, free",
        ),
    ),
    "T4 rooms": Task(
        "generated rooms",
        generated_rooms_task,
        "scene_model",
        card=(REFUSED, *_each([SIZE], [FREE])),
        tables=(REFUSED, *_each([REFUSED], ROOMS), *_each([SIZE], [FREE, *ROOMS])),
    ),
    "Calibration": Task(
        "calibration",
        calibration_task,
        "scene_model",
        card=tuple(f"{figure}, {name}" for name in NAMES for figure in ("ECE", "Brier skill")),
        tables=_each(["ECE", "Brier skill"], NAMES),
        of_objects=False,
    ),
    "Everyday": Task("everyday facts", everyday_task, "scene_model", LINES, of_objects=False),
}


# The statistics depend only on the training scenes, not on the machine. They appear in model cards,
# but not in tables that compare machines.
STATISTICS: dict[str, Task] = {
    "Offsets": Task(
        "offsets of placements", offsets_task, "scene_model", OFFSETS, tables=(), of_objects=False
    ),
    "Counts": Task("numbers of instances", counts_task, "scene_model", COUNTS, tables=()),
}

EVERY_TASK = TASKS | STATISTICS


def in_words(task: str) -> str:
    """Return the name of a task in tables for people. JSON files and manifests use the key."""
    return EVERY_TASK[task].words if task in EVERY_TASK else task


ONCE = ("Everyday",)
"""Tasks that do not depend on the held-out scenes. They are measured once, not per data source."""

WHOLE_SET = ("T4 generate", *ONCE)
"""Tasks on the scenes of all data sources together. Results of all other tasks are pooled."""
