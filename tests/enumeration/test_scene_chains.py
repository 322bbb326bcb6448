"""Compiled chains leave p stationary (as in `test_gibbs`), and draw relations given v and h1."""

import copy
from itertools import product

import numpy as np
import pytest
import torch

from app.inference.chains import OTHER_ROOM, ChainState, Conditions, SceneChains, random_stream
from app.inference.relation_units import ObservedRelations
from app.inference.weights import pack_scenes
from tests.enumeration.small_machines import (
    SMALL,
    binary,
    check_frequencies,
    code,
    enumerate_joint,
    implied_by_hand,
    random_weights,
    same,
    small_machine,
    with_mean_rates,
)
from training.machines import MachineSpec, build, weights_of
from training.machines.machine import OBJECT_WEIGHTS

CHAINS, RELATION_DRAWS = 10_000, 4_000


def conditions(classes=(), relations=(), **options):
    """Relations are (a, i, j, r), i and j indices into classes."""
    a, i, j, r = np.array(relations, dtype=np.int64).reshape(-1, 4).T.copy()
    return Conditions(
        classes=np.array(classes, dtype=np.int64),
        observed=ObservedRelations(a, i, j, r.astype(np.float32)) if relations else None,
        **options,
    )


def one_hot(states, Z):
    """h1 (..., H1) of the states (..., units)."""
    return (states[..., None] == np.arange(1, Z)).reshape(*states.shape[:-1], -1).astype(float)


def at_temperature(machine, beta):
    """The machine whose weights between objects and hidden units are multiplied by beta."""
    scaled = copy.deepcopy(machine)
    for name in {*OBJECT_WEIGHTS, "u"} & dict(machine.named_parameters()).keys():
        scaled.get_parameter(name).mul_(beta)
    return scaled


def check_stationary(name, condition, given, beta=1.0):
    single = small_machine(name).float()
    spec, double, source = single.spec, copy.deepcopy(single).double(), condition.profile
    if source is None:
        double, source = with_mean_rates(single, condition.classes), -1
    joint = enumerate_joint(at_temperature(double, beta), condition.room, source=source)
    where = given(joint)
    keys, which = np.unique(code(joint.v, joint.h1), return_inverse=True)
    p = torch.where(where, joint.p, 0.0).numpy()
    chains = SceneChains(weights_of(single)).under(condition, 1 / beta)
    pick = joint.draw(CHAINS, torch.Generator().manual_seed(1), where)
    v = joint.v[pick].numpy().astype(np.uint8)
    stream, h1 = random_stream(5, 0), np.zeros((CHAINS, spec.units), np.int64)
    for row in range(CHAINS):
        h1[row] = chains.sweep(v[row], 1, stream)
    drawn = code(v, one_hot(h1, spec.states))
    check_frequencies(drawn, keys, np.bincount(which, p / p.sum()))


@pytest.mark.parametrize("name", SMALL)
@pytest.mark.parametrize("beta", [1.0, 0.5])
def test_chains_are_stationary(name, beta):
    check_stationary(name, conditions(), lambda joint: joint.p >= 0, beta)


@pytest.mark.parametrize("profile", [None, 1])
@pytest.mark.parametrize("name", SMALL)
def test_chains_are_stationary_under_conditions(name, profile):
    """Without a profile, the base rates are their mean given the class."""
    spec = SMALL[name]
    room, profile = 1 if spec.C else None, profile if spec.profiles else None

    condition = conditions([1], room=room, profile=profile)
    check_stationary(name, condition, lambda joint: joint.v[:, 1] > 0)


def all_present(machine, temperature=1.0, relations=()):
    """Chains in which all classes are present, and the bias decides the states of h1."""
    spec = machine.spec
    states = (np.arange(spec.units) + 1) % spec.states
    decided = torch.from_numpy(one_hot(states, spec.states))
    with torch.no_grad():
        machine.c1.add_(60 * decided.to(machine.c1) - 30)
    chains = SceneChains(weights_of(machine))
    return chains.under(conditions(range(spec.V), relations), temperature), decided[None]


def drawn_relations(chains, classes):
    """Codes of the relations between different classes of drawn states."""
    off = ~np.eye(classes, dtype=bool)
    return np.array(
        [code(chains.draw(1, random_stream(0, k)).r[:, off].ravel()) for k in range(RELATION_DRAWS)]
    )


@pytest.mark.parametrize("temperature", [1.0, 1.6])
@pytest.mark.parametrize("name", [name for name, spec in SMALL.items() if not spec.G])
def test_relations_are_drawn_given_objects_and_hidden_units(name, temperature):
    machine = small_machine(name)
    spec = machine.spec
    chains, h1 = all_present(copy.deepcopy(machine).float(), temperature)
    edges = machine.edges(torch.arange(spec.V)[None])
    logits = np.full((spec.A, spec.V, spec.V), -np.inf)
    units = edges.relation[0], edges.subject[0], edges.object[0]
    logits[units] = machine.relation_logits(edges, torch.ones(1, spec.V).double(), h1)[0]
    on = 1 / (1 + np.exp(-logits[:, ~np.eye(spec.V, dtype=bool)].ravel() / temperature))
    states = binary(len(on)).numpy()
    law = np.where(states > 0, on, 1 - on).prod(1)
    check_frequencies(drawn_relations(chains, spec.V), np.arange(len(states)), law)


def implied_law(machine, observed):
    """The law of r (64,) between three classes, where each group depends on earlier groups."""
    off = [(i, j) for i in range(3) for j in range(3) if i != j]
    v, h1 = torch.ones(1, 3).double(), torch.tensor([[1.0, 0, 1]]).double()
    edges = machine.edges(torch.arange(3)[None])
    logits = machine.relation_logits(edges, v, h1).view(1, 3, 3)
    chance = np.zeros((64, 6))
    for mask, row in enumerate(binary(6)):
        grid = torch.zeros(1, 3, 3).double()
        grid[0, [i for i, _ in off], [j for _, j in off]] = row
        x = (logits + implied_by_hand(machine, v[0], grid))[0]
        chance[mask] = [float(x[pair].sigmoid()) for pair in off]
    # Of the relations a(i, j) and a(j, i), one is in the groups 0 to 3, and the other in 4 to 7.
    groups = product((0, 1), range(4), range(4))
    choices = [(4 * late + n, 4 * (1 - late) + k) for late, n, k in groups]
    group = np.zeros((32**3, 6), np.int64)
    for row, picked in zip(group, product(choices, repeat=3), strict=True):
        for (i, j), (first, second) in zip([(0, 1), (0, 2), (1, 2)], picked, strict=True):
            row[off.index((i, j))], row[off.index((j, i))] = first, second
    for i, j in observed:
        group[:, off.index((i, j))] = -1
    law = np.zeros(64)
    for mask, r in enumerate(binary(6).bool().tolist()):
        p = np.ones(len(group))
        for u, pair in enumerate(off):
            earlier = sum((group[:, w] < group[:, u]) * (r[w] << w) for w in range(6))
            on = chance[earlier, u] if pair not in observed else 1.0
            p *= on if r[u] else 1 - on
        law[mask] = p.mean()
    return law


@pytest.mark.parametrize("observed", [(), ((0, 2), (2, 1))])
def test_relations_that_imply_each_other_are_drawn_in_groups(observed):
    spec = MachineSpec("triway", V=3, A=1, units=3, K=2, G=2)
    machine = random_weights(build(spec), torch.Generator().manual_seed(4), 0.7)
    chains, _ = all_present(machine, relations=[(0, *pair, 1) for pair in observed])
    law = implied_law(machine.double(), observed)
    assert law.sum() == pytest.approx(1)
    check_frequencies(drawn_relations(chains, 3), np.arange(64), law)
    machine.gamma.zero_()
    assert 0.5 * np.abs(implied_law(machine, observed) - law).sum() > 0.15


STORED = MachineSpec("triway", V=12, A=2, units=4, states=3, C=3, K=2, N=24, coupled=True)


def log_weights_by_hand(machine, v, rooms, condition):
    """The log weight of each stored scene, (N,), from the formula of the module."""
    log_w = torch.zeros(len(v)).double()
    h1 = machine.state_means(machine.c1 + v @ machine.W)
    for i in condition.classes:
        log_w += (machine.b[i] + h1 @ machine.W[i] + v @ machine.couplings[i]).sigmoid().log()
    if condition.room is not None:
        has_room = rooms == condition.room
        log_w -= 0 if not has_room.any() else float(OTHER_ROOM) * ~has_room
        evidence = h1 @ machine.Q[condition.room] + v @ machine.Y[condition.room]
        log_w += 0 if has_room.any() else evidence
    return log_w


@pytest.mark.parametrize(
    "condition",
    [
        conditions(),
        conditions([3, 7]),
        conditions([5], room=1),
        conditions(room=2),  # no stored scene has this room type
    ],
)
def test_starts_are_weighed_by_the_evidence(condition):
    generator = torch.Generator().manual_seed(0)
    machine = random_weights(build(STORED), generator)
    v = (torch.rand(24, 12, generator=generator) < 0.3).double()
    rooms = torch.arange(24) % 3 - 1
    machine.fantasies.copy_(torch.from_numpy(pack_scenes(v.numpy())))
    machine.fantasy_rooms.copy_(rooms)
    found = SceneChains(weights_of(machine)).sample_weights(condition)
    expected = log_weights_by_hand(machine.double(), v, rooms, condition).softmax(0)
    np.testing.assert_allclose(found, expected, rtol=1e-4)


@pytest.mark.parametrize("room", [None, 1])
@pytest.mark.parametrize("name", [name for name, spec in SMALL.items() if not spec.G])
def test_log_score_is_the_log_probability(name, room):
    """log p(v, t) + log Z + log p(r | v, h1)."""
    machine = small_machine(name)
    spec = machine.spec
    room = room if spec.C else None
    joint = enumerate_joint(with_mean_rates(machine), room)
    chains = SceneChains(weights_of(machine)).under(conditions(room=room))
    every = np.arange(spec.V)
    for n in joint.draw(40, torch.Generator().manual_seed(0)).tolist():
        v, r = joint.v[n].numpy() > 0, np.zeros((spec.A, spec.V, spec.V), bool)
        e, is_on = joint.edges, joint.r[n] > 0
        r[e.relation[0, is_on], e.subject[0, is_on], e.object[0, is_on]] = True
        logits = np.full(r.shape, -1e4)
        of_units = machine.relation_logits(e, joint.v[n][None], joint.h1[n][None])[0]
        logits[e.relation[0], e.subject[0], e.object[0]] = of_units
        state = ChainState(every, room, logits, r)
        score = chains.log_score(state, v, r)
        between = r[:, v][:, :, v], logits[:, v][:, :, v]
        log_p = np.where(between[0], between[1], 0).sum() - np.logaddexp(0, between[1]).sum()
        exact = joint.log_sum(same(joint.v, joint.v[n])) + log_p
        assert score == pytest.approx(exact, abs=1e-5)
