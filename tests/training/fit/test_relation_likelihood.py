"""The relation likelihood: offsets of sources, unknown units, and the prior of word vectors."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import V, tensors, toy
from training.datasets.batches import relation_units
from training.fit.configuration import ObjectiveConfig
from training.fit.objectives.relation_likelihood import (
    RelationLikelihood,
    bake_word_prior,
    hide_objects,
    with_counted_residuals,
)
from training.machines import MachineSpec, build

CONFIG = ObjectiveConfig(name="relations", room_dropout=0.0, offset_prior=0.1, weight_prior=0.1)
SPECS = {
    "rbm": MachineSpec("rbm", V=V, A=2, H1=4, T=6, form="local"),
    "triway": MachineSpec("triway", V=V, A=2, H1=4, K=2, T=6, form="local"),
    "triway-implications": MachineSpec("triway", V=V, A=2, H1=4, K=2, T=6, G=2, form="local"),
}
TRIPLES = torch.tensor([[0, 1, 2], [0, 2, 1], [0, 3, 4], [1, 1, 2], [1, 3, 4], [1, 4, 3]])


@pytest.fixture(params=SPECS)
def machine(request):
    return machine_of(request.param)


def machine_of(name, seed=0):
    machine = build(SPECS[name]).set_triples(TRIPLES)
    return machine.initialise(torch.Generator().manual_seed(seed), 0.1)


def annotated(triple, holds, source):
    """A scene of all classes, which observes one relation."""
    one = toy([0, 1, 2, 3, 4], [triple] if holds else [], source=source)
    observed = np.zeros_like(one.evidence.observed)
    observed[triple] = True
    return replace(one, evidence=replace(one.evidence, observed=observed))


def scenes_of(shares, count=40):
    """Scenes by source. Each observes left(1, 2) or left(3, 4), and a share of them lists it."""
    every = [
        annotated((0, 1, 2) if k % 2 else (0, 3, 4), k // 2 < share * count / 2, source)
        for source, share in shares.items()
        for k in range(count)
    ]
    return tensors(every)


def whole(scenes):
    return scenes.batch(torch.arange(len(scenes)))


def trained(machine, scenes, config=CONFIG, words=None, steps=200):
    objective = RelationLikelihood(config, machine, scenes, words)
    for name, weight in machine.named_parameters():
        weight.requires_grad_(name not in ("b", "c1", "c2", "W", "J", "Q"))
    chosen = [p for p in machine.parameters() if p.requires_grad and p.numel()]
    optimiser = torch.optim.Adam([*chosen, *objective.parameters()], lr=0.1)
    generator, batch = torch.Generator().manual_seed(0), whole(scenes)
    for _ in range(steps):
        loss = objective.loss(machine, batch, generator)
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    return objective


def logit_of(machine, a, i, j):
    """Of a relation between two classes of a scene with 0, with the context at its mean."""
    batch = whole(tensors([toy(sorted({0, i, j}), [(a, i, j)])]))
    edges, r, _ = relation_units(machine, batch)
    with torch.no_grad():
        h1 = (machine.c1 + batch.v @ machine.W).sigmoid()
        logits = machine.relation_logits(edges, batch.v, h1)
    return float(logits[r > 0])


def loss_of(machine, batch, scenes, config=CONFIG, words=None):
    objective = RelationLikelihood(config, machine, scenes, words)
    return float(objective.loss(machine, batch, torch.Generator().manual_seed(3)).detach())


# ----------------------------------------------------------------------------------------- offsets


def test_offsets_absorb_how_often_a_source_lists_a_relation(machine):
    """Listed of four in five pairs here, of one in five there: 2.8 nats apart. The machine stays
    between, and keeps no offset."""
    scenes = scenes_of({"captions": 0.8, "rooms": 0.2})
    keys = set(machine.state_dict())
    objective = trained(machine, scenes)
    offset = objective.offsets.detach()
    assert offset.shape == (2, 2)
    assert float(offset[0, 0] - offset[1, 0]) == pytest.approx(2 * math.log(4), abs=0.3)
    assert abs(logit_of(machine, 0, 1, 2)) < 1.0
    assert set(machine.state_dict()) == keys
    if machine.spec.G:
        # It also learns from scenes of which some of what holds is given: of the rest, less holds.
        return
    for source, share in enumerate((0.8, 0.2)):
        p = 1 / (1 + math.exp(-logit_of(machine, 0, 1, 2) - float(offset[source, 0])))
        assert p == pytest.approx(share, abs=0.05)


def test_the_prior_holds_offsets_small():
    scenes = scenes_of({"captions": 0.8, "rooms": 0.2})
    held = CONFIG.model_copy(update={"offset_prior": 1e4})
    objective = trained(machine_of("triway"), scenes, held)
    assert float(objective.offsets.detach().abs().max()) < 0.1


def test_a_source_without_weight_teaches_nothing():
    scenes = scenes_of({"captions": 1.0, "rooms": 0.2})
    some = CONFIG.model_copy(update={"source_weights": {"captions": 0.0}})
    machine = machine_of("triway")
    objective = trained(machine, scenes, some)
    assert float(objective.offsets.detach()[0].abs().max()) < 1e-3
    p = 1 / (1 + math.exp(-logit_of(machine, 0, 1, 2) - float(objective.offsets[1, 0].detach())))
    assert p == pytest.approx(0.2, abs=0.05)


# ------------------------------------------------------------------------------------------- units


def test_unknown_units_do_not_change_the_loss(machine):
    """Whatever stands where nothing was observed."""
    scenes = scenes_of({"captions": 0.5})
    batch = whole(scenes)
    unknown = torch.rand(batch.holds.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    batch = replace(batch, observed=batch.observed & ~unknown)
    flipped = replace(batch, holds=torch.where(batch.observed, batch.holds, 1 - batch.holds))
    assert not torch.equal(batch.holds, flipped.holds)
    assert loss_of(machine, flipped, scenes) == loss_of(machine, batch, scenes)
    known = replace(batch, holds=torch.where(batch.observed, 1 - batch.holds, batch.holds))
    assert loss_of(machine, known, scenes) != loss_of(machine, batch, scenes)


def test_the_context_sees_a_share_of_the_objects_uniform_over_scenes():
    """Of 2,000 scenes of 40 objects; five standard errors of the mean and of the spread."""
    v = (torch.rand(2000, 50, generator=torch.Generator().manual_seed(1)) < 0.8).float()
    shown = hide_objects(v, torch.Generator().manual_seed(0))
    assert bool((shown <= v).all())
    share = shown.sum(1) / v.sum(1)
    assert float(share.mean()) == pytest.approx(0.5, abs=5 * 0.3 / 2000**0.5)
    # Uniform, and binomial within a scene.
    assert float(share.var()) == pytest.approx(1 / 12 + 1 / 6 / 40, abs=0.01)


def test_the_loss_is_the_mean_over_scenes_and_the_prior_of_one(monkeypatch):
    """With a context that sees all objects."""
    monkeypatch.setattr("training.fit.objectives.relation_likelihood.hide_objects", lambda v, _: v)
    scenes, machine = scenes_of({"captions": 0.5}), machine_of("triway")
    batch = whole(scenes)
    nothing = replace(batch, observed=torch.zeros_like(batch.observed))
    prior = loss_of(machine, nothing, scenes)
    squares = sum(
        float((machine.get_parameter(name).detach() ** 2).sum()) * (0.1 if name in "Rn" else 1.0)
        for name in ("s", "o", "S", "O", "R", "M", "P", "n", "residual")
    )
    assert prior == pytest.approx(0.5 * CONFIG.weight_prior * squares / len(scenes), rel=1e-4)
    edges, r, observed = relation_units(machine, batch)
    h1 = (machine.c1 + batch.v @ machine.W).sigmoid()
    logits = machine.relation_logits(edges, batch.v, h1).detach()
    known = observed * machine.gate(edges, batch.v)
    log_p = torch.distributions.Bernoulli(logits=logits).log_prob(r) * known
    expected = -float(log_p.sum()) / len(batch) + prior
    assert loss_of(machine, batch, scenes) == pytest.approx(expected, rel=1e-5)


# ------------------------------------------------------------------------------------------- words

WORDS = CONFIG.model_copy(update={"word_weight": 1.0})


def vectors():
    """Class 0 unlike all others, 1 like 3, and 2 like 4."""
    found = torch.zeros(V, 3)
    found[0, 0] = found[[1, 3], 1] = found[[2, 4], 2] = 1.0
    return found


@pytest.mark.parametrize("name", ["triway", "triway-implications"])
def test_the_word_prior_becomes_part_of_plain_weights(name):
    """The same logits to the last bit, and no weight but a machine's own."""
    machine, scenes = machine_of(name), scenes_of({"captions": 0.7})
    keys, names = set(machine.state_dict()), {n for n, _ in machine.named_parameters()}
    trained(machine, scenes, WORDS, vectors(), steps=30)
    assert set(machine.state_dict()) != keys
    batch = whole(scenes)
    edges, _, _ = relation_units(machine, batch)
    h1 = torch.full((len(batch), 4), 0.3)
    before = machine.relation_logits(edges, batch.v, h1).detach()
    S = machine.S.detach().clone()
    bake_word_prior(machine)
    assert torch.equal(machine.relation_logits(edges, batch.v, h1).detach(), before)
    assert torch.equal(machine.get_parameter("S"), S)
    assert set(machine.state_dict()) == keys
    assert {n for n, _ in machine.named_parameters()} == names
    bake_word_prior(machine)
    assert torch.equal(machine.get_parameter("S"), S)


def test_a_class_that_was_never_seen_behaves_like_its_neighbour():
    """left(1, 2) holds always and left(2, 1) never; of 3 and 4 nothing was seen."""
    seen = tensors([toy([0, 1, 2], [(0, 1, 2)], source="captions") for _ in range(20)])
    strong = WORDS.model_copy(update={"weight_prior": 1.0})
    differences = []
    for words in (None, vectors()):
        machine = machine_of("triway")
        trained(machine, seen, strong, words)
        differences.append(logit_of(machine, 0, 3, 4) - logit_of(machine, 0, 4, 3))
    without, informed = differences
    assert abs(without) < 0.5
    assert informed > 1.5


def test_machines_without_factors_have_no_word_prior():
    machine, scenes = machine_of("rbm"), scenes_of({"captions": 0.7})
    keys = set(machine.state_dict())
    RelationLikelihood(WORDS, machine, scenes, vectors())
    assert set(machine.state_dict()) == keys


# --------------------------------------------------------------------------------------- residuals

LISTED = {(0, 1, 2): (18, 2), (0, 3, 4): (4, 8), (1, 0, 3): (0, 12)}
"""Per triple: scenes that list it, and scenes that observe that it does not hold."""


def listed_scenes():
    """Scenes of two sources; each observes one triple of `LISTED`."""
    every = [
        annotated(triple, k < true, "captions" if k % 2 else "rooms")
        for triple, (true, false) in LISTED.items()
        for k in range(true + false)
    ]
    return tensors(every)


@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.5, 2.0)])
def test_residuals_maximise_the_likelihood_of_triples_under_a_normal_prior(monkeypatch, weights):
    """At the mode the slope of the log-likelihood is τ δ, with one precision τ for all triples."""
    monkeypatch.setattr("training.fit.objectives.relation_likelihood.hide_objects", lambda v, _: v)
    scenes, machine = listed_scenes(), machine_of("triway")
    with torch.no_grad():
        machine.residual.copy_(torch.linspace(-0.3, 0.3, 6))
    offsets, source_weights = torch.tensor([[0.4, 0.1], [-0.6, 0.2]]), torch.tensor(weights)
    found = with_counted_residuals(machine, scenes, offsets, source_weights)
    before, after = (
        dict(zip(map(tuple, m.triples.tolist()), m.residual.tolist(), strict=True))
        for m in (machine, found)
    )
    assert set(after) == set(before) | {(1, 0, 3)}
    assert all(after[key] == before[key] for key in set(before) - set(LISTED))
    batch = whole(scenes)
    edges, r, observed = relation_units(found, batch)
    with torch.no_grad():
        h1 = (found.c1 + batch.v @ found.W).sigmoid()
        logits = found.relation_logits(edges, batch.v, h1)
    p = (logits + offsets[batch.source].gather(1, edges.relation.expand_as(logits))).sigmoid()
    error = observed * (r - p) * source_weights[batch.source].unsqueeze(1)
    relation, subject, object_ = (
        part.expand_as(logits) for part in (edges.relation, edges.subject, edges.object)
    )
    precision = []
    for key, (on, off) in LISTED.items():
        a, i, j = key
        unit = (relation == a) & (subject == i) & (object_ == j)
        assert int((observed * unit).sum()) == on + off
        precision.append(float(error[unit].sum()) / (after[key] - before.get(key, 0.0)))
    assert precision[0] > 0
    assert precision == pytest.approx([precision[0]] * 3, rel=1e-3)
