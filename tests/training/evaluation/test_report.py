from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.questions.artifacts import LARGER, larger_artifact
from tests.training.evaluation.scenes import flat, random_scenes, scene, tensors
from training.datasets.batches import seen_triples
from training.datasets.cases import some_scenes
from training.evaluation import report as reports
from training.evaluation.asking import artifact_model
from training.evaluation.calibration_task import QUESTIONS
from training.evaluation.generation_task import held_out_halves, held_out_scenes, independent_scenes
from training.evaluation.relation_tasks import completion_task
from training.evaluation.setting import Model, Setting
from training.evaluation.tasks import EVERY_TASK, TASKS, WHOLE_SET

V = LARGER["triway"].V
NO_STRUCTURE = torch.zeros(V, dtype=torch.bool)
TRAIN = tensors(random_scenes(30, V, seed=1), V)
DATA = tensors(random_scenes(40, V), V)
SEEN = seen_triples(TRAIN.scenes, V)
SETTING = Setting(DATA, NO_STRUCTURE, TRAIN, SEEN)
ARTIFACT = larger_artifact("triway-states")
MODEL = artifact_model(ARTIFACT)
OF_OBJECTS = {name for name, task in TASKS.items() if task.of_objects}


def report_of(model, setting, tasks=tuple(TASKS)):
    report = reports.measure(model, setting, "toy", tasks=tasks)
    assert list(report.outcomes) == list(tasks)
    return report


def values_of(report):
    return {
        (task, name): metric.value
        for task, outcome in report.outcomes.items()
        if outcome is not None
        for name, metric in outcome.metrics.items()
    }


def two_sources(scenes):
    named = [replace(s, source="ab"[k % 2]) for k, s in enumerate(scenes.scenes)]
    return tensors(sorted(named, key=lambda s: s.source), V)


def test_every_task_has_an_outcome():
    report = report_of(MODEL, SETTING)
    # The setting has neither facts nor homes.
    silent = {task for task, outcome in report.outcomes.items() if outcome is None}
    assert silent == {"Everyday", "Where"}
    assert all(np.isfinite(list(values_of(report).values())))
    assert "R-precision, zero-shot" in report.outcomes["T1a relations"].metrics
    assert "flagged, uniform" in report.outcomes["T3 outliers"].metrics
    assert set(report_of(Model(), SETTING).outcomes.values()) == {None}
    relational = {"T1a relations", "T1 pairs", "T1 with evidence", "T1b completion"}
    others = relational | {"T3b placement", "T3c moved", "Calibration", "Everyday"}
    assert set(TASKS) - OF_OBJECTS == others


def test_reports_are_stored(tmp_path):
    path = tmp_path / "model" / "seed-0" / "toy.json"
    report = report_of(MODEL, SETTING, ("T2 missing", "T3b placement", "T4 generate", "Everyday"))
    report.write(path)
    again = reports.SourceReport.read(path)
    assert values_of(again) == pytest.approx(values_of(report))
    assert again.outcomes["T4 generate"].notes == report.outcomes["T4 generate"].notes
    assert again.outcomes["Everyday"] is None
    assert list(path.parent.iterdir()) == [path]
    for other in (replace(SETTING, seed=1), replace(SETTING, limit=3)):
        assert reports.digest(other) != again.scenes


@pytest.mark.parametrize("name", LARGER)
def test_every_machine_can_be_evaluated(name):
    """Scenes without relations, of one class: nothing is asked, nothing fails."""
    model = artifact_model(larger_artifact(name))
    some = ("T1a relations", "T1b completion", "T2 missing", "T3 outliers")
    found = values_of(report_of(model, replace(SETTING, limit=8), some))
    assert {task for task, _ in found} == set(some)
    assert all(np.isfinite(list(found.values())))
    asked = [task for task in TASKS if task.startswith(("T1", "T2", "T3"))]
    silent = Setting(tensors([scene([k]) for k in range(3)], V), NO_STRUCTURE, TRAIN, SEEN)
    assert set(report_of(model, silent, asked).outcomes.values()) == {None}


def test_tasks_about_objects_see_scenes_with_complete_object_lists_alone():
    """Elsewhere an unlisted object may be there. Relations are asked of all annotated scenes."""
    cut = [replace(one, complete=False, source="captions") for one in random_scenes(9, V, seed=2)]
    mixed = Setting(tensors([*DATA.scenes, *cut], V), NO_STRUCTURE, TRAIN, SEEN)
    asked = sorted(OF_OBJECTS | {"T1b completion"})
    whole, more = (report_of(MODEL, setting, asked) for setting in (SETTING, mixed))
    assert more.outcomes["T1b completion"].scenes == len(DATA) + 9
    first, second = (
        {key: value for key, value in values_of(report).items() if key[0] in OF_OBJECTS}
        for report in (whole, more)
    )
    assert second == pytest.approx(first)
    # A source of such scenes is asked for relations alone.
    captions = Setting(tensors(cut, V), NO_STRUCTURE, tensors(cut, V), SEEN)
    report = report_of(MODEL, captions, [task for task in TASKS if task != "Everyday"])
    assert {task for task, found in report.outcomes.items() if found is None} == OF_OBJECTS
    names = set(report.outcomes["Calibration"].metrics)
    assert "ECE, relations" in names
    about_objects = ("missing, 2 classes", "outliers", "missing at a place")
    assert not names & {f"ECE, {kind}" for kind in about_objects}


def test_pooled_sources_are_their_union():
    union, train = two_sources(DATA), two_sources(TRAIN)
    tasks = ("T1a relations", "T2 missing", "T3 alarms")
    every = Setting(union, NO_STRUCTURE, train, SEEN)
    together = reports.pooled([report_of(MODEL, own, tasks) for _, own in every.by_source()])
    whole = report_of(MODEL, every, tasks)
    assert values_of(together) == pytest.approx(values_of(whole))


def test_the_floor_is_the_other_half_of_the_scenes():
    """The samples of independent classes have the mean size of the training scenes."""
    tasks = ("T4 generate",)
    name = "T4 generate", "classes per scene, free"
    independent = values_of(report_of(Model(generate=independent_scenes), SETTING, tasks))
    assert independent[name] == pytest.approx(float(TRAIN.v.sum(1).mean()), abs=0.3)
    floor = values_of(report_of(Model(generate=held_out_scenes), SETTING, tasks))
    assert floor[name] == pytest.approx(float(held_out_halves(SETTING)[1].v.sum(1).mean()))


def test_publishing_measures_the_tasks_of_a_card_on_every_source():
    """Of the calibrated artifact, on each source; generation on all together."""
    rows = reports.evaluate(ARTIFACT, two_sources(DATA), NO_STRUCTURE, two_sources(TRAIN))
    found = {(row.task, row.source, row.metric) for row in rows}
    assert len(found) == len(rows)
    # These scenes of at most five classes have no poses, offsets, counts or facts, and no homes.
    absent = {"Offsets", "Counts", "Everyday", "Where"}
    missing = ("poses", "signature", "5 classes", "8 classes")
    card = {
        (task, source, metric)
        for task, one in EVERY_TASK.items()
        if task not in absent
        for source in (("pooled",) if task in WHOLE_SET else "ab")
        for metric in one.card
        if not metric.endswith(missing)
    }
    assert found == card


def test_completion_has_recall_and_zero_shot_precision():
    """If nothing was seen, every triple is new."""
    new, every, plain = (
        completion_task(flat, replace(SETTING, seen=seen)).metrics
        for seen in (SEEN, SEEN[:0], None)
    )
    name = "R-precision, zero-shot"
    assert 0 < new[name].n < every[name].n == every["R-precision"].n
    assert name not in plain
    assert 0 < plain["R@20"].value < plain["R@100"].value


def test_a_skill_that_is_undefined_is_left_out(tmp_path, monkeypatch):
    """No answer was true: the calibration error stands, and the report can be written."""
    monkeypatch.setitem(QUESTIONS, "misplaced", lambda *_: [(0.25, False), (0.5, False)])
    report = reports.measure(MODEL, SETTING, "toy", tasks=("Calibration",))
    metrics = report.outcomes["Calibration"].metrics
    assert metrics["ECE, misplaced"].value == pytest.approx(0.375)
    assert "Brier skill, misplaced" not in metrics
    assert "Brier skill, relations" in metrics
    report.write(tmp_path / "toy.json")


def test_a_sample_of_scenes_is_always_the_same():
    some = some_scenes(DATA, 7)
    assert [s.scene_id for s in some.scenes] == [s.scene_id for s in some_scenes(DATA, 7).scenes]
    assert len(some) == 7
    assert some_scenes(DATA, None) is some_scenes(DATA, 100) is DATA
