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
from tests.training.research.baselines.furnished import STRUCTURE, A, V, furnished, tensors
from training.datasets import shuffle_objects
from training.datasets.batches import SceneTensors, TrainingData
from training.evaluation.artifact_model import relation_score
from training.evaluation.baselines import RELATIONS
from training.evaluation.baselines.fitting import missing_mrr
from training.evaluation.missing_tasks import rank_missing
from training.evaluation.model import ObjectScore, RelationScore
from training.evaluation.parts import one_quarter
from training.evaluation.relation_tasks import rank, score_scenes
from training.fit.configuration import Config
from training.fit.draft import draft_artifact
from training.fit.trainer import Trainer
from training.research.baselines import BASELINES

pytestmark = pytest.mark.slow

TOLERANCE = 0.1
POPULARITY, *OBJECTS = (b for b in BASELINES.values() if b.scores == ("missing",))
RELATION_POPULARITY, *OF_RELATIONS = (b for b in BASELINES.values() if b.scores == RELATIONS)


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


@cache
def held_out() -> SceneTensors:
    return furnished(100, seed=3)


def mrr(score: ObjectScore) -> float:
    return missing_mrr(held_out(), STRUCTURE, score)


def partial(score: ObjectScore) -> float:
    """A quarter of the classes listed."""
    return rank_missing(held_out(), STRUCTURE, score, one_quarter).mrr().value


def precision(score: RelationScore) -> float:
    """R-precision over distinct classes."""
    scored = score_scenes(held_out(), STRUCTURE, score, counts=False)
    return rank(scored, len(held_out())).pooled().value


@cache
def popular() -> float:
    return mrr(POPULARITY.fit(*parts(shuffled=True), STRUCTURE).missing)


@cache
def partly_popular() -> float:
    return partial(POPULARITY.fit(*parts(shuffled=True), STRUCTURE).missing)


@cache
def relation_popular() -> float:
    return precision(RELATION_POPULARITY.fit(*parts(shuffled=True), STRUCTURE).relations)


def test_popularity_is_what_it_was():
    """Shuffling takes nothing from it: the figures that others fall to are those of real scenes."""
    real = parts(shuffled=False)
    assert popular() == mrr(POPULARITY.fit(*real, STRUCTURE).missing)
    assert relation_popular() == precision(RELATION_POPULARITY.fit(*real, STRUCTURE).relations)


@pytest.mark.parametrize("baseline", OBJECTS, ids=lambda baseline: baseline.name)
def test_objects_fall_to_popularity(baseline):
    real, shuffled = (baseline.fit(*parts(labels), STRUCTURE).missing for labels in (False, True))
    # A quarter of a room of seven classes says less than all classes but one.
    figures = (mrr, popular(), 2 * TOLERANCE), (partial, partly_popular(), 1.5 * TOLERANCE)
    for figure, level, least in figures:
        assert figure(real) > level + least
        assert figure(shuffled) <= level + TOLERANCE


@pytest.mark.parametrize("baseline", OF_RELATIONS, ids=lambda baseline: baseline.name)
def test_relations_fall_to_popularity(baseline):
    real, shuffled = (
        precision(baseline.fit(*parts(labels), STRUCTURE).relations) for labels in (False, True)
    )
    assert real > relation_popular() + 2 * TOLERANCE
    assert shuffled <= relation_popular() + TOLERANCE


@pytest.mark.parametrize("variant", get_args(Variant))
def test_machines_fall_to_popularity(variant):
    figures = {}
    for labels in (False, True):
        machine = trained(variant, *parts(labels))
        artifact = draft_artifact(machine, VOCABULARY)
        figures[labels] = (
            mrr(machine.object_log_odds),
            partial(machine.object_log_odds),
            precision(relation_score(artifact, given=False)),
        )
    levels = popular(), partly_popular(), relation_popular()
    for real, shuffled, level in zip(figures[False], figures[True], levels, strict=True):
        assert real > level + 2 * TOLERANCE
        assert shuffled <= level + TOLERANCE


VOCABULARY = Vocabulary(
    [ObjectClass(f"class {k}", structure=bool(STRUCTURE[k])) for k in range(V)], ()
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
    data = TrainingData(
        *(train, validation, held_out(), STRUCTURE),
        relations=A,
        room_types=2,
        vocabulary=VOCABULARY,
    )
    return Trainer(config, data).run().machine.requires_grad_(False)
