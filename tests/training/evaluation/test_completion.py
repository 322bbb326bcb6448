"""T1b: what is given and what is asked, and agreement with the service."""

from __future__ import annotations

import dataclasses

import pytest
import torch

from app.reasoning.posterior import posterior
from app.scene import ObjectClass, Scene, SceneObject, Vocabulary
from tests.reasoning.artifacts import LARGER, artifact_of
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    flat,
    knowing,
    random_scenes,
    scene,
    tensors,
)
from training.datasets import AnnotatedObject, AnnotatedScene, encode
from training.evaluation.completion import complete_scenes, given_score, given_units, random_half
from training.evaluation.relations import rank, spread_units, telling
from training.evaluation.scores import machine_scores
from training.machines import Triway, build
from training.machines.log_odds import relation_log_odds
from training.machines.mean_field import Evidence
from training.oracle.units import NO_UNIT

DATA = tensors(random_scenes(20), WIDE)


def larger_machine(name):
    spec = LARGER[name]
    generator = torch.Generator().manual_seed(3)
    machine = build(spec)
    keys = torch.randperm(spec.A * spec.V**2, generator=generator)[: spec.T].sort().values
    V = spec.V
    table = torch.stack([keys // V // V, keys // V % V, keys % V], 1)
    machine.set_triples(table.int()).initialise(generator, 0.7)
    with torch.no_grad():
        machine.b.copy_(torch.randn(V, generator=generator))
    return machine.requires_grad_(False)


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


def in_scene(instance_classes, triples=()):
    """What a robot would post: objects, and relations between the first of each class."""
    first = {int(c): k for k, c in reversed(list(enumerate(instance_classes)))}
    things = tuple(SceneObject(str(k), "x", int(c)) for k, c in enumerate(instance_classes))
    return Scene(things, tuple((a, first[i], first[j]) for a, i, j in triples))


@pytest.mark.parametrize("name", LARGER)
def test_the_scores_are_the_service_s(name):
    """T1a knows no relation; T1b judges observed ones without themselves, the others given them."""
    machine = larger_machine(name)
    artifact, scores = artifact_of(machine), machine_scores(machine)
    given = [(0, 1, 2), (1, 5, 0), (3, 2, 6)]
    entry = scene([0, 1, 2, 5, 5, 6], given)
    # A larger scene beside it pads its rows. The seed form draws, even where nothing is given, and
    # draws depend on the scene beside.
    local = machine.spec.form == "local"
    beside = [scene([0, 1, 2, 3, 4, 5, 6, 7], [(0, 1, 2)])] if local else []
    data = tensors([entry, *beside], machine.spec.V)
    batch = data.batch(torch.arange(len(data)))
    batch = telling(batch, batch.holds > 0)
    n = len(entry.evidence.classes)
    for score, triples in ((scores.completion, given), (scores.relations, ()))[: 1 + local]:
        asked = posterior(artifact, in_scene(entry.instance_classes, triples))
        ours = score(batch)[0, :, :n, :n].clamp(min=NO_UNIT)
        expected = torch.from_numpy(asked.relation_log_odds())
        torch.testing.assert_close(ours, expected, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("name", LARGER)
def test_unobserved_relations_get_their_log_odds(name):
    machine = larger_machine(name)
    data = tensors(random_scenes(6, machine.spec.V), machine.spec.V)
    index = torch.arange(6)
    batch = data.batch(index)
    batch = telling(batch, random_half(batch.holds > 0, data, index, seed=0))
    edges, r, observed = given_units(machine, batch)
    expected, _ = relation_log_odds(machine, edges, Evidence(batch.v, edges, r, observed))
    if isinstance(machine, Triway):
        expected = expected.view(batch.holds.shape)
        assert bool(observed.any())
    else:
        expected = spread_units(machine, batch.classes, expected)
    # Further out, 1 - p has few digits left in single precision.
    sure = ~batch.observed & (expected.abs() < 6)
    assert int(sure.sum()) > 0
    torch.testing.assert_close(
        given_score(machine)(batch)[sure], expected[sure], rtol=1e-3, atol=1e-3
    )
