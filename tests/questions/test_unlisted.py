"""Coverage: how the partial posterior enters the answers about missing objects."""

from __future__ import annotations

import math

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.questions.answers import missing
from tests.questions.artifacts import LABELS, artifact_of, larger_artifact, scene_of
from training.machines import MachineSpec, build
from training.machines.chain_samples import pack_scenes

SPECS = {
    "rbm": MachineSpec("rbm", V=9, A=4, H1=12, T=8, C=2, N=256, form="local"),
    "gbm": MachineSpec("gbm", V=9, A=4, H1=12, H2=3, T=8, N=256, form="local"),
    "triway": MachineSpec("triway", V=9, A=4, H1=90, K=3, C=2, N=256, form="local"),
}


def sampled_artifact(name, **changes):
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
    return {a.label: a.log_odds for a in missing(artifact, scene, top_k=9, **options)}


@pytest.fixture(params=SPECS)
def name(request):
    return request.param


SCENES = [scene_of([]), scene_of([0, 3, 3, 8]), scene_of([0, 1, 2], [(2, 1, 0), (0, 0, 2)])]


# A coverage from this on counts as this: at 1 no class could be there unlisted.
FULL = 0.999
UNLISTED = math.log(1 - FULL)


@pytest.mark.parametrize("scene", SCENES)
def test_unlisted_classes_are_absent_at_full_coverage(name, scene):
    """As without samples of what else may be there."""
    closed = log_odds(sampled_artifact(name, coverage_weight=0.0), scene, coverage=1.0)
    for coverage in (FULL, 1.0):
        assert log_odds(sampled_artifact(name), scene, coverage=coverage) == closed
    assert log_odds(sampled_artifact(name), scene, coverage=0.5) != closed


@pytest.mark.parametrize("scene", SCENES)
def test_the_weight_mixes_both_posteriors(name, scene):
    closed, half, partial = (
        log_odds(sampled_artifact(name, coverage_weight=weight), scene, coverage=0.6)
        for weight in (0.0, 0.5, 1.0)
    )
    full = log_odds(sampled_artifact(name), scene, coverage=1.0)
    for label, z in closed.items():
        assert z == pytest.approx(full[label] - UNLISTED + math.log(0.4), abs=1e-4)
    for label, z in half.items():
        assert z == pytest.approx((closed[label] + partial[label]) / 2, abs=1e-4)
    # The constant log(1 - c) is in both: what differs is what other unlisted classes do.
    assert max(abs(closed[label] - partial[label]) for label in closed) > 0.02


def test_the_coverage_is_the_model_s_unless_a_request_says(name):
    artifact, scene = sampled_artifact(name, coverage=0.25), scene_of([0, 1])
    assert log_odds(artifact, scene) == log_odds(artifact, scene, coverage=0.25)
    assert log_odds(artifact, scene) != log_odds(artifact, scene, coverage=0.5)
    assert log_odds(artifact, scene, coverage=0.0) != log_odds(artifact, scene, coverage=0.5)


@pytest.mark.parametrize("coverage", [0.0, 0.5, 0.9])
def test_machines_without_samples_count_other_unlisted_classes_as_absent(coverage):
    artifact, scene = larger_artifact("triway-wide"), scene_of([0, 1])
    assert artifact.completions is None
    full = log_odds(artifact, scene, coverage=1.0)
    for label, z in log_odds(artifact, scene, coverage=coverage).items():
        assert z == pytest.approx(full[label] - UNLISTED + math.log1p(-coverage), abs=1e-4)


def test_the_lower_the_coverage_the_likelier_an_unlisted_class(name):
    """Of all together: the expected number of unlisted classes."""
    artifact, scene = ARTIFACTS[name], scene_of([0])
    sums = [
        sum(a.probability for a in missing(artifact, scene, coverage=c, top_k=9))
        for c in (0.0, 0.5, 0.9, 0.99, 1.0)
    ]
    assert sums == sorted(sums, reverse=True)


ARTIFACTS = {name: sampled_artifact(name) for name in SPECS}


@given(
    st.sampled_from(sorted(SPECS)),
    st.lists(st.integers(0, 8), max_size=6),
    st.floats(0, 1),
    st.booleans(),
)
@settings(max_examples=60, deadline=None)
def test_probabilities_at_every_coverage(name, classes, coverage, placed):
    scene = scene_of(classes)
    at = ("on-top", 0) if placed and classes else None
    answers = missing(ARTIFACTS[name], scene, at=at, coverage=coverage, top_k=9)
    assert {a.label for a in answers} == set(LABELS[:8]) - {LABELS[c] for c in classes}
    p = [a.probability for a in answers]
    assert p == sorted(p, reverse=True)
    assert all(0 <= value <= 1 for value in p)
    assert answers == missing(ARTIFACTS[name], scene, at=at, coverage=coverage, top_k=9)
