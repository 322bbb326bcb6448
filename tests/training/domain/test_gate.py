from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from app.model import SceneModel
from app.registry import Store
from tests.http.stores import corrupt, make_store
from tests.training.commands import small_config
from training.datasets import EncodedScene
from training.datasets.batches import TrainingData, subset
from training.domain.candidates import Candidate
from training.domain.compare import ALARMS, RELATIONAL, Comparison, unmeasured
from training.domain.gate import Usefulness, measure_usefulness, served_model
from training.evaluation.metrics import Figure
from training.evaluation.results import Difference, Results
from training.fit.configuration import Config
from training.fit.draft import as_stored, draft_artifact
from training.fit.trainer import Trainer
from training.runs.config_files import with_settings
from training.runs.pipeline import SplitScenes, prepare


def difference(task: str, metric: str, low: float, high: float) -> Difference:
    return Difference("old", task, "held out", metric, Figure((low + high) / 2, low, high, 9))


def comparison(*rows: tuple[str, str, float, float]) -> Comparison:
    results = Results("new", (), tuple(difference(*row) for row in rows))
    return Comparison(results, "old", 40, 20, ())


@pytest.mark.parametrize(
    ("metric", "low", "high", "margin", "worse"),
    [
        ("MRR, one removed", -0.20, -0.03, 0.02, True),
        ("MRR, one removed", -0.20, -0.03, 0.05, False),
        ("MRR, one removed", -0.20, 0.01, 0.02, False),
        ("MRR, one removed", -0.20, -0.01, 0.02, False),
        ("MRR, one removed", -0.20, -0.01, 0.0, True),
        ("top-10", -0.20, -0.10, 0.02, False),  # not the primary metric
    ],
)
def test_a_metric_is_worse_if_its_whole_interval_exceeds_the_margin(
    metric, low, high, margin, worse
) -> None:
    found = comparison(("T2 missing", metric, low, high), ("T2 missing", "top-1", 0.1, 0.2))
    assert [row.metric for row in found.worse_by(margin)] == (["MRR, one removed"] if worse else [])


def test_a_refusal_names_every_metric_that_is_worse() -> None:
    found = comparison(
        ("T2 missing", "MRR, one removed", -0.3, -0.2),
        ("T3 outliers", "hit@1, uniform", -0.3, -0.1),
        ("T1b completion", "R-precision", 0, 1),
    )
    (text,) = found.objections(0.02)
    assert "missing objects, MRR, one removed -0.250" in text
    assert "hit@1" in text
    assert "R-precision" not in text
    assert found.to_dict()["differences"][0]["verdict"] == "worse"
    assert comparison().objections(0) == []


LESS = ("T2 missing", "top-10", -0.2, -0.1)
MORE = ("T1b completion", "R-precision", 0.1, 0.2)


def test_a_promotion_in_spite_of_a_worse_row_says_why() -> None:
    """Losses that prevent no promotion: of other metrics, within the margin, and more alarms."""
    within = ("T2 missing", "MRR, one removed", -0.2, -0.01)
    alarms = (ALARMS, "alarms, medium, 2 classes", 0.1, 0.2)
    found = comparison(LESS, within, alarms, MORE)
    assert found.objections(0.02) == []
    assert found.accepted(0.02) == (
        "These losses prevent no promotion: missing objects, top-10 (not a primary metric); "
        "missing objects, MRR, one removed (not certainly by more than 0.02); alarms in untouched "
        "parts, alarms, medium, 2 classes (not a primary metric)."
    )
    assert "MRR, one removed" not in found.accepted(0.0), "this loss prevents the promotion"
    assert comparison(MORE).accepted(0.02) == ""


@pytest.mark.parametrize(
    ("rows", "advice"),
    [
        ([MORE, LESS], "Promote A: it is better in 1 of 2 metrics and worse in 1."),
        ([LESS], "A promotion of A brings no certain gain: A is better in 0 of 1 metrics and"),
        (
            [MORE, ("T1a relations", "R-precision, instance counts", -0.3, -0.2)],
            "Do not promote A: new is worse than old by more than 0.02: relations of a scene, R-pr",
        ),
    ],
)
def test_the_advice_follows_the_verdicts(rows, advice) -> None:
    found = replace(comparison(*rows), about=("data", "knowledge", "limits", "May be used."))
    summary = found.summary()
    assert summary[:2] + summary[3:4] == ["data", "knowledge", "limits"]
    assert summary[2].startswith("How often A raises a wrong alarm is unknown")
    assert summary[4].startswith(advice)
    assert summary[4].endswith(" May be used.")
    assert found.to_dict()["summary"] == summary


@pytest.mark.parametrize(
    ("measured", "task", "expected"),
    [
        (("T2 missing", "T3b placement", "T1a relations"), "T2 missing", 2),
        (("T2 missing", "T1a relations"), "T1a relations", 0),
        (("T2 missing",), "T2 missing", 0),
    ],
)
def test_a_model_without_relation_metrics_replaces_no_model_with_them(measured, task, expected):
    holder = Candidate("old", None, (), None, tasks=frozenset(measured))
    names = unmeasured([difference(task, "MRR", -0.1, 0.1)], holder)
    assert len(names) == expected
    assert set(names) < set(RELATIONAL)
    found = replace(comparison(("T2 missing", "MRR", -0.1, 0.1)), unmeasured=names)
    reasons = found.objections(0.02)
    assert len(reasons) == bool(names)
    for text in reasons:
        assert "old was measured in relations of a scene, false relation, but new was not" in text
        assert "worse" not in text


def small(**objects: float) -> Config:
    settings = {"machine.units": 4, "machine.states": 4, "machine.N": 0, "relations.epochs": 0}
    settings |= {f"objects.{name}": value for name, value in ({"steps": 150} | objects).items()}
    return with_settings(small_config("small", "rbm", rooms=240, split="stable"), settings)


@pytest.fixture(scope="module")
def rooms() -> SplitScenes:
    return prepare(small(), Path())


def trained(scenes: SplitScenes, **objects: float) -> SceneModel:
    machine = Trainer(small(**objects), scenes.training_data()).run().machine
    return draft_artifact(as_stored(machine), scenes.vocabulary)


def with_random_classes(scenes: SplitScenes) -> SplitScenes:
    rng, train = np.random.default_rng(0), scenes.parts["train"]
    every = np.concatenate([scene.evidence.classes for scene in train])
    classes, count = np.unique(every, return_counts=True)

    def drawn(scene: EncodedScene) -> EncodedScene:
        size = len(scene.evidence.classes)
        own = np.sort(rng.choice(classes, size, replace=False, p=count / count.sum()))
        return replace(scene, evidence=replace(scene.evidence, classes=own))

    return replace(scenes, parts=scenes.parts | {"train": [drawn(scene) for scene in train]})


def usefulness(artifact: SceneModel, data: TrainingData) -> Usefulness:
    return measure_usefulness(artifact, data, say=lambda _: None)


def test_a_trained_model_is_better_than_popularity(rooms) -> None:
    found = usefulness(trained(rooms), rooms.training_data())
    assert found.objections() == []
    assert found.differences["popularity"].low > 0.1


@pytest.mark.parametrize("shuffled", [False, True])
def test_a_useless_model_is_refused_with_its_figures(rooms, shuffled) -> None:
    """Hardly trained, or trained on classes that are drawn at random by their popularity."""
    options = {} if shuffled else {"steps": 1, "learning_rate": 1e-6}
    artifact = trained(with_random_classes(rooms) if shuffled else rooms, **options)
    found = usefulness(artifact, rooms.training_data())
    popularity, ease = found.objections()
    assert "not clearly better than popularity" in popularity
    assert "worse than EASE" in ease
    assert f"{found.differences['popularity'].value:+.3f}" in popularity
    assert f"{found.scenes} test scenes" in popularity


@pytest.mark.parametrize(
    ("popularity", "reasons"),
    [
        (Figure(0.006, 0.001, 0.011, 90), 1),  # a model of shuffled labels, from few groups
        (Figure(0.030, -0.001, 0.061, 90), 1),
        (Figure(0.020, 0.001, 0.039, 90), 0),
    ],
)
def test_a_useful_model_leads_popularity_certainly_and_by_enough(popularity, reasons) -> None:
    differences = {"popularity": popularity, "EASE": Figure(0.0, -0.1, 0.1, 90)}
    found = Usefulness(30, 9, {"popularity": 0.4, "EASE": 0.417}, differences)
    required = "at least +0.020, whole interval above zero"
    assert [required in text for text in found.objections()] == [True] * reasons
    assert any(required in line for line in found.lines())


def test_unusual_test_scenes(rooms) -> None:
    """Incomplete scenes are used if there are no others. Few usable scenes are refused."""
    data, artifact = rooms.training_data(), trained(rooms, steps=1)
    flags = [replace(scene, complete=False) for scene in data.test.scenes]
    found = usefulness(artifact, replace(data, test=replace(data.test, scenes=flags)))
    assert found.mrr
    assert found.scenes == len(flags)
    four_with_objects = torch.zeros_like(data.test.v)
    four_with_objects[:4] = data.test.v[:4]
    for few in (subset(data.test, torch.arange(4)), replace(data.test, v=four_with_objects)):
        found = usefulness(artifact, replace(data, test=few))
        assert list(found.lines()) == []
        assert "at least 6 groups" in found.objections()[0]


def test_new_aliases_and_unreadable_models_are_not_compared(tmp_path) -> None:
    store = Store(make_store(tmp_path / "store"))
    found = served_model(store, "default")
    assert found.candidate is not None
    assert (found.candidate.title, found.note) == ("home@1.0.0", "")
    assert found.candidate.config is None  # random weights do not say how they were trained
    new = served_model(store, "fresh")
    assert (new.target, new.candidate) == (None, None)
    assert "fresh is a new alias" in new.note
    corrupt(store.root, "home", "1.0.0")
    broken = served_model(store, "default")
    assert str(broken.target) == "home@1.0.0"
    assert broken.candidate is None
    assert "cannot be read" in broken.note
