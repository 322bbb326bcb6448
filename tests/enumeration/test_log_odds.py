"""Closed forms of classes and room types against the enumerated joint.

In the joint, the room type t is a unit with C + 1 states, of which one is "not listed". A list of
classes means v_j = 0 for every other class j: a log-odds is that of v_i given all other classes.
The joint of an unknown source has the mean base rates given the listed classes. The joint also has
the base rates u of whole scenes, which the answers leave out.
"""

from __future__ import annotations

import pytest
import torch

from tests.enumeration.small_machines import (
    ONE_LAYER,
    SMALL,
    TWO_LAYERS,
    binary,
    enumerate_joint,
    left_out,
    mean_rates,
    same,
    small_machine,
)


def cases(names):
    """Each machine without and with a room type, and without and with a source."""
    return [
        (name, room, source)
        for name in names
        for room in sorted({-1, SMALL[name].C - 1})
        for source in sorted({-1, SMALL[name].profiles - 1})
    ]


def differences(name, room, source, scale=0.8):
    """Closed form minus exact log-odds of v_i, for every v and i."""
    machine = small_machine(name, scale=scale)
    joint = enumerate_joint(machine, *range(-1, machine.spec.C), source=source)
    for i, v, given in left_out(joint):
        exact = joint.log_odds(joint.v[:, i] > 0, given & (joint.room == room))
        exact -= float(machine.u[source, i])
        if source < 0:
            exact += float(mean_rates(machine, v)[i])
        ours = machine.object_log_odds(
            v[None], room=torch.tensor([room]), source=torch.tensor([source])
        )
        yield float(ours[0, i]) - exact


@pytest.mark.parametrize(("name", "room", "source"), cases(ONE_LAYER))
def test_object_log_odds_are_exact_with_one_layer(name, room, source):
    assert max(map(abs, differences(name, room, source))) < 1e-9


@pytest.mark.parametrize(("name", "room", "source"), cases(TWO_LAYERS))
def test_two_layers_stay_close_to_the_joint(name, room, source):
    """The means of h2 stay the same for v_i = 0 and 1, so the log-odds have an error.

    With weights of the standard deviation .4, the largest error of these machines is .0034.
    """
    errors = list(map(abs, differences(name, room, source, scale=0.4)))
    assert 1e-6 < max(errors) < 0.004


@pytest.mark.parametrize("name", SMALL)
def test_kappa_is_added_to_log_odds_and_is_no_part_of_the_energy(name):
    machine, plain = small_machine(name), small_machine(name)
    plain.kappa.zero_()
    v, share = binary(machine.spec.V), torch.arange(2**machine.spec.V) % 4
    torch.testing.assert_close(
        machine.object_log_odds(v, share=share), plain.object_log_odds(v) + machine.kappa[share]
    )
    assert torch.equal(enumerate_joint(machine).energy, enumerate_joint(plain).energy)
    assert torch.equal(machine.object_log_odds(v), plain.object_log_odds(v))


@pytest.mark.parametrize("name", [name for name in ONE_LAYER if SMALL[name].C])
def test_room_types_are_those_of_the_joint(name):
    """p(t | v) of each source; of an unknown source, the mean over p(q | v) = softmax(f + a v)."""
    machine = small_machine(name)
    C, sources = machine.spec.C, range(machine.spec.profiles) or (-1,)
    joints = [enumerate_joint(machine, *range(C), source=q) for q in sources]
    for v in binary(machine.spec.V):
        rows = [
            [joint.log_sum(same(joint.v, v) & (joint.room == t)) for t in range(C)]
            for joint in joints
        ]
        by_source = torch.tensor(rows).double().softmax(1)
        for q, p in zip(sources, by_source, strict=True):
            ours = machine.room_log_p(v[None], torch.tensor([q]))[0].exp()
            torch.testing.assert_close(ours, p, rtol=1e-6, atol=0)
        weights = torch.ones(len(by_source)).double()
        if machine.spec.profiles:
            weights = torch.stack([(machine.f[q] + v @ machine.a[q]).exp() for q in sources])
        mean = (weights / weights.sum()) @ by_source
        torch.testing.assert_close(machine.room_log_p(v[None])[0].exp(), mean, rtol=1e-6, atol=0)


@pytest.mark.parametrize("name", TWO_LAYERS)
def test_mean_field_solves_its_equations(name):
    """After ten iterations, m2 = sigmoid(c2 + m1'J)."""
    machine = small_machine(name)
    v = binary(machine.spec.V)
    room = torch.arange(len(v)) % (machine.spec.C + 1) - 1
    x, m2 = machine.context(v, room)
    torch.testing.assert_close(x, machine.context_bias(room) + v @ machine.W + m2 @ machine.J.T)
    fixed = (machine.c2 + machine.state_means(x) @ machine.J).sigmoid()
    torch.testing.assert_close(m2, fixed, atol=1e-10, rtol=0)
