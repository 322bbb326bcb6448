"""The control: from scenes whose objects were permuted nobody learns more than popularity.

Whoever does was told something that these scenes do not say: of those it is asked about, perhaps.
Every baseline and every variant of the machines is asked about the same real scenes after learning
from real and from shuffled ones. 300 scenes leave chance patterns of their own: over three
permutations no row was more than .07 above popularity, and none less than .3 above it where it had
learnt from real scenes. `TOLERANCE` lies between.
"""

from __future__ import annotations

from functools import cache
from typing import get_args

import pytest

from app.inference.variants import VARIANTS, Variant
from app.scene import ObjectClass, Vocabulary
from tests.training.research.baselines.furnished import STRUCTURE, V, furnished, tensors
from training.datasets import shuffle_objects
from training.datasets.batches import SceneTensors, TrainingData
from training.evaluation.artifact_model import relation_score
from training.evaluation.baselines import RELATIONS
from training.evaluation.baselines.fitting import missing_mrr
from training.evaluation.missing_tasks import rank_missing
from training.evaluation.model import Model
from training.evaluation.parts import one_quarter
from training.evaluation.relation_tasks import rank, score_scenes
from training.fit.configuration import Config
from training.fit.draft import draft_artifact
from training.fit.trainer import Trainer
from training.research.baselines import BASELINES, networks

pytestmark = pytest.mark.slow

TOLERANCE = 0.1
POPULARITY, *OBJECTS = (b for b in BASELINES.values() if b.scores == ("missing",))
RELATION_POPULARITY, *OF_RELATIONS = (b for b in BASELINES.values() if b.scores == RELATIONS)
HELD_OUT = furnished(100, seed=3)


@pytest.fixture(scope="module", autouse=True)
def _longer_courses():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(networks, "_STEPS", 100)
        yield


@cache
def parts(shuffled: bool) -> tuple[SceneTensors, SceneTensors]:
    """(training, validation) scenes."""
    real = furnished(300, seed=1), furnished(60, seed=2)
    if not shuffled:
        return real
    first, second = (
        tensors(shuffle_objects(part.scenes, STRUCTURE.numpy(), seed=0)) for part in real
    )
    return first, second


def figures(model: Model) -> dict[str, float]:
    """MRR with all classes but one listed and with a quarter, and R-precision."""
    values = {}
    if model.missing is not None:
        values["one removed"] = missing_mrr(HELD_OUT, STRUCTURE, model.missing)
        ranking = rank_missing(HELD_OUT, STRUCTURE, model.missing, one_quarter)
        values["quarter"] = ranking.mrr().value
    if model.relations is not None:
        scored = score_scenes(HELD_OUT, STRUCTURE, model.relations, counts=False)
        values["relations"] = rank(scored, len(HELD_OUT)).pooled().value
    return values


@cache
def popular(shuffled: bool) -> dict[str, float]:
    both = (b.fit(*parts(shuffled), STRUCTURE) for b in (POPULARITY, RELATION_POPULARITY))
    objects, relations = map(figures, both)
    return objects | relations


def test_shuffling_takes_nothing_from_popularity():
    """The figures that others fall to are those of real scenes."""
    assert popular(shuffled=True) == pytest.approx(popular(shuffled=False))


def check(real: Model, shuffled: Model) -> None:
    for name, value in figures(real).items():
        level = popular(shuffled=True)[name]
        # A quarter of a room of seven classes says less than all classes but one.
        assert value > level + (1.5 if name == "quarter" else 2) * TOLERANCE
        assert figures(shuffled)[name] <= level + TOLERANCE


@pytest.mark.parametrize("baseline", [*OBJECTS, *OF_RELATIONS], ids=lambda baseline: baseline.name)
def test_baselines_fall_to_popularity(baseline):
    check(*(baseline.fit(*parts(labels), STRUCTURE) for labels in (False, True)))


@pytest.mark.parametrize("variant", get_args(Variant))
def test_machines_fall_to_popularity(variant):
    models = []
    for labels in (False, True):
        machine = trained(variant, *parts(labels))
        relations = relation_score(draft_artifact(machine, VOCABULARY), given=False)
        models.append(Model(missing=machine.object_log_odds, relations=relations))
    check(*models)


VOCABULARY = Vocabulary(
    [ObjectClass(f"class {k}", structure=bool(STRUCTURE[k])) for k in range(V)], ("first", "second")
)


def trained(variant: Variant, train: SceneTensors, validation: SceneTensors):
    """A small machine."""
    shape = {"variant": variant, "units": 3, "states": 4}
    if VARIANTS[variant].factorised:
        shape["K"] = 4
    config = Config.model_validate(
        {
            "name": "small",
            "data": {"sources": ["made"]},
            "machine": shape,
            "objects": {"steps": 200, "batch_size": 64, "learning_rate": 0.03},
            "relations": {"epochs": 6, "batch_size": 32, "learning_rate": 0.04},
        }
    )
    data = TrainingData(train, validation, HELD_OUT, STRUCTURE, VOCABULARY)
    return Trainer(config, data).run().machine.requires_grad_(False)
