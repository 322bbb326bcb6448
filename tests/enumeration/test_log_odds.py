"""Every line of the table "observed, unobserved, and what is exact" against the enumerated
joint."""

from __future__ import annotations

import math

import pytest
import torch

from tests.enumeration.implied import relation_by_definition
from tests.enumeration.small_machines import (
    ONE_LAYER,
    SEED_FORM,
    SMALL,
    binary,
    enumerate_joint,
    same,
    small_machine,
)
from training.machines.draws import draw_hidden
from training.machines.log_odds import (
    context_gain,
    object_log_odds,
    presence_log_odds,
    relation_log_odds,
)
from training.machines.mean_field import Evidence, mean_field

LOCAL_ONE_LAYER = [n for n in ONE_LAYER if n not in SEED_FORM]
TWO_LAYERS = [n for n in SMALL if n not in ONE_LAYER]


def test_context_gain_and_its_gradient():
    generator = torch.Generator().manual_seed(0)
    x = torch.randn(3, 4, generator=generator).double().requires_grad_()
    W = torch.randn(5, 4, generator=generator).double().requires_grad_()
    softplus = torch.nn.functional.softplus
    expected = (softplus(x[:, None] + W) - softplus(x[:, None])).sum(-1)
    torch.testing.assert_close(context_gain(x, W), expected)
    assert torch.autograd.gradcheck(context_gain, (x, W))


def left_out(joint):
    """Every v, every class i: (number of v, i, v without i, states that have the rest of v)."""
    V = joint.machine.spec.V
    for number, v in enumerate(binary(V)):
        for i in range(V):
            rest, others = v.clone(), torch.arange(V) != i
            rest[i] = 0
            yield number, i, rest, same(joint.v[:, others], v[others])


@pytest.mark.parametrize("name", LOCAL_ONE_LAYER)
@pytest.mark.parametrize("room", [None, 2])
def test_object_log_odds_is_exact_in_the_local_form(name, room):
    machine = small_machine(name)
    joint = enumerate_joint(machine, room)
    rooms = None if room is None else torch.tensor([room])
    for _, i, rest, given in left_out(joint):
        exact = joint.log_odds(joint.v[:, i] > 0, given)
        evidence = Evidence(rest[None], joint.edges, room=rooms)
        assert float(object_log_odds(machine, evidence)[0, i]) == pytest.approx(exact, abs=1e-9)
        one = object_log_odds(machine, evidence, candidates=torch.tensor([[i]]))
        assert float(one) == pytest.approx(exact, abs=1e-9)


def partial_evidence(joint, v, keep, seed):
    """A scene at v with `keep` random units that do not touch absent objects observed."""
    generator = torch.Generator().manual_seed(seed)
    gate = joint.machine.gate(joint.edges, v[None])[0]
    units = [int(e) for e in torch.randperm(gate.numel(), generator=generator) if gate[e]][:keep]
    r = torch.zeros(1, gate.numel()).double()
    r[0, units] = torch.randint(2, (len(units),), generator=generator).double()
    observed = torch.zeros(1, gate.numel(), dtype=torch.bool)
    observed[0, units] = True
    return r, observed


@pytest.mark.parametrize("name", ONE_LAYER)
@pytest.mark.parametrize("keep", [0, 1, 3])
def test_relation_log_odds_with_any_mixture_observed(name, keep):
    """Within four stated standard errors of the joint (of the 2^13 fixed draws).

    With implications of p(r_e = 1 | rest) = E[sigmoid(ℓ_e + x_e)], which is no conditional of it.
    """
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    for seed, v in enumerate(binary(machine.spec.V)):
        r, observed = partial_evidence(joint, v, keep, seed)
        given = same(joint.v, v) & ((joint.r == r) | ~observed).all(1)
        evidence = Evidence(v[None], joint.edges, r, observed)
        log_odds, error = relation_log_odds(machine, joint.edges, evidence, count=1 << 13)
        gate = machine.gate(joint.edges, v[None])[0]
        for e in range(len(gate)):
            if not gate[e]:
                assert float(log_odds[0, e]) == -torch.inf
            elif not observed[0, e]:
                if machine.spec.G:
                    on = joint.edges.unflatten(r * observed)[0]
                    exact = math.log((p := relation_by_definition(joint, e, given, on)) / (1 - p))
                else:
                    exact = joint.log_odds(joint.r[:, e] > 0, given)
                assert abs(float(log_odds[0, e]) - exact) <= 4 * float(error[0, e]) + 1e-9
                assert float(error[0, e]) < 0.2


def estimate(machine, evidence, i, count):
    """Log-odds of class i over so many draws, and their standard error by the delta method."""
    draws, one = draw_hidden(machine, evidence, draws=count), torch.tensor([[i]])
    gain = draws.h1 @ machine.W[i]
    gain = gain.unsqueeze(-1) + machine.attraction(evidence.v, draws.h1, evidence.edges, one)
    error = draws.standard_error((gain - draws.log_mean_exp(gain)).exp())
    return float(presence_log_odds(machine, evidence, one, draws)), float(error)


@pytest.mark.parametrize("name", ONE_LAYER)
@pytest.mark.parametrize("keep", [0, 2])
def test_object_log_odds_estimate_within_its_stated_error(name, keep):
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    for seed, i, rest, given in left_out(joint):
        r, observed = partial_evidence(joint, rest, keep, seed)
        touching = (joint.edges.subject[0] == i) | (joint.edges.object[0] == i)
        observed = observed & ~touching
        r = r * observed
        given &= ((joint.r == r) | ~observed).all(1)
        exact = joint.log_odds(joint.v[:, i] > 0, given)
        evidence = Evidence(rest[None], joint.edges, r, observed)
        log_odds, error = estimate(machine, evidence, i, 1 << 13)
        assert abs(log_odds - exact) <= 4 * error + 1e-9
        assert error < 0.2


@pytest.mark.parametrize("name", SMALL)
def test_mean_field_solves_its_equations(name):
    """All relations observed: the slope of ρ_e is r_e, less σ(ℓ_e) in the local form."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    v, r, edges = joint.v[::97], joint.r[::97], joint.edges
    evidence = Evidence(v, edges, r, torch.ones_like(r, dtype=torch.bool))
    field = mean_field(machine, evidence, iterations=150)
    m1 = field.y.sigmoid()
    slope = r - machine.relation_logits(edges, v, m1).sigmoid() * (machine.spec.form == "local")
    related = machine.hidden_input(edges, slope * machine.gate(edges, v))
    expected = machine.c1 + v @ machine.W + field.h2 @ machine.J.T + related
    torch.testing.assert_close(m1, expected.sigmoid(), atol=1e-6, rtol=0)
    torch.testing.assert_close(field.h2, (machine.c2 + m1 @ machine.J).sigmoid(), atol=1e-6, rtol=0)


@pytest.mark.parametrize("name", TWO_LAYERS)
def test_two_layers_stay_close_to_the_joint(name):
    """Conditional mean field is never exact: its error on these machines is held below a bound.

    The bound is for weights of standard deviation .4; measured errors are in the decision page.
    """
    machine = small_machine(name, scale=0.4)
    joint = enumerate_joint(machine)
    worst = 0.0
    for _, i, rest, given in left_out(joint):
        exact = joint.log_odds(joint.v[:, i] > 0, given)
        evidence = Evidence(rest[None], joint.edges)
        worst = max(worst, abs(estimate(machine, evidence, i, 1 << 12)[0] - exact))
    assert worst < 0.05
