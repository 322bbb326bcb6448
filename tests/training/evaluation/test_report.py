"""Every task for one contender, stored, resumed, pooled and compared."""

from __future__ import annotations

import json
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from app.registry import Thresholds
from tests.questions.artifacts import LARGER, artifact_of
from tests.training.evaluation.scenes import (
    flat,
    knowing,
    larger_machine,
    random_scenes,
    scene,
    tensors,
)
from training.batches import seen_triples
from training.evaluation.answers import QUESTIONS
from training.evaluation.asking import SENSITIVITIES
from training.evaluation.cases import some_scenes
from training.evaluation.contenders import Contender, artifact_contender
from training.evaluation.density import DensitySettings
from training.evaluation.report import (
    SourceReport,
    digest,
    evaluate,
    measure,
    pooled,
    run,
    settings_by_source,
)
from training.evaluation.tasks import (
    TASKS,
    Setting,
    floor_contender,
    independent_contender,
)

V = LARGER["triway-local"].V
NO_STRUCTURE = torch.zeros(V, dtype=torch.bool)
TRAIN = tensors(random_scenes(30, V, seed=1), V)
DATA = tensors(random_scenes(40, V), V)
SEEN = seen_triples(TRAIN.scenes, V)
SETTING = Setting(DATA, NO_STRUCTURE, TRAIN, SEEN)
EFFORT = DensitySettings(chains=8, temperatures=10, burn_in=5, draws=8)
ARTIFACT = artifact_of(larger_machine("triway-local"))
CONTENDER = artifact_contender(ARTIFACT, TRAIN, EFFORT)


def flat_objects(v):
    return torch.zeros_like(v)


def values_of(report):
    return {
        (task, name): metric.value
        for task, outcome in report.outcomes.items()
        if outcome is not None
        for name, metric in outcome.metrics.items()
    }


def test_every_task_has_an_outcome():
    report = SourceReport("toy", digest(SETTING))
    assert list(run(CONTENDER, SETTING, report)) == list(TASKS)
    # Thirty training scenes say nothing of what is typical, and the setting names no facts.
    nothing = {task for task, outcome in report.outcomes.items() if outcome is None}
    assert nothing == {"T3 signature", "Everyday"}
    assert all(np.isfinite(list(values_of(report).values())))
    assert "R-precision, zero-shot" in report.outcomes["T1a relations"].metrics
    assert "alarms in untouched scenes" in report.outcomes["T3 outliers, uniform"].metrics


def test_reports_are_stored_and_resumed(tmp_path):
    path = tmp_path / "model" / "seed-0" / "toy.json"
    some = ("T2 missing", "T3b placement")
    first = measure(path, CONTENDER, SETTING, "toy", tasks=some)
    assert tuple(first.outcomes) == some
    asked = []
    every = (*some, "T4 generate", "T3 outliers, uniform")
    whole = measure(path, CONTENDER, SETTING, "toy", tasks=every, progress=asked.append)
    assert asked == ["toy: T4 generate", "toy: T3 outliers, uniform"]
    # A finished file needs no contender.
    again = measure(path, Contender(), SETTING, "toy", tasks=every)
    assert values_of(again) == pytest.approx(values_of(whole))
    assert again.outcomes["T4 generate"].notes == whole.outcomes["T4 generate"].notes
    assert not list(path.parent.glob("*.part"))
    written = json.loads(path.read_text())["tasks"]["T2 missing"]["outcome"]["metrics"]["MRR"]
    (row,) = (r for r in whole.rows() if (r.task, r.metric) == ("T2 missing", "MRR"))
    assert written["figure"] == asdict(row.figure)


def test_a_report_goes_on_with_the_same_questions_alone(tmp_path):
    path = tmp_path / "toy.json"
    measure(path, CONTENDER, SETTING, "toy", tasks=("T2 missing",))
    for other in (replace(SETTING, seed=1), replace(SETTING, limit=3)):
        with pytest.raises(ValueError, match="other scenes or questions"):
            measure(path, CONTENDER, other, "toy")
    with pytest.raises(ValueError, match="unknown tasks"):
        measure(path, CONTENDER, SETTING, "toy", tasks=("T9",))


@pytest.mark.parametrize("name", LARGER)
def test_scenes_that_hold_no_question_have_no_outcome(name):
    """A source without relations, and scenes of one class: nothing is asked, nothing fails."""
    contender = artifact_contender(
        artifact_of(larger_machine(name)), TRAIN, EFFORT, calibrated=False
    )
    asked = [task for task in TASKS if task.startswith(("T1", "T2", "T3"))]
    silent = Setting(tensors([scene([k]) for k in range(3)], V), NO_STRUCTURE, TRAIN, SEEN)
    report = SourceReport("silent", digest(silent))
    assert list(run(contender, silent, report, tasks=asked)) == asked
    assert set(report.outcomes.values()) == {None}


OBJECT_TASKS = {task for task in TASKS if task.startswith(("T2", "T3 ", "T4")) or task == "Density"}


def test_tasks_about_objects_see_scenes_with_complete_object_lists_alone():
    """Elsewhere an unlisted object may be there. Relations are asked of all annotated scenes."""
    cut = [replace(one, complete=False, source="captions") for one in random_scenes(9, V, seed=2)]
    mixed = Setting(tensors([*DATA.scenes, *cut], V), NO_STRUCTURE, TRAIN, SEEN)
    reports = []
    for setting in (SETTING, mixed):
        reports.append(SourceReport("toy", digest(setting)))
        list(run(CONTENDER, setting, reports[-1], tasks=sorted(OBJECT_TASKS | {"T1b completion"})))
    whole, more = ({t: o.scenes for t, o in r.outcomes.items() if o} for r in reports)
    assert whole == {task: more[task] - 9 * (task == "T1b completion") for task in whole}
    of_objects = [
        {key: value for key, value in values_of(report).items() if key[0] in OBJECT_TASKS}
        for report in reports
    ]
    assert of_objects[1] == pytest.approx(of_objects[0])


def test_a_source_of_incomplete_object_lists_is_asked_for_relations_alone():
    cut = [replace(one, complete=False) for one in random_scenes(20, V, seed=2)]
    setting = Setting(tensors(cut, V), NO_STRUCTURE, tensors(cut, V), SEEN)
    report = SourceReport("captions", digest(setting))
    asked = [task for task in TASKS if task != "Everyday"]
    list(run(CONTENDER, setting, report, tasks=asked))
    silent = {task for task, outcome in report.outcomes.items() if outcome is None}
    assert silent == OBJECT_TASKS
    names = report.outcomes["Calibration"].metrics
    assert "ECE, relations" in names
    assert not {f"ECE, {kind}" for kind in ("missing", "outliers", "missing at a place")} & set(
        names
    )


def test_who_takes_no_part_is_none():
    report = SourceReport("toy", digest(SETTING))
    for _ in run(Contender(), SETTING, report):
        pass
    assert set(report.outcomes.values()) == {None}
    assert report.rows() == []
    bare = Setting(tensors([scene([0])], V), NO_STRUCTURE, TRAIN, SEEN)
    report = SourceReport("toy", digest(bare))
    for _ in run(replace(CONTENDER, density=None), bare, report):
        pass
    assert set(report.outcomes.values()) == {None}


def test_pooled_sources_are_their_union():
    scenes = [replace(s, source="ab"[k % 2]) for k, s in enumerate(DATA.scenes)]
    union = tensors(sorted(scenes, key=lambda s: s.source), V)
    train = tensors([replace(s, source="ab"[k % 2]) for k, s in enumerate(TRAIN.scenes)], V)
    reports = []
    for source, setting in settings_by_source(union, NO_STRUCTURE, train, SEEN):
        report = SourceReport(source, digest(setting))
        for _ in run(CONTENDER, setting, report, tasks=("T1a relations", "T3 outliers, uniform")):
            pass
        reports.append(report)
    together = pooled(reports)
    setting = Setting(union, NO_STRUCTURE, train, SEEN)
    whole = SourceReport("all", digest(setting))
    for _ in run(CONTENDER, setting, whole, tasks=("T1a relations", "T3 outliers, uniform")):
        pass
    assert values_of(together) == pytest.approx(values_of(whole))


def test_references_stand_on_either_side():
    """Independent classes gain nothing over themselves; the floor is the other half as it is."""
    values = {}
    references = {
        "independent classes": independent_contender(SETTING),
        "held-out scenes (floor)": floor_contender(SETTING),
    }
    for name, contender in references.items():
        report = SourceReport("toy", digest(SETTING))
        for _ in run(contender, SETTING, report, tasks=("T4 generate", "Density")):
            pass
        values[name] = {metric: value for (_, metric), value in values_of(report).items()}
    gain = values["independent classes"]["gain over independent classes, upper log Z"]
    assert gain == pytest.approx(0.0)
    floor = values["held-out scenes (floor)"]
    sizes = SETTING.halves()[1].v.sum(1).mean()
    assert floor["classes per scene, free"] == pytest.approx(float(sizes))


def test_publishing_measures_the_published_tasks_on_every_source():
    """Of the calibrated artifact, on each source; generation on all together."""
    scenes = [replace(s, source="ab"[k % 2]) for k, s in enumerate(DATA.scenes)]
    train = tensors([replace(s, source="ab"[k % 2]) for k, s in enumerate(TRAIN.scenes)], V)
    rows = evaluate(ARTIFACT, tensors(scenes, V), NO_STRUCTURE, train)
    found = {(row.task, row.source, row.metric) for row in rows}
    assert len(found) == len(rows)
    expected = {
        "T1a relations": {"R-precision, distinct classes", "R-precision, instance counts"},
        "T1 pairs": {"accuracy", "log-loss"},
        "T1 with evidence": {"change of R-precision, relations"},
        "T1b completion": {"R-precision"},
        "T2 missing": {"MRR", "top-1", "top-10"},
        "T2 partial": {"MRR, 50 %", "precision@5, 50 %", "change of MRR, 50 %"},
        "T2 with evidence": {f"change of MRR, {k}" for k in ("relations", "room type")},
        "T2-at missing at a place": {"MRR"},
        "T3 outliers, uniform": {"hit@1", "AUROC", "alarms in untouched scenes"},
        "T3 sensitivity": {
            f"{figure}, {name}"
            for name in SENSITIVITIES
            for figure in ("alarms", "caught, uniform", "caught, by popularity")
        },
        "T3 with evidence": {f"change of hit@1, {k}" for k in ("relations", "room type")},
        "T3b placement": {"hit@1"},
        "Calibration": {f"{f}, {q}" for f in ("ECE", "Brier skill") for q in QUESTIONS},
    }
    for source in "ab":
        assert {
            task: {metric for t, s, metric in found if (t, s) == (task, source)}
            for task in expected
        } == expected
    assert {(t, m) for t, s, m in found if s == "pooled"} == {
        ("T4 generate", "MMD², free"),
        ("T4 generate", "pair correlation, free"),
    }
    assert {source for _, source, _ in found} == {"a", "b", "pooled"}


@pytest.mark.slow
def test_what_is_published_is_the_calibrated_artifact_s():
    """Another default threshold, other alarms; and no more scenes than the limit allows."""

    def alarms(threshold, limit=100):
        calibration = ARTIFACT.calibration.model_copy(
            update={"outlier_thresholds": Thresholds(medium=threshold)}
        )
        rows = evaluate(
            replace(ARTIFACT, calibration=calibration), DATA, NO_STRUCTURE, TRAIN, limit=limit
        )
        assert {row.source for row in rows} == {"toy"}
        (row,) = (row for row in rows if row.metric == "alarms in untouched scenes")
        return row.figure

    assert alarms(0.0).value == 1.0
    assert alarms(1.0).value == 0.0
    assert (alarms(0.5).n, alarms(0.5, limit=7).n) == (40, 7)


def test_completion_has_the_metrics_of_relations():
    """R@k and zero-shot R-precision, of the half that is asked for."""
    knows = Contender(completion=knowing(DATA))
    setting = replace(SETTING, seen=SEEN[:0])
    metrics = TASKS["T1b completion"](knows, setting).metrics
    assert metrics["R@100"].value == 1.0
    # Nothing was seen: every triple is new.
    assert metrics["R-precision, zero-shot"].n == metrics["R-precision"].n
    some = TASKS["T1b completion"](knows, SETTING).metrics
    assert 0 < some["R-precision, zero-shot"].n < some["R-precision"].n
    ignorant = TASKS["T1b completion"](Contender(completion=flat), setting).metrics
    recalls = [ignorant[f"R@{k}"].value for k in (20, 50, 100)]
    assert recalls == sorted(recalls)
    assert 0 < recalls[0] < 1
    unknown = TASKS["T1b completion"](knows, replace(SETTING, seen=None)).metrics
    assert "R-precision, zero-shot" not in unknown


def test_a_skill_that_is_undefined_is_left_out(tmp_path, monkeypatch):
    """No answer was true: the calibration error stands, and the report can be written."""

    def never(artifact, scene, rng):
        return [(0.25, False), (0.5, False)]

    monkeypatch.setitem(QUESTIONS, "missing", never)
    report = measure(tmp_path / "toy.json", CONTENDER, SETTING, "toy", tasks=("Calibration",))
    metrics = report.outcomes["Calibration"].metrics
    assert metrics["ECE, missing"].value == pytest.approx(0.375)
    assert "Brier skill, missing" not in metrics
    assert "Brier skill, relations" in metrics
    assert (tmp_path / "toy.json").exists()


def test_some_scenes_are_the_same_for_everybody():
    some = some_scenes(DATA, 7)
    assert [s.scene_id for s in some.scenes] == [s.scene_id for s in some_scenes(DATA, 7).scenes]
    assert len(some) == 7
    assert some_scenes(DATA, None) is DATA
    assert some_scenes(DATA, 100) is DATA
