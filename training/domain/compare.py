"""`python -m training compare`: compare two models on scenes held out from both."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich import box
from rich.table import Table
from rich.text import Text
from torch import Tensor

from app.registry import DEFAULT_STORE, Metric, RegistryError, Store
from app.registry.summary import (
    judges_not,
    knows,
    lengths_of_lists,
    shares_of_alarms,
    trained_on,
    use,
)
from training.datasets import AnnotatedScene, DatasetError, annotated_classes, encode
from training.datasets.batches import SceneTensors, scene_tensors
from training.datasets.cases import some_scenes
from training.datasets.console import console, print_lines
from training.datasets.files import DATA
from training.domain.candidates import BASELINES, Candidate, find, held_out
from training.domain.terminal import StorePath, fail
from training.domain.translation import Translation, same_classes
from training.evaluation.metrics import Figure
from training.evaluation.outlier_tasks import LENGTHS
from training.evaluation.report import Progress, measure, silent
from training.evaluation.results import Difference, Results, only, summarise
from training.evaluation.setting import Model, Setting
from training.evaluation.tasks import in_words
from training.fit.configuration import ConfigError
from training.runs.folder import RunError
from training.runs.pipeline import read_sources, split_and_encode

ALARMS = "T3 alarms"

COMPARED: dict[str, tuple[str, ...]] = {
    "T2 missing": ("MRR, one removed", "MRR, 25 % shown", "top-1", "top-10"),
    "T2-at missing at a place": ("MRR",),
    "T3 outliers": ("hit@1, uniform", "hit@1, by popularity", "hit@1, signature"),
    "T1a relations": ("R-precision, instance counts", "R-precision, distinct classes"),
    "T1b completion": ("R-precision",),
    "T3b placement": ("hit@1",),
    ALARMS: tuple(f"alarms, medium, {n} classes" for n in LENGTHS if n > 1),
}
"""Metrics to compare, by task."""

PRIMARY = {task: names[0] for task, names in COMPARED.items() if task != ALARMS}
"""The metric of a task that can prevent a promotion; higher is better for all. `publish` limits the
alarms of a model by itself."""

MARGIN = 0.02  # accepted loss of a primary metric when a new version replaces the served version

RELATIONAL = ("T1a relations", "T1b completion", "T2-at missing at a place", "T3b placement")
"""Tasks that need scenes with relations."""

SCENES = 300  # maximum number of compared scenes

_COLOURS = {"better": "green", "worse": "red"}


@dataclass(frozen=True)
class Comparison:
    """Comparison of two models."""

    results: Results  # of both models; the first model is the reference `ours`
    b: str  # title of the second model
    scenes: int
    groups: int  # groups of near-duplicates among the compared scenes
    notes: tuple[str, ...]
    # Relation tasks on the card of the second model, if this comparison measures no relation task.
    unmeasured: tuple[str, ...] = ()
    about: tuple[str, ...] = ()  # sentences: data, knowledge, limits and use of the first model

    @property
    def a(self) -> str:
        """Title of the first model."""
        return self.results.ours

    def worse_by(self, margin: float) -> list[Difference]:
        """Return the primary metrics whose whole interval of the difference is below -margin."""
        rows = self.results.differences
        return [r for r in rows if PRIMARY.get(r.task) == r.metric and r.figure.high < -margin]

    def objections(self, margin: float) -> list[str]:
        """Return the reasons against a promotion of the first model."""
        a, b, reasons = self.a, self.b, []
        if rows := self.worse_by(margin):
            names = ", ".join(f"{_name(row)} {row.figure}" for row in rows)
            reasons.append(f"{a} is worse than {b} by more than {margin}: {names}")
        if self.unmeasured:
            names = ", ".join(map(in_words, self.unmeasured))
            reasons.append(
                f"{b} was measured in {names}, but {a} was not, because the compared scenes "
                "contain no relations"
            )
        return reasons

    def accepted(self, margin: float) -> str:
        """Return a sentence that says why other losses prevent no promotion, or ""."""
        certain, reasons = self.worse_by(margin), []
        for row in self.results.differences:
            if row.verdict == "worse" and row not in certain:
                is_primary = PRIMARY.get(row.task) == row.metric
                reason = (
                    f"not certainly by more than {margin}" if is_primary else "not a primary metric"
                )
                reasons.append(f"{_name(row)} ({reason})")
        return f"These losses prevent no promotion: {'; '.join(reasons)}." if reasons else ""

    def summary(self, margin: float = MARGIN) -> list[str]:
        """Return five sentences on the first model: data, knowledge, alarms, limits, advice."""
        origin, knowledge, limits, use = self.about
        return [origin, knowledge, self._alarms(), limits, f"{self._advice(margin)} {use}"]

    def _alarms(self) -> str:
        """Return the sentence about wrong alarms in the compared scenes."""
        own, other = (
            [
                Metric(task=ALARMS, source=c.source, metric=c.metric, **asdict(c.figure))
                for c in self.results.cells
                if (c.row, c.task) == (title, ALARMS)
            ]
            for title in (self.a, self.b)
        )
        if not own:
            return "How often A raises a wrong alarm is unknown: the held-out scenes are too short."
        (share,) = shares_of_alarms(own).values()
        of_b = "".join(f" (B: {value})" for value in shares_of_alarms(other).values())
        return (
            f"With the default sensitivity, A raises a wrong alarm in {share}{of_b} of "
            f"{share.lists:,} lists of {lengths_of_lists(own)} things from unchanged held-out "
            "scenes."
        )

    def _advice(self, margin: float) -> str:
        """Return whether to promote the first model."""
        if reasons := self.objections(margin):
            return f"Do not promote A: {'; '.join(reasons)}."
        n = Counter(row.verdict for row in self.results.differences)
        counts = f"better in {n['better']} of {n.total()} metrics and worse in {n['worse']}"
        if not n["better"]:
            return f"A promotion of A brings no certain gain: A is {counts}."
        return f"Promote A: it is {counts}."

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-serialisable dictionary with the results and all other attributes."""
        attributes = asdict(self)
        attributes.pop("results")
        attributes["summary"] = self.summary() if attributes.pop("about") else []
        return self.results.to_dict() | {"a": self.a} | attributes


def compare_command(
    new: Annotated[str, typer.Argument(help="first model: folder of a run, or a stored model")],
    old: Annotated[
        str | None,
        typer.Argument(
            help=f"second model, or {BASELINES}. By default the model with the alias "
            f"`default`; if the store has no such alias, {BASELINES}"
        ),
    ] = None,
    data: Annotated[
        Path | None, typer.Option("--data", help="folder with the scenes of the first model")
    ] = None,
    store: StorePath = DEFAULT_STORE,
    output: Annotated[Path | None, typer.Option("--json", help="write all results here")] = None,
) -> None:
    """Compare two models on scenes held out from both, and say whether to promote the first one.

    The scenes are the test scenes of the first model, without scenes that the second model learnt
    from. The table shows the difference of each metric with its paired 95 % interval. The bootstrap
    resamples groups of near-duplicate scenes.
    """
    try:
        with console.status("reading") as status:
            say: Progress = status.update
            models = Store(store)
            a = find(new, models, data, say)
            served = "default" if "default" in models.aliases() else BASELINES
            b = find(old or served, models, data, say)
            comparison = compare(a, b, data or a.data or b.data or DATA, say=say)
    except (ConfigError, DatasetError, RegistryError, RunError) as error:
        fail(error)
    if output is not None:
        text = json.dumps(comparison.to_dict(), indent=1, ensure_ascii=False)
        output.write_text(text + "\n", encoding="utf-8")
    print_lines(*comparison.summary(), "")
    show(comparison, MARGIN)


def show(comparison: Comparison, margin: float) -> None:
    """Print the metrics of a comparison as a table, with its notes."""
    titles = (comparison.a, comparison.b)
    heading = f"{comparison.scenes} held-out scenes of {comparison.groups} groups"
    print_lines(heading, f"A: {comparison.a}", f"B: {comparison.b}")
    headings = "task, metric", "A", "B", "A - B, 95 % interval", "A is"
    # Without edges and padding, the table fits into 80 columns.
    table = Table(*headings, box=box.SIMPLE_HEAD, show_edge=False, padding=0)
    cells = comparison.results.cells
    values = {(cell.row, cell.task, cell.metric): cell.figure.value for cell in cells}
    task = ""
    for row in comparison.results.differences:
        if row.task != task:
            task = row.task
            table.add_row(Text(in_words(task), "bold"))
        colour = _COLOURS.get(row.verdict, "dim")
        table.add_row(
            f"  {row.metric}",
            *(f"{values[name, row.task, row.metric]:.3f}" for name in titles),
            difference_text(row.figure),
            Text(row.verdict, colour),
        )
    console.print(table)
    print_lines(*filter(None, [comparison.accepted(margin)]))
    notes = list(comparison.notes)
    if comparison.unmeasured:
        names = ", ".join(map(in_words, comparison.unmeasured))
        notes.append(f"{comparison.a} was not measured in {names}: the scenes contain no relations")
    for note in notes:
        console.print(f"note: {note}", soft_wrap=True)


def _name(row: Difference) -> str:
    return f"{in_words(row.task)}, {row.metric}"


def difference_text(figure: Figure) -> str:
    """Return a difference with its sign and its interval."""
    return f"{figure.value:+.3f} [{figure.low:+.3f}, {figure.high:+.3f}]"


def compare(a: Candidate, b: Candidate, root: Path, *, say: Progress) -> Comparison:
    """Measure both models on the scene files in `root`, in the classes of the first model."""
    if a.config is None or a.vocabulary is None:
        raise ConfigError(
            f"{a.title} does not record its training configuration, so its held-out scenes are "
            "unknown: choose a first model that was trained with this project"
        )
    say("reading scenes")
    sources = read_sources(a.config.data, root)
    test, remarks = held_out(a, b, sources)
    data = split_and_encode(a.config.data, sources, root, a.vocabulary).training_data()
    encoded = encode(test, a.vocabulary)
    annotated = annotated_classes(encoded, a.vocabulary)
    scenes = some_scenes(scene_tensors(encoded, annotated, a.vocabulary), SCENES)
    models = (a.model(a.vocabulary, data, say), b.model(a.vocabulary, data, say))
    try:
        titles = a.title, b.title if b.title != a.title else f"{b.title} (second)"
        results = side_by_side(titles, models, scenes, data.structure, progress=say)
    except ValueError as error:
        raise ConfigError(f"{a.title} and {b.title} cannot be compared: {error}") from error
    if not results.differences:
        raise ConfigError(
            f"the {len(scenes)} held-out scenes are unsuitable for all compared tasks: provide "
            "scenes with at least two object classes"
        )
    return Comparison(
        results=results,
        b=titles[1],
        scenes=len(scenes),
        groups=len({scene.group for scene in scenes.scenes}),
        notes=(*remarks, *_notes(a, b, test)),
        unmeasured=unmeasured(results.differences, b),
        about=_about(a),
    )


def _about(model: Candidate) -> tuple[str, ...]:
    """Return the sentences about the first model that need no scenes; see `Comparison.about`."""
    drawn = 0 if model.config is None else model.config.data.written
    if model.scene_model is None:
        return ()
    words, calibration = model.scene_model.vocabulary, model.scene_model.calibration
    return (
        trained_on("A", model.sources, drawn),
        knows("A", words, calibration),
        judges_not("A", words, calibration),
        use(model.sources, model.terms),
    )


def side_by_side(
    titles: tuple[str, str],
    models: tuple[Model, Model],
    scenes: SceneTensors,
    structure: Tensor,
    *,
    progress: Progress = silent,
) -> Results:
    """Measure every metric that both models support, and the differences, paired by group."""
    setting = Setting(scenes, structure, limit=None)
    if len(np.unique(scenes.group_ids)) < 2:
        raise ValueError("the scenes belong to one group, but intervals need at least two groups")
    reports = {}
    for title, model in zip(titles, models, strict=True):
        report = measure(model, setting, "held out", tasks=COMPARED, progress=progress)
        reports[title, 0] = {"held out": only(report, COMPARED)}
    progress("resampling groups")
    return summarise(reports, titles[0])


def unmeasured(rows: Sequence[Difference], other: Candidate) -> tuple[str, ...]:
    """Return the relation tasks that only the other card measures; () if `rows` measure any."""
    if any(row.task in RELATIONAL for row in rows):
        return ()
    return tuple(task for task in RELATIONAL if task in other.tasks)


def _notes(a: Candidate, b: Candidate, test: Sequence[AnnotatedScene]) -> Iterator[str]:
    """Generate remarks on classes that the second model lacks, and on the number of scenes."""
    ours, theirs = a.vocabulary, b.vocabulary
    if ours is not None and theirs is not None and not same_classes(ours, theirs):
        lacks = Translation.between(ours, theirs).model_class < 0
        labels = [thing.label for scene in test for thing in scene.objects]
        mentions = [index for label in labels if (index := ours.index(label)) is not None]
        if missing := int(lacks.sum()):
            share = int(lacks[mentions].sum()) / max(len(mentions), 1)
            yield (
                f"the questions use the {len(ours)} classes of {a.title}. {b.title} lacks "
                f"{missing} of these classes ({share:.0%} of the objects in the scenes). Objects "
                "of these classes are not part of its input, and it ranks these classes last"
            )
    if len(test) > SCENES:
        yield f"{SCENES} random scenes of {len(test)} held-out scenes are compared"
