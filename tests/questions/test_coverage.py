"""Coverage: the effect of other unlisted classes on the answers about missing objects."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from training.machines.chain_samples import pack_scenes

from tests.questions.answers import missing
from tests.questions.artifacts import LABELS, artifact_of, larger_artifact, scene_of
from training.machines import MachineSpec, build

SPECS = {
    "rbm": MachineSpec("rbm", V=9, A=4, H1=12, T=8, C=2, N=256, form="local"),
    "gbm": MachineSpec("gbm", V=9, A=4, H1=12, H2=3, T=8, N=256, form="local"),
    "triway": MachineSpec("triway", V=9, A=4, H1=90, K=3, C=2, N=256, form="local"),
}
SCENES = [scene_of([]), scene_of([0, 3, 3, 8]), scene_of([0, 1, 2], [(2, 1, 0), (0, 0, 2)])]
# The model uses this coverage for larger ones. At 1, no unlisted class could be present.
FULL = 0.999
UNLISTED = math.log(1 - FULL)

every_machine = pytest.mark.parametrize("name", SPECS)


def sampled_artifact(name, **changes):
    """An artifact with stored samples."""
    generator = torch.Generator().manual_seed(5)
    machine = build(SPECS[name])
    with torch.no_grad():
        for parameter in machine.parameters():
            parameter.copy_(torch.randn(parameter.shape, generator=generator) * 0.3)
        scenes = torch.rand(machine.spec.N, machine.spec.V, generator=generator) < 0.4
        machine.fantasies.copy_(pack_scenes(scenes.float()))
        if machine.spec.T:
            keys = torch.arange(machine.spec.T)
            machine.set_triples(torch.stack([keys * 0, keys * 0, keys], 1))
    return artifact_of(machine.eval().requires_grad_(False), **changes)


def log_odds(artifact, scene, **options):
    return {entry.label: entry.log_odds for entry in missing(artifact, scene, top_k=9, **options)}


@every_machine
@pytest.mark.parametrize("scene", SCENES)
def test_other_unlisted_classes_are_absent_at_full_coverage(name, scene):
    """As without samples."""
    closed = log_odds(sampled_artifact(name, coverage_weight=0.0), scene, coverage=1.0)
    for coverage in (FULL, 1.0):
        assert log_odds(sampled_artifact(name), scene, coverage=coverage) == closed
    assert log_odds(sampled_artifact(name), scene, coverage=0.5) != closed


@every_machine
@pytest.mark.parametrize("scene", SCENES)
def test_the_weight_mixes_both_posteriors(name, scene):
    closed, half, partial = (
        log_odds(sampled_artifact(name, coverage_weight=weight), scene, coverage=0.6)
        for weight in (0.0, 0.5, 1.0)
    )
    full = log_odds(sampled_artifact(name), scene, coverage=1.0)
    for label, z in closed.items():
        assert z == pytest.approx(full[label] - UNLISTED + math.log(0.4), abs=1e-4)
        assert half[label] == pytest.approx((z + partial[label]) / 2, abs=1e-4)
    # Both have the constant log(1 - c). The other unlisted classes make the difference.
    assert max(abs(closed[label] - partial[label]) for label in closed) > 0.02


@every_machine
def test_the_default_is_the_coverage_of_the_model(name):
    artifact, scene = sampled_artifact(name, coverage=0.25), scene_of([0, 1])
    assert log_odds(artifact, scene) == log_odds(artifact, scene, coverage=0.25)
    assert log_odds(artifact, scene) != log_odds(artifact, scene, coverage=0.5)
    assert log_odds(artifact, scene, coverage=0.0) != log_odds(artifact, scene, coverage=0.5)


@pytest.mark.parametrize("coverage", [0.0, 0.5, 0.9])
def test_other_unlisted_classes_are_absent_without_samples(coverage):
    artifact, scene = larger_artifact("triway-wide"), scene_of([0, 1])
    assert artifact.completions is None
    full = log_odds(artifact, scene, coverage=1.0)
    for label, z in log_odds(artifact, scene, coverage=coverage).items():
        assert z == pytest.approx(full[label] - UNLISTED + math.log1p(-coverage), abs=1e-4)


ARTIFACTS = {name: sampled_artifact(name) for name in SPECS}


@every_machine
def test_a_lower_coverage_makes_unlisted_classes_likelier(name):
    """The expected number of unlisted classes."""
    sums = [
        sum(entry.probability for entry in missing(ARTIFACTS[name], scene_of([0]), **options))
        for options in ({"coverage": c, "top_k": 9} for c in (0.0, 0.5, 0.9, 0.99, 1.0))
    ]
    assert sums == sorted(sums, reverse=True)


@given(
    st.sampled_from(sorted(SPECS)),
    st.lists(st.integers(0, 8), max_size=6),
    st.floats(0, 1),
    st.booleans(),
)
@settings(max_examples=60)
def test_probabilities_at_every_coverage(name, classes, coverage, placed):
    options = {"coverage": coverage, "at": ("on-top", 0) if placed and classes else None}
    entries, again = (
        missing(ARTIFACTS[name], scene_of(classes), top_k=9, **options) for _ in range(2)
    )
    assert entries == again
    assert {entry.label for entry in entries} == set(LABELS[:8]) - {LABELS[c] for c in classes}
    p = [entry.probability for entry in entries]
    assert p == sorted(p, reverse=True)
    assert all(0 <= value <= 1 for value in p)
