from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training import commands
from training.fit import long_chains, trainer
from training.fit.configuration import Config
from training.fit.trainer import CurvePoint, Trainer
from training.machines.machine import OBJECT_WEIGHTS
from training.runs.config_files import with_settings
from training.runs.pipeline import prepare


def small_config(**settings) -> Config:
    """Objects in 10 steps with a point of the curve after 4 each, then relations in 2 epochs."""
    small = {"machine.coupled": True, "machine.G": 2, "objects.steps": 10, "objects.warm_up": 3}
    return with_settings(commands.small_config(rooms=90), small | settings)


@pytest.fixture(scope="module", autouse=True)
def _few_steps():
    """A point of the curve after 4 steps, and a short fit of the base rates of whole scenes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "_STEPS", 4)
        patch.setattr(long_chains, "_ROUNDS", 3)
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Scenes with word vectors of their classes, and with structure."""
    scenes = prepare(small_config(), tmp_path_factory.mktemp("none")).training_data()
    vectors = torch.randn(scenes.train.v.shape[1], 5, generator=torch.Generator().manual_seed(9))
    structure = torch.arange(len(vectors)) == scenes.train.v.sum(0).argmax()
    return replace(scenes, words=vectors, structure=structure)


def state(machine):
    return {name: value.clone() for name, value in machine.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


@pytest.fixture(scope="module")
def whole(data):
    result = Trainer(small_config(), data).run()
    return result, state(result.machine)


def test_two_runs_with_the_same_seed_give_the_same_bits(data, whole):
    passed: list[CurvePoint] = []
    result = Trainer(small_config(), data).run(passed=passed.append)
    assert same(state(result.machine), whole[1])
    assert result.curve == passed
    assert [(p.phase, p.done) for p in passed] == [
        *(("objects", done) for done in (0.4, 0.8, 1.0)),
        *(("relations", done) for done in (0.5, 1.0)),
    ]


def test_relation_biases_start_at_log_odds(data):
    """Of a relation among all annotated ones, and of a triple among the scenes with annotations."""
    scenes = [s.evidence for s in data.train.scenes if s.evidence.observed.any()]

    def check(bias, held, total):
        assert bias == pytest.approx(np.log((held + 0.5) / (total - held + 0.5)), abs=1e-4)

    for a, bias in enumerate(Trainer(small_config(), data).machine.d.tolist()):
        check(bias, sum(e.holds[a].sum() for e in scenes), sum(e.observed[a].sum() for e in scenes))
    machine = Trainer(small_config(**{"machine.variant": "rbm", "machine.G": 0}), data).machine
    for (a, i, j), bias in zip(machine.triples[:8].tolist(), machine.d.tolist(), strict=False):
        holds = [e.holds[a][np.ix_(e.classes == i, e.classes == j)].any() for e in scenes]
        check(bias, sum(holds), len(scenes))


def test_relations_leave_the_objects_as_they_are(data, whole):
    """And the shared weights are plain weights in the end."""
    _, longer = whole
    alone = state(Trainer(small_config(**{"relations.epochs": 0}), data).run().machine)
    for name in (*OBJECT_WEIGHTS, "fantasies", "fantasy_rooms"):
        assert torch.equal(longer[name], alone[name]), name
    assert not torch.equal(longer["S"], alone["S"])
    assert longer["fantasies"].any()
    assert not any(name.startswith("parametrizations") for name in longer)


def test_structure_changes_nothing(data, whole):
    machine = whole[0].machine
    assert data.structure.sum() == 1
    v = torch.zeros(2, machine.spec.V)
    v[1, data.structure] = 1
    with_and_without = machine.object_log_odds(v)
    assert torch.equal(with_and_without[0], with_and_without[1])
    assert machine.W[~data.structure].all()


@pytest.mark.parametrize("phase", ["objects", "relations"])
def test_a_phase_that_diverges_is_an_error(data, phase):
    config = small_config(**{f"{phase}.learning_rate": 1e30})
    with pytest.raises(FloatingPointError, match=rf"{phase}\.learning_rate"):
        Trainer(config, data).run()


@pytest.mark.parametrize("name", ["M", "n", "Q"])
def test_weights_can_be_held_at_zero(data, name):
    """The others start as they would have: machines differ by these weights alone."""
    free = Trainer(small_config(), data)
    held = Trainer(small_config(**{"machine.without": [name]}), data)
    first, second = state(free.machine), state(held.machine)
    assert not second.pop(name).any()
    first.pop(name)
    assert same(first, second)
    trained = state(held.run().machine)
    assert not trained.pop(name).any()
    assert not torch.equal(trained["R"], second["R"])
