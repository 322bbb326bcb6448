"""The trainer on generated rooms: determinism, resuming, early stopping, the files of a run."""

from __future__ import annotations

import csv
from dataclasses import replace

import pytest
import torch

from training.fit.checkpoint import RunError
from training.fit.configuration import Config, ConfigError
from training.fit.trainer import Trainer
from training.machines import Triway
from training.runs.config_files import with_settings
from training.runs.folder import load_run, save_run
from training.runs.pipeline import prepare


def small_config(**training) -> Config:
    return Config.model_validate(
        {
            "name": "small-triway",
            "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 90},
            "machine": {"variant": "triway", "form": "local", "H1": 12, "H2": 6, "K": 4},
            "objective": {"name": "composite", "relation_weight": 0.1},
            "training": {"epochs": 3, "batch_size": 32, "averaging": 0.9, **training},
        }
    )


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return prepare(small_config(), tmp_path_factory.mktemp("none")).training_data()


def state(machine):
    return {name: value.clone() for name, value in machine.state_dict().items()}


def weights(machine):
    return {name: p.clone() for name, p in machine.named_parameters()}


def same(first, second):
    return all(torch.equal(first[name], second[name]) for name in first)


def test_same_seed_gives_the_same_bits_and_another_seed_does_not(data):
    first = weights(Trainer(small_config(), data).run().machine)
    assert same(first, weights(Trainer(small_config(), data).run().machine))
    assert not same(first, weights(Trainer(small_config(seed=1), data).run().machine))


def interrupt(epoch, done, loss):
    """As ctrl-C in the middle of the second epoch."""
    if epoch == 1 and done > 0.4:
        raise KeyboardInterrupt


@pytest.mark.parametrize("objective", ["composite", "persistent_cd"])
def test_an_interrupted_run_resumes_to_the_same_bits(data, tmp_path, objective):
    config = with_settings(small_config(), {"objective.name": objective, "objective.chains": 16})
    whole = Trainer(config, data).run()
    with pytest.raises(KeyboardInterrupt):
        Trainer(config, data, tmp_path).run(interrupt)
    again = Trainer(config, data, tmp_path)
    assert again.resume()
    assert len(again.epochs) == 1
    assert same(weights(whole.machine), weights(again.run().machine))


def phased(**training) -> Config:
    """Objects, room types and samples first; then relations, with a prior of words."""
    settings = {
        "objects.epochs": 2,
        "objects.chains": 16,
        "objective.name": "relations",
        "objective.word_weight": 0.5,
        "machine.N": 32,
        "machine.G": 2,
    }
    return with_settings(small_config(**training), settings)


@pytest.fixture(scope="module")
def worded(data):
    """The same scenes, with vectors of their classes."""
    generator = torch.Generator().manual_seed(9)
    vectors = torch.randn(data.train.v.shape[1], 5, generator=generator)
    return replace(data, words=torch.nn.functional.normalize(vectors, dim=1))


@pytest.mark.slow
def test_phases_resume_to_the_same_bits_wherever_they_were_interrupted(worded, tmp_path):
    """Among the objects nothing is kept; after them, the objects are."""
    config = phased()
    whole = state(Trainer(config, worded).run().machine)

    def stop(_):
        raise KeyboardInterrupt

    early = Trainer(config, worded, tmp_path)
    with pytest.raises(KeyboardInterrupt):
        early.run(objects=stop)
    again = Trainer(config, worded, tmp_path)
    assert not again.resume()
    with pytest.raises(KeyboardInterrupt):
        again.run(interrupt)
    last = Trainer(config, worded, tmp_path)
    assert last.resume()
    assert last.objects_trained
    assert len(last.epochs) == 1
    assert same(whole, state(last.run(objects=stop).machine))


@pytest.mark.slow
def test_relations_leave_the_objects_and_the_samples_as_they_are(worded):
    """And the words are part of plain weights in the end."""
    machine = Trainer(phased(), worded).run().machine
    alone = Trainer(phased(epochs=1), worded).run().machine
    for name in ("b", "c1", "c2", "W", "J", "Q", "fantasies", "fantasy_rooms"):
        assert torch.equal(machine.state_dict()[name], alone.state_dict()[name]), name
    assert not torch.equal(machine.S, alone.S)
    assert bool(machine.fantasies.any())
    assert set(machine.state_dict()) == set(new_machine_of(worded).state_dict())


def new_machine_of(data):
    return Trainer(with_settings(phased(), {"objective.word_weight": 0.0}), data).machine


def test_the_last_average_of_the_relation_likelihood_is_kept(worded):
    """Under a prior nothing overfits early; validation stops nothing."""
    result = Trainer(phased(epochs=4, learning_rate=0.05), worded).run()
    assert result.best_epoch == 3
    losses = [epoch.loss for epoch in result.epochs]
    assert losses[-1] < losses[0]


@pytest.mark.filterwarnings("ignore:invalid value")
def test_an_object_phase_that_diverges_says_so(data):
    config = with_settings(phased(), {"objects.learning_rate": 1e39})
    with pytest.raises(FloatingPointError, match=r"objects\.learning_rate"):
        Trainer(config, data).run()


def test_a_checkpoint_that_is_broken_or_another_configuration_s_is_refused(data, tmp_path):
    Trainer(small_config(epochs=1), data, tmp_path).run()
    with pytest.raises(RunError, match="another configuration"):
        Trainer(small_config(epochs=2), data, tmp_path).resume()
    (tmp_path / "checkpoint.pt").write_bytes(b"not a checkpoint")
    with pytest.raises(RunError, match="cannot be read"):
        Trainer(small_config(), data, tmp_path).resume()


def test_the_curve_has_objects_and_relations_separately(data, tmp_path):
    Trainer(small_config(epochs=10, learning_rate=0.03), data, tmp_path).run()
    with (tmp_path / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["epoch"] for row in rows] == [str(n) for n in range(10)]
    for unit in ("object", "relation"):
        errors = [float(row[f"{unit}_error_validation"]) for row in rows]
        assert all(0 < error < 1 for error in errors)
        assert errors[-1] < errors[0]
    assert (tmp_path / "curve.png").read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize("name", ["M", "n"])
def test_weights_can_be_held_at_zero(data, name):
    """The others start as they would have: what is compared differs by these weights alone."""
    config = with_settings(small_config(), {"machine.without": [name]})
    free, held = Trainer(small_config(), data), Trainer(config, data)
    first, second = weights(free.machine), weights(held.machine)
    assert first.pop(name).any()
    assert not second.pop(name).any()
    assert same(first, second)
    trained = weights(held.run().machine)
    assert not trained.pop(name).any()
    assert not torch.equal(trained["R"], second["R"])


def test_weights_to_hold_must_exist():
    with pytest.raises(ConfigError, match="a triway has no weights H, g, only b, c1"):
        with_settings(small_config(), {"machine.without": ["H", "M", "g"]})


def test_patience_ends_a_run_early(data):
    config = small_config(epochs=30, patience=1, learning_rate=1e-9, averaging=0.0)
    result = Trainer(config, data).run()
    assert len(result.epochs) < 30
    assert result.best_epoch < len(result.epochs)


def test_a_diverging_run_says_so(data):
    with pytest.raises(FloatingPointError, match="learning rate"):
        Trainer(small_config(optimiser="sgd", learning_rate=1e30), data).run()


def test_a_finished_run_is_read_back(data, tmp_path):
    config = small_config()
    result = Trainer(config, data, tmp_path).run()
    with pytest.raises(RunError, match="no finished run"):
        load_run(tmp_path)
    save_run(tmp_path, config, result)
    run = load_run(tmp_path)
    assert run.config == config
    assert isinstance(run.machine, Triway)
    assert same(weights(result.machine), weights(run.machine))
    assert run.epochs == 3
