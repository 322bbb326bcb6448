"""AIS ≤ log Z ≤ reverse AIS around the exact value."""

from __future__ import annotations

import pytest
import torch

from tests.enumeration.small_machines import SMALL, enumerate_joint, small_machine
from training.machines.gibbs import start_chains
from training.machines.partition import ais, base_log_partition, reverse_ais

BETAS = torch.linspace(0, 1, 41).tolist()
CHAINS = 2000
BASE = torch.tensor([0.3, -0.7, 0.2]).double()


@pytest.mark.parametrize("name", SMALL)
def test_the_base_has_an_exact_partition_function(name):
    machine = small_machine(name, scale=0)
    base = BASE[: machine.spec.V]
    machine.b.copy_(base)
    exact = enumerate_joint(machine).log_z
    assert base_log_partition(machine, base) == pytest.approx(exact, abs=1e-9)


@pytest.mark.parametrize("name", SMALL)
def test_forward_and_reverse_bracket_log_z(name):
    """Both means of log w are bounds in expectation; 5 standard errors of slack each."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    generator = torch.Generator().manual_seed(9)
    base = BASE[: machine.spec.V]
    forward = ais(machine, BETAS, CHAINS, generator, base)
    pick = joint.draw(CHAINS, generator)
    state = start_chains(machine, joint.v[pick], generator)
    state.h2 = joint.h2[pick]
    reverse = reverse_ais(machine, BETAS, state, generator, base)
    slack = 5 * max(forward.standard_error, reverse.standard_error)
    assert forward.bound <= joint.log_z + slack
    assert reverse.bound >= joint.log_z - slack
    assert forward.bound <= forward.log_z
    assert reverse.log_z <= reverse.bound
    assert forward.log_z == pytest.approx(joint.log_z, abs=slack)
    assert reverse.log_z == pytest.approx(joint.log_z, abs=slack)
    assert slack < 0.3
