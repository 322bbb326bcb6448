"""Log-likelihoods of small machines against the enumerated joint."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from tests.enumeration.small_machines import binary, enumerate_joint, same, small_machine
from tests.training.evaluation.scenes import scene, tensors
from training.batches import scene_tensors
from training.evaluation.density import (
    DensitySettings,
    independent_density,
    log_partition,
    machine_density,
    object_part,
)

LOCAL = ["rbm-local", "gbm-local", "triway-local", "triway-local-two-layers"]
TRAIN = tensors([scene([0]), scene([0, 1]), scene([1]), scene([0, 1])], 2)
SETTINGS = DensitySettings(chains=200, temperatures=200, burn_in=50, draws=1024)


@pytest.mark.parametrize("name", LOCAL)
def test_log_likelihoods_are_those_of_the_joint(name):
    """Every v with both classes annotated, and with either unobserved, within .03 nats."""
    machine = small_machine(name)
    joint = enumerate_joint(machine)
    density = machine_density(machine, TRAIN, SETTINGS)
    for annotated in ([True, True], [True, False], [False, True]):
        known = torch.tensor(annotated)
        for v in binary(2):
            exact = joint.log_sum(same(joint.v[:, known], v[known]))
            ours = density.log_unnormalised(v.float().unsqueeze(0), known.unsqueeze(0))
            assert float(ours) == pytest.approx(exact, abs=0.03)


@pytest.mark.parametrize("name", LOCAL)
def test_the_partition_function_lies_between_its_estimates(name):
    """Within 5 standard errors; the bounds are in expectation, so each is allowed .02 of slack."""
    machine = small_machine(name)
    exact = enumerate_joint(machine).log_z
    below, above = log_partition(object_part(machine), TRAIN, SETTINGS)
    assert below.log_z == pytest.approx(exact, abs=5 * below.standard_error + 1e-3)
    assert above.log_z == pytest.approx(exact, abs=5 * above.standard_error + 1e-3)
    assert below.bound - 0.02 <= exact <= above.bound + 0.02


def test_the_seed_form_has_no_density_of_objects_here():
    with pytest.raises(ValueError, match="local form"):
        machine_density(small_machine("triway-seed"), TRAIN)


def test_independent_classes_by_hand():
    """Frequencies (3.5/5, 3.5/5) after smoothing; a class that is not annotated says nothing."""
    density = independent_density(TRAIN)
    v = torch.tensor([[1.0, 0], [1, 0]])
    annotated = torch.tensor([[True, True], [True, False]])
    p = 3.5 / 5
    assert density.log_unnormalised(v, annotated).tolist() == pytest.approx(
        [math.log(p) + math.log(1 - p), math.log(p)]
    )


def test_frequencies_are_taken_where_a_class_is_annotated():
    scenes = [scene([0], source="a"), scene([0], source="b")]
    tables = {"a": np.array([True, True]), "b": np.array([True, False])}
    density = independent_density(scene_tensors(scenes, tables, 2))
    value = density.log_unnormalised(torch.tensor([[0.0, 1]]), torch.tensor([[False, True]]))
    assert float(value) == pytest.approx(math.log(0.5 / 2))
