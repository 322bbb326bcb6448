"""T1b: what is given and what is asked, and agreement with the service."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from app.scene import ObjectClass, Vocabulary
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    flat,
    knowing,
    larger_machine,
    random_scenes,
    scene,
    tensors,
)
from training.datasets import AnnotatedObject, AnnotatedScene, encode
from training.evaluation.completion import complete_scenes
from training.evaluation.relations import rank, telling
from training.evaluation.scores import relation_score

DATA = tensors(random_scenes(20), WIDE)


def test_perfect_and_ignorant_scores():
    assert rank(complete_scenes(DATA, WIDE_STRUCTURE, knowing(DATA)), 20).pooled().value == 1.0
    for asked in complete_scenes(DATA, WIDE_STRUCTURE, flat):
        held = asked.truth.sum()
        if held:
            ranking = rank([dataclasses.replace(asked, scene=0)], 1)
            assert ranking.hits[0] == pytest.approx(held**2 / len(asked.score))


def test_halves_are_disjoint_and_together_the_truth():
    """Given plus asked is all; nothing given, nor its mirror image, is asked."""
    batches = []

    def spy(batch):
        batches.append(batch)
        return torch.zeros(batch.holds.shape)

    asked = iter(complete_scenes(DATA, WIDE_STRUCTURE, spy, block=1))
    related = [entry for entry in DATA.scenes if entry.evidence.holds.sum() >= 2]
    assert len(batches) == len(related)
    for batch, entry in zip(batches, related, strict=True):
        truth = torch.from_numpy(entry.evidence.holds)
        given = batch.holds[0] > 0
        assert bool((given <= truth).all())
        assert int(given.sum()) == int(truth.sum()) // 2
        assert bool((batch.observed[0] == given).all())
        own = next(asked)
        mirrored = given.mT & ~given
        n = len(entry.evidence.classes)
        assert len(own.score) == 4 * n * (n - 1) - int((given | mirrored).sum())
        assert own.truth.sum() == int((truth & ~given & ~mirrored).sum())


def test_repeating_what_was_given_gains_nothing():
    """Neither a given triple nor its mirror image can be scored by copying."""

    def parrot(batch):
        return batch.holds + batch.holds.mT

    mutual = [scene([0, 1, 2], [(0, 0, 1), (0, 1, 0), (1, 1, 2), (1, 2, 1)]) for _ in range(8)]
    for data, structure in ((DATA, WIDE_STRUCTURE), (tensors(mutual), NO_STRUCTURE)):
        copied = complete_scenes(data, structure, parrot)
        blind = complete_scenes(data, structure, flat)
        assert rank(copied, len(data)).hits.tolist() == rank(blind, len(data)).hits.tolist()


def test_a_relation_in_both_spellings_is_one_triple():
    """left(a, b) and right(b, a): not given in one spelling and asked in the other."""
    objects = tuple(AnnotatedObject(id=k, label=label) for k, label in enumerate(("bed", "lamp")))
    twice = AnnotatedScene(
        scene_id="s",
        source="toy",
        group="g",
        room_type=None,
        objects=objects,
        relations=((0, "left", 1), (1, "right", 0)),
    )
    vocabulary = Vocabulary([ObjectClass("bed"), ObjectClass("lamp")])
    data = tensors(encode([twice], vocabulary), len(vocabulary))
    structure = torch.zeros(len(vocabulary), dtype=torch.bool)
    ranking = rank(complete_scenes(data, structure, flat), 1)
    assert ranking.skipped == 1


def test_the_split_depends_on_the_scene_alone():
    whole = complete_scenes(DATA, WIDE_STRUCTURE, flat)
    alone = [
        asked
        for entry in DATA.scenes
        for asked in complete_scenes(tensors([entry], WIDE), WIDE_STRUCTURE, flat)
    ]
    assert [entry.key.tolist() for entry in whole] == [entry.key.tolist() for entry in alone]
    other = complete_scenes(DATA, WIDE_STRUCTURE, flat, seed=1)
    assert [x.key.tolist() for x in whole] != [x.key.tolist() for x in other]


def test_classes_related_both_ways_are_stated_of_different_instances():
    """Two lamps on either side of a bed: left(lamp, bed) and left(bed, lamp) hold of classes."""
    artifact = artifact_of(larger_machine("triway-local"))
    both = scene([0, 1, 1], [(0, 0, 1), (0, 1, 0)])
    data = tensors([both, scene([0, 1, 1], [(0, 0, 1)])], artifact.spec.V)
    batch = data.batch(torch.arange(2))
    told = telling(batch, batch.holds > 0)
    values = relation_score(artifact, given=True)(told)
    blind = relation_score(artifact, given=False)(told)
    assert torch.isfinite(values).all()
    assert not torch.allclose(values[0], values[1])
    torch.testing.assert_close(blind[0], blind[1])
