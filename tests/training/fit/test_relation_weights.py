import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from app.scene.spatial_relations import ABOVE, CANONICAL, INSIDE, LEFT, ON_TOP, STACKED
from tests.enumeration.small_machines import random_weights
from tests.training.evaluation.scenes import V, scene, tensors, toy
from training.fit.configuration import RelationsConfig
from training.fit.relation_weights import (
    SHARED,
    RelationFit,
    bake_shared_weights,
    lower_unseen_roles,
    means_of_parts,
    share_weights,
    with_counted_residuals,
)
from training.machines import MachineSpec, build
from training.machines.edges import SceneRelations
from training.machines.machine import OBJECT_WEIGHTS

CONFIG = RelationsConfig(
    epochs=25, batch_size=20, learning_rate=0.1, offset_prior=0.1, weight_prior=0.1, averaging=0.9
)
SPECS = {
    "rbm": MachineSpec("rbm", V=V, A=2, units=2, states=3, T=6),
    "triway": MachineSpec("triway", V=V, A=2, units=2, states=3, K=2, T=6),
    "triway-implications": MachineSpec("triway", V=V, A=2, units=4, K=2, T=6, G=2),
}
TRIPLES = torch.tensor([[0, 1, 2], [0, 2, 1], [0, 3, 4], [1, 1, 2], [1, 3, 4], [1, 4, 3]])
NO_PARENTS, NO_WORDS = torch.full((V,), -1), torch.zeros(V, 0)


@pytest.fixture(params=SPECS)
def machine(request):
    return machine_of(request.param)


def machine_of(name, seed=0):
    """With object weights that stay as they are, as after the first phase."""
    machine = build(SPECS[name]).set_triples(TRIPLES)
    machine.initialise(torch.Generator().manual_seed(seed), 0.1)
    for weight in set(OBJECT_WEIGHTS) - {"L", "Y"}:
        machine.get_parameter(weight).requires_grad_(False)
    return machine


def annotated(triple, holds, source):
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


def trained(machine, scenes, **changes):
    fit = RelationFit(machine, scenes, CONFIG.model_copy(update=changes), seed=0)
    while not fit.finished:
        fit.epoch(lambda *_: None)
    return fit.finish(torch.full((machine.spec.V,), -1)), fit


def of_whole_scenes(machine, batch, generator):
    with torch.no_grad():
        return machine.state_means(machine.hidden_logits(batch.v))


def logit_of(machine, a, i, j):
    """Of a relation between two classes of a scene with 0, with the hidden units at their mean."""
    batch = whole(tensors([toy(sorted({0, i, j}), [(a, i, j)])]))
    edges, r, _ = machine.lay_out(batch)
    with torch.no_grad():
        logits = machine.relation_logits(edges, batch.v, of_whole_scenes(machine, batch, None))
    return float(logits[r > 0])


def loss_of(machine, batch, scenes, config=CONFIG):
    fit = RelationFit(machine, scenes, config, seed=0)
    return fit.loss(batch, torch.Generator().manual_seed(3)).item()


def test_offsets_absorb_how_often_a_source_lists_a_relation(machine):
    """Listed of four in five pairs here, of one in five there: 2.8 nats apart. The machine stays
    between, and keeps no offset."""
    keys = set(machine.state_dict())
    objects = {
        name: machine.get_parameter(name).clone() for name in OBJECT_WEIGHTS if name not in "LY"
    }
    final, fit = trained(machine, scenes_of({"captions": 0.8, "rooms": 0.2}))
    offset = fit.offsets.detach()
    assert float(offset[0, 0] - offset[1, 0]) == pytest.approx(2 * math.log(4), abs=0.3)
    assert abs(logit_of(final, 0, 1, 2)) < 1.0
    assert set(final.state_dict()) == keys
    assert all(torch.equal(final.get_parameter(name), w) for name, w in objects.items())


def test_the_prior_holds_offsets_small():
    scenes = scenes_of({"captions": 0.8, "rooms": 0.2})
    _, fit = trained(machine_of("triway"), scenes, offset_prior=1e4)
    assert float(fit.offsets.detach().abs().max()) < 0.1


def test_a_source_without_weight_teaches_nothing():
    scenes = scenes_of({"captions": 1.0, "rooms": 0.2})
    final, fit = trained(machine_of("triway"), scenes, source_weights={"captions": 0.0})
    offsets = fit.offsets.detach()
    assert float(offsets[0].abs().max()) < 1e-3
    p = 1 / (1 + math.exp(-logit_of(final, 0, 1, 2) - float(offsets[1, 0])))
    assert p == pytest.approx(0.2, abs=0.07)


def test_unknown_units_do_not_change_the_loss(machine):
    scenes = scenes_of({"captions": 0.5})
    batch = whole(scenes)
    unknown = torch.rand(batch.holds.shape, generator=torch.Generator().manual_seed(1)) < 0.5
    batch = replace(batch, observed=batch.observed & ~unknown)
    flipped = replace(batch, holds=torch.where(batch.observed, batch.holds, 1 - batch.holds))
    assert not torch.equal(batch.holds, flipped.holds)
    assert loss_of(machine, flipped, scenes) == loss_of(machine, batch, scenes)
    known = replace(batch, holds=torch.where(batch.observed, 1 - batch.holds, batch.holds))
    assert loss_of(machine, known, scenes) != loss_of(machine, batch, scenes)


def test_relations_have_the_layout_of_their_machine(machine):
    """Units have the values of their triples. RBM: units of absent classes are observed off."""
    generator = torch.Generator().manual_seed(0)
    classes = torch.tensor([[4, 1, 3], [2, 1, -1]])
    observed = (torch.rand(2, 2, 3, 3, generator=generator) < 0.7) & (
        (classes >= 0).view(2, 1, 3, 1) & (classes >= 0).view(2, 1, 1, 3)
    )
    holds = observed & (torch.rand(2, 2, 3, 3, generator=generator) < 0.5)
    relations = SceneRelations(classes, classes.clamp(max=1), holds.float(), observed)
    edges, r, seen = machine.lay_out(relations)
    for row in range(2):
        table = {
            (a, int(classes[row, x]), int(classes[row, y])): holds[row, a, x, y].item()
            for a, x, y in observed[row].nonzero().tolist()
        }
        off = dict.fromkeys(map(tuple, TRIPLES.tolist()), False) if machine.spec.K == 0 else {}
        off = {
            (a, i, j): v for (a, i, j), v in off.items() if not {i, j} <= set(classes[row].tolist())
        }
        where = [
            part.expand_as(r)[row].tolist()
            for part in (edges.relation, edges.subject, edges.object)
        ]
        units = list(zip(*where, strict=True))
        found = {unit: bool(r[row, e]) for e, unit in enumerate(units) if seen[row, e]}
        expected = off | {unit: value for unit, value in table.items() if unit in set(units)}
        assert found == expected
        assert len(found) > 2


def test_hidden_units_depend_on_a_random_part_of_the_objects():
    """W is such that x is the number of listed classes and the room type, minus 10. Of 4,000 scenes
    of 39 objects: five standard errors of the mean, the spread and the room share."""
    machine = build(MachineSpec("rbm", V=40, A=1, units=2, C=1)).requires_grad_(False)
    machine.W[:, 0], machine.Q[0, 1] = 0.1, 5.0
    scenes = tensors([toy(list(range(39)), room=0)], 40)
    batch = scenes.batch(torch.zeros(4000, dtype=torch.int64))
    means = means_of_parts(machine, batch, torch.Generator().manual_seed(0)).logit()
    share = means[:, 0] / 3.9
    assert float(share.mean()) == pytest.approx(0.5, abs=5 * 0.3 / 4000**0.5)
    # The chance is uniform, and the number is binomial.
    assert float(share.var()) == pytest.approx(1 / 12 + 1 / 6 / 39, abs=0.007)
    assert float((means[:, 1] > 2).float().mean()) == pytest.approx(0.5, abs=5 * 0.5 / 4000**0.5)


def test_the_loss_is_the_mean_over_scenes_and_the_prior_of_one(monkeypatch):
    """With hidden units that depend on all objects."""
    monkeypatch.setattr("training.fit.relation_weights.means_of_parts", of_whole_scenes)
    scenes, machine = scenes_of({"captions": 0.5}), machine_of("triway")
    batch = whole(scenes)
    nothing = replace(batch, observed=torch.zeros_like(batch.observed))
    prior = loss_of(machine, nothing, scenes)
    squares = sum(
        float((machine.get_parameter(name).detach() ** 2).sum()) * (0.1 if name in "Rn" else 1.0)
        for name in ("s", "o", "S", "O", "R", "M", "P", "n", "residual")
    )
    assert prior == pytest.approx(0.5 * CONFIG.weight_prior * squares / len(scenes), rel=1e-4)
    edges, r, observed = machine.lay_out(batch)
    h1 = of_whole_scenes(machine, batch, None)
    logits = machine.relation_logits(edges, batch.v, h1).detach()
    log_p = torch.distributions.Bernoulli(logits=logits).log_prob(r)
    known = observed * machine.gate(edges, batch.v)
    expected = -float((log_p * known).sum()) / len(batch) + prior
    assert loss_of(machine, batch, scenes) == pytest.approx(expected, rel=1e-5)


def test_implications_learn_that_one_relation_excludes_another():
    """left(1, 2) and left(2, 1) never hold together, each in half of the scenes."""
    pairs = [(1, 2), (2, 1)] * 20
    scenes = tensors([toy([0, 1, 2], [(0, *pair)], source="captions") for pair in pairs])
    final, _ = trained(machine_of("triway-implications"), scenes)
    edges = final.edges(torch.tensor([[1, 2]]))
    holds = (edges.relation == 0) & (edges.subject == 1) & (edges.object == 2)
    shift = final.implied(edges, holds.float(), torch.full((1, 4), 0.5)).detach()
    other = (edges.relation == 0) & (edges.subject == 2) & (edges.object == 1)
    assert float(shift[other]) < -1.5


@given(st.integers(0, 2**32), st.integers(0, 3))
def test_shared_weights_are_the_sum_of_their_parts(seed, dimensions):
    """Own deviation, that of the parent and a map of the words; the sum stays after baking."""
    generator = torch.Generator().manual_seed(seed)
    machine = random_weights(build(SPECS["triway"]), generator)
    keys = set(machine.state_dict())
    words = torch.randn(V, dimensions, generator=generator)
    parents = torch.randint(-1, V, (V,), generator=generator)
    own = {name: machine.get_parameter(name).clone() for name in ("W", "S", "s")}
    share_weights(machine, words, parents, ["W", "S", "absent", "s"])
    assert set(machine.state_dict()) != keys
    for name, deviation in own.items():
        sharing = machine.parametrizations[name][0]
        with torch.no_grad():
            sharing.map.copy_(torch.randn(sharing.map.shape, generator=generator))
        rows = deviation.T if name == "s" else deviation
        for i in range(V):
            expected = rows[i] + (rows[parents[i]] if parents[i] >= 0 else 0)
            expected = expected + sum(words[i, k] * sharing.map[k] for k in range(dimensions))
            shared = getattr(machine, name)
            torch.testing.assert_close((shared.T if name == "s" else shared)[i], expected)
    before = {name: getattr(machine, name).detach().clone() for name in own}
    bake_shared_weights(machine, ["W", "S", "s", "O"])
    assert set(machine.state_dict()) == keys
    assert all(torch.equal(machine.get_parameter(name), w) for name, w in before.items())


def vectors():
    """Class 0 unlike all others, 1 like 3, and 2 like 4."""
    found = torch.zeros(V, 3)
    found[0, 0] = found[[1, 3], 1] = found[[2, 4], 2] = 1.0
    return found


@pytest.mark.parametrize(
    ("words", "parents"),
    [(vectors(), NO_PARENTS), (NO_WORDS, torch.tensor([-1, -1, -1, 1, 2]))],
    ids=["words", "parents"],
)
def test_a_class_that_was_never_seen_behaves_like_its_neighbour(words, parents):
    """left(1, 2) holds always and left(2, 1) never; of 3 and 4 nothing was seen."""
    seen = tensors([toy([0, 1, 2], [(0, 1, 2)], source="captions") for _ in range(40)])
    differences = []
    for kind in ((NO_WORDS, NO_PARENTS), (words, parents)):
        machine = machine_of("triway")
        share_weights(machine, *kind, SHARED)
        final, _ = trained(machine, seen, weight_prior=1.0)
        differences.append(logit_of(final, 0, 3, 4) - logit_of(final, 0, 4, 3))
    without, informed = differences
    assert abs(without) < 0.5
    assert informed > 1.5


LISTED = {(0, 1, 2): (18, 2), (0, 3, 4): (4, 8), (1, 0, 3): (0, 12)}
"""Per triple: scenes that list it, and scenes that observe that it does not hold."""


@pytest.mark.parametrize("weights", [(1.0, 1.0), (0.5, 2.0)])
def test_residuals_maximise_the_likelihood_of_triples_under_a_normal_prior(monkeypatch, weights):
    """At the mode the slope of the log-likelihood is τ δ, with one precision τ for all triples."""
    monkeypatch.setattr("training.fit.relation_weights.means_of_parts", of_whole_scenes)
    every = [
        annotated(triple, k < true, "captions" if k % 2 else "rooms")
        for triple, (true, false) in LISTED.items()
        for k in range(true + false)
    ]
    scenes, machine = tensors(every), machine_of("triway")
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
    edges, r, observed = found.lay_out(batch)
    with torch.no_grad():
        h1 = of_whole_scenes(found, batch, None)
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


DESK, LAMP, TABLE_LAMP, FLOOR_LAMP, WINDOW = range(V)
KINDS = torch.tensor([-1, -1, LAMP, LAMP, -1])


def lowered(scenes, parents):
    spec = MachineSpec("triway", V=V, A=len(CANONICAL), units=2, states=3, K=2)
    machine = build(spec).initialise(torch.Generator().manual_seed(0), 0.1)
    before = {name: machine.get_parameter(name).detach().clone() for name in ("s", "o")}
    lower_unseen_roles(machine, tensors(scenes), parents)
    changes = [machine.get_parameter(name).detach() - before[name] for name in ("s", "o")]
    # A change is 0 or -6.
    assert all(torch.isin((change * 1e3).round(), torch.tensor([0.0, -6e3])).all()
               for change in changes)  # fmt: skip
    return [[set(row.nonzero().flatten().tolist()) for row in change] for change in changes]


def shown(*triples, count=10, classes=range(V), **options):
    return [scene(list(classes), triples, **options) for _ in range(count)]


def test_classes_that_no_scene_shows_in_a_role_get_lower_weights():
    """A table lamp stands on a desk: so does a lamp, and no other kind of lamp."""
    subjects, objects = lowered(shown((ON_TOP, TABLE_LAMP, DESK)), KINDS)
    assert subjects[ON_TOP] == {DESK, FLOOR_LAMP, WINDOW}
    assert objects[ON_TOP] == {LAMP, TABLE_LAMP, FLOOR_LAMP, WINDOW}
    # No scene shows objects in or above each other. Sides are no roles.
    for a in (ABOVE, INSIDE):
        assert subjects[a] == objects[a] == set(range(V))
    assert subjects[LEFT] == objects[LEFT] == set()


def test_kinds_have_the_roles_of_their_parent():
    scenes = shown((INSIDE, LAMP, WINDOW), (ABOVE, WINDOW, LAMP))
    subjects, objects = lowered(scenes, KINDS)
    assert subjects[INSIDE] == objects[ABOVE] == {DESK, WINDOW}
    subjects, objects = lowered(scenes, NO_PARENTS)
    assert subjects[INSIDE] == objects[ABOVE] == {DESK, TABLE_LAMP, FLOOR_LAMP, WINDOW}


def test_classes_with_few_annotated_scenes_keep_their_weights():
    """Nine scenes annotate the window, and ten scenes the desk."""
    scenes = shown(count=9) + shown(classes=[DESK, LAMP], count=1)
    scenes += shown(classes=[WINDOW, FLOOR_LAMP], annotated=False)
    subjects, objects = lowered(scenes, NO_PARENTS)
    for a in STACKED:
        assert subjects[a] == objects[a] == {DESK, LAMP}


def test_a_batch_has_the_relations_of_some_classes_of_a_large_scene() -> None:
    """Every pair of 30 classes occurs in some of 400 parts; one is absent with p < 1e-70."""
    triples = [(ON_TOP, k, k + 1) for k in range(29)]
    large = tensors([scene(range(30), triples), scene([0, 1], [(ON_TOP, 0, 1)])], 30)
    machine = build(MachineSpec("triway", V=30, A=len(CANONICAL), units=2, K=1))
    fit = RelationFit(machine, large, RelationsConfig(), seed=0)
    held = torch.zeros(30, 30)
    for _ in range(400):
        batch = large.batch(torch.arange(2), part=fit._part)
        assert (batch.classes >= 0).sum(1).tolist() == [20, 2]
        assert batch.v.sum(1).tolist() == [30, 2]
        classes = batch.classes[0]
        subject, other = batch.holds[0, ON_TOP].nonzero(as_tuple=True)
        held[classes[subject], classes[other]] += 1
    assert {(i, j) for i, j in held.nonzero().tolist()} == {(k, k + 1) for _, k, _ in triples}
