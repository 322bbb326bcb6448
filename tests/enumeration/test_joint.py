"""Answers against the joint with a source unit, and against a joint with observed relations.

The first joint has the states (v, r, h1, t, q) and the weights exp(f_q - E(v, r, h1, t | q)). The
base rates u of whole scenes are 0 here, because the answers leave them out.
"""

import pytest
import torch

from tests.enumeration.small_machines import SMALL, binary, enumerate_joint, same, small_machine
from training.research.joint import change_by_relations, joint_log_odds, joint_room_log_p

WITH_SOURCES = [name for name, spec in SMALL.items() if spec.profiles]
with_sources = pytest.mark.parametrize("name", WITH_SOURCES)


def case(name, *rooms):
    """A machine, and the log weight and v of every state of its joint with a source unit."""
    machine = small_machine(name)
    with torch.no_grad():
        machine.u.zero_()
    joints = [enumerate_joint(machine, *rooms, source=q) for q in range(machine.spec.profiles)]
    log_weight = torch.cat([f - joint.energy for f, joint in zip(machine.f, joints, strict=True)])
    v, room = (torch.cat([getattr(joint, name) for joint in joints]) for name in ("v", "room"))
    return machine, log_weight, v, room


def conditionals(name):
    """(machine, v, i, log-odds of v_i given the rest in the joint) of every case."""
    machine, log_weight, states, _ = case(name)
    for v in binary(machine.spec.V):
        for i in (v == 0).nonzero().flatten().tolist():
            with_i = v.clone()
            with_i[i] = 1
            on, off = (log_weight[same(states, x)].logsumexp(0) for x in (with_i, v))
            yield machine, v, i, float(on - off)


@with_sources
def test_log_odds_of_the_joint_are_those_of_its_states(name):
    for machine, v, i, expected in conditionals(name):
        assert float(joint_log_odds(machine, v[None])[0, i]) == pytest.approx(expected, abs=1e-9)


@with_sources
def test_served_log_odds_are_at_most_those_of_the_joint(name):
    """A mean of base rates is at most the log of the mean odds. With one source, both are equal."""
    largest = 0.0
    for machine, v, i, expected in conditionals(name):
        difference = expected - float(machine.object_log_odds(v[None])[0, i])
        assert difference >= -1e-9
        largest = max(largest, difference)
    assert largest > 0.01
    machine.f[0] = 60.0
    v = binary(machine.spec.V)
    torch.testing.assert_close(machine.object_log_odds(v), joint_log_odds(machine, v))


@with_sources
def test_room_types_of_the_joint_are_those_of_its_states(name):
    """The served mean over sources is another one: its weights do not know that t is listed."""
    rooms = range(SMALL[name].C)
    machine, log_weight, states, room = case(name, *rooms)
    largest = 0.0
    for v in binary(machine.spec.V):
        where = same(states, v)
        rows = [log_weight[where & (room == t)].logsumexp(0) for t in rooms]
        expected = torch.stack(rows).log_softmax(0)
        torch.testing.assert_close(joint_room_log_p(machine, v[None])[0], expected)
        served = machine.room_log_p(v[None])[0]
        largest = max(largest, float((served.exp() - expected.exp()).abs().max()))
    assert largest > 1e-3


@pytest.mark.parametrize("name", ["triway", "triway-states"])
def test_observed_relations_change_the_joint_and_not_the_answers(name):
    """With 200,000 draws, the standard error of an estimate is below .004."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    edges, V = joint.edges, machine.spec.V
    generator, largest = torch.Generator().manual_seed(0), 0.0
    for v in binary(V):
        listed = (v > 0).nonzero().flatten().tolist()
        between = torch.tensor(
            [
                i in listed and j in listed
                for i, j in zip(edges.subject[0].tolist(), edges.object[0].tolist(), strict=True)
            ]
        )
        for value in (0.0, 1.0):
            observed = same(joint.r[:, between], torch.full((int(between.sum()),), value).double())
            r = torch.full((1, len(between)), value).double()
            change = change_by_relations(
                machine, v[None], edges, r, between[None], generator, draws=200_000
            )
            for i in set(range(V)) - set(listed):
                others = torch.arange(V) != i
                rest = same(joint.v[:, others], v[others])
                on = joint.v[:, i] > 0
                expected = joint.log_odds(on, rest & observed) - joint.log_odds(on, rest)
                assert float(change[i]) == pytest.approx(expected, abs=0.02)
                largest = max(largest, abs(expected))
    assert largest > 0.01


def test_implications_have_no_joint_distribution():
    """In a joint, two units have one log odds ratio: e shifts e' as much as e' shifts e.

    Without weights between h1 and relations, the shift is the whole change of the log-odds.
    """
    machine = small_machine("triway-implications")
    with torch.no_grad():
        machine.P.zero_()
        machine.M.zero_()
    edges = machine.edges(torch.arange(machine.spec.V).unsqueeze(0))
    h1 = machine.state_means(machine.hidden_logits(torch.ones(1, machine.spec.V).double()))
    ends = list(zip(edges.subject[0].tolist(), edges.object[0].tolist(), strict=True))
    first, second = ends.index((0, 1)), ends.index((1, 2))
    shifts = []
    for given, other in ((first, second), (second, first)):
        observed = torch.zeros(1, len(ends)).double()
        observed[0, given] = 1
        shifts.append(float(machine.implied(edges, observed, h1)[0, other]))
    assert abs(shifts[0] - shifts[1]) > 0.1
