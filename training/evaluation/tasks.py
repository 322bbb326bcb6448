"""The tasks of the evaluation. A task asks a model questions about scenes and returns metrics.

A task returns None if the model does not support it, or if the scenes lack the required data.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from training.evaluation import count_task as counts
from training.evaluation import offset_task as offsets
from training.evaluation.asking import SENSITIVITIES
from training.evaluation.calibration_task import NAMES, calibration_task
from training.evaluation.density_task import density_task
from training.evaluation.everyday_task import LINES, everyday_task
from training.evaluation.evidence_tasks import (
    OF_OBJECTS,
    OF_RELATIONS,
    missing_evidence_task,
    outliers_evidence_task,
    relations_evidence_task,
)
from training.evaluation.generation_task import generation_task
from training.evaluation.missing_tasks import SIZES, missing_task, placed_task, structure_task
from training.evaluation.model import Model
from training.evaluation.moved_task import METRICS, moved_task
from training.evaluation.outlier_tasks import LAWS, LENGTHS, alarms_task, outliers_task
from training.evaluation.pair_task import pairs_task
from training.evaluation.relation_tasks import completion_task, placement_task, relations_task
from training.evaluation.room_task import FIGURES, LISTS, rooms_task
from training.evaluation.setting import Outcome, Setting

Ask = Callable[[Model, Setting], Outcome | None]


@dataclass(frozen=True)
class Task:
    """One task.

    Attributes:
        words: name of the task in the tables of the command line.
        ask: function that takes the model (`Model`) and the questions (`Setting`), and returns
            the metrics.
        shown: names of the metrics in Markdown tables. JSON files contain all metrics.
        card: names of the metrics in a model card.
        of_objects: True if the task uses only scenes with complete object lists.
    """

    words: str
    ask: Ask
    shown: tuple[str, ...] = ()
    card: tuple[str, ...] = ()
    of_objects: bool = False

    def __call__(self, model: Model, setting: Setting) -> Outcome | None:
        """Return the metrics, or None if the task cannot be measured."""
        if self.of_objects:
            setting = setting.complete
            if not len(setting.scenes):
                return None
        return self.ask(model, setting)


def _objects(words: str, ask: Ask, shown: tuple[str, ...], card: tuple[str, ...] = ()) -> Task:
    return Task(words, ask, shown, card, of_objects=True)


def _carded(words: str, ask: Ask, names: tuple[str, ...], *, of_objects: bool = True) -> Task:
    """Return a task with the same metrics in tables and in a model card."""
    return Task(words, ask, names, names, of_objects)


def _each(names: tuple[str, ...], kinds: tuple[str, ...]) -> tuple[str, ...]:
    """Return the metric names "name, kind" for all pairs of a name and a kind."""
    return tuple(f"{name}, {kind}" for name in names for kind in kinds)


TASKS: dict[str, Task] = {
    "T1a relations": _carded(
        "relations of a scene",
        relations_task,
        ("R-precision, distinct classes", "R-precision, instance counts"),
        of_objects=False,
    ),
    "T1 pairs": Task(
        "relation of two objects",
        pairs_task,
        shown=(
            *("accuracy", "log-loss", "accuracy, unseen pairs", "accuracy, rare classes"),
            "accuracy of ten, inside pairs",
        ),
        card=("accuracy", "log-loss", "accuracy of ten, inside pairs"),
    ),
    "T1 with evidence": _carded(
        "relations, with more evidence",
        relations_evidence_task,
        _each(("change of R-precision",), OF_RELATIONS),
        of_objects=False,
    ),
    "T1b completion": _carded(
        "remaining relations", completion_task, ("R-precision",), of_objects=False
    ),
    "T2 missing": _objects(
        "missing objects",
        missing_task,
        (*_each(("MRR",), tuple(SIZES)), *(f"MRR, {size}, structure listed" for size in SIZES)),
        (*_each(("MRR",), tuple(SIZES)), "top-1", "top-10"),
    ),
    "Structure": _carded("floor, wall and ceiling listed", structure_task, ("change of p",)),
    "T2 with evidence": _carded(
        "missing object, with the room type",
        missing_evidence_task,
        _each(("change of MRR",), OF_OBJECTS),
    ),
    "T2-at missing at a place": _objects(
        "missing object at a place", placed_task, ("MRR", "MRR, on-top"), ("MRR",)
    ),
    "Rooms": _objects(
        "room type",
        rooms_task,
        (
            *(f"{figure}, {lists}" for lists in LISTS for figure in FIGURES),
            *(f"top-1, {lists}, profile named" for lists in LISTS),
            *(f"{figure}, {lists}, real rooms" for lists in LISTS for figure in FIGURES),
        ),
        tuple(f"{figure}, {lists}" for lists in LISTS for figure in FIGURES),
    ),
    "T3 outliers": _carded(
        "intruder", outliers_task, (*_each(("hit@1",), LAWS), *_each(("flagged",), LAWS))
    ),
    "T3 alarms": _carded(
        "alarms in untouched parts",
        alarms_task,
        tuple(f"alarms, {name}, {n} classes" for n in LENGTHS for name in SENSITIVITIES),
    ),
    "T3 with evidence": _carded(
        "intruder, with the room type",
        outliers_evidence_task,
        _each(("change of hit@1",), OF_OBJECTS),
    ),
    "T3b placement": _carded("false relation", placement_task, ("hit@1",), of_objects=False),
    "T3c moved": _carded("moved object", moved_task, METRICS, of_objects=False),
    "T4 generate": _objects(
        "generated scenes",
        generation_task,
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
    "Density": _objects(
        "density of scenes", density_task, ("gain over independent classes, upper log Z",)
    ),
    "Calibration": Task(
        "calibration",
        calibration_task,
        shown=_each(("ECE", "Brier skill"), NAMES),
        card=tuple(f"{figure}, {name}" for name in NAMES for figure in ("ECE", "Brier skill")),
    ),
    "Everyday": _carded("everyday facts", everyday_task, LINES, of_objects=False),
}


# The statistics depend only on the training scenes, not on the machine. They appear in model cards,
# but not in tables that compare machines.
STATISTICS: dict[str, Task] = {
    "Offsets": Task("offsets of placements", offsets.offsets_task, card=offsets.METRICS),
    "Counts": _objects("numbers of instances", counts.counts_task, (), counts.METRICS),
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
