"""The trainer on generated rooms: determinism, resuming, the files of a run."""

from __future__ import annotations

import csv
import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from training.fit import samples, trainer
from training.fit.checkpoint import CurvePoint, RunError, write_plot
from training.fit.configuration import Config
from training.fit.trainer import Trainer
from training.machines import Triway
from training.machines.machine import OBJECT_WEIGHTS
from training.runs.config_files import with_settings
from training.runs.folder import load_run, save_run
from training.runs.pipeline import prepare


def small_config(**settings) -> Config:
    """Objects in 10 steps with a checkpoint after 4 each, then relations in 2 epochs."""
    config = {
        "name": "small-triway",
        "data": {"sources": ["rooms"], "vocabulary": "rooms", "rooms": 90},
        "machine": {
            "variant": "triway", "units": 3, "states": 4, "coupled": True, "K": 4, "G": 2, "N": 16
        },
        "objects": {"steps": 10, "batch_size": 16, "warm_up": 3, "chains": 8},
        "relations": {"epochs": 2, "batch_size": 32},
    }  # fmt: skip
    return with_settings(Config.model_validate(config), settings)


DEEP = {"machine.coupled": False, "machine.H2": 3, "machine.G": 0}


@pytest.fixture(scope="module", autouse=True)
def _few_steps():
    """A checkpoint after 4 steps, and a short fit of the base rates of whole scenes."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trainer, "_STEPS", 4)
        patch.setattr(samples, "_ROUNDS", 3)
        yield


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    """Scenes with word vectors of their classes, and with structure."""
    scenes = prepare(small_config(), tmp_path_factory.mktemp("none")).training_data()
    generator = torch.Generator().manual_seed(9)
    vectors = torch.randn(scenes.train.v.shape[1], 5, generator=generator)
    structure = torch.arange(len(vectors)) == scenes.train.v.sum(0).argmax()
    return replace(scenes, words=vectors, structure=structure)


def state(machine):
    return {name: value.clone() for name, value in machine.state_dict().items()}


def same(first, second):
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


@pytest.fixture(scope="module")
def whole(data):
    """An uninterrupted run, and its machine's weights."""
    result = Trainer(small_config(), data).run()
    return result, state(result.machine)


@pytest.mark.parametrize("settings", [{}, DEEP], ids=["coupled", "two layers"])
def test_a_run_resumes_to_the_same_bits_from_every_checkpoint(data, tmp_path, settings):
    """Interrupted right after each checkpoint, and once more between two."""
    config = small_config(**settings)
    expected = state(Trainer(config, data).run().machine)
    folder = tmp_path / "run"

    def after_a_point(_):
        raise KeyboardInterrupt

    def within(phase, done, _):
        if (phase, round(done, 2)) == ("objects", 0.6):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        Trainer(config, data, folder).run(passed=after_a_point)
    again = Trainer(config, data, folder)
    assert again.resume()
    with pytest.raises(KeyboardInterrupt):
        again.run(within)
    for points in range(1, 5):
        again = Trainer(config, data, folder)
        assert again.resume()
        assert len(again.curve) == points
        with pytest.raises(KeyboardInterrupt):
            again.run(passed=after_a_point)
    last = Trainer(config, data, folder)
    assert last.resume()
    assert last.position == "100% of the relations"
    result = last.run()
    assert same(expected, state(result.machine))
    assert [(p.phase, p.done) for p in result.curve] == [
        *(("objects", done) for done in (0.4, 0.8, 1.0)),
        *(("relations", done) for done in (0.5, 1.0)),
    ]
    with (folder / "curve.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["phase"] for row in rows] == ["objects"] * 3 + ["relations"] * 2
    assert (folder / "curve.png").read_bytes().startswith(b"\x89PNG")


def test_the_plot_marks_the_score_of_the_kept_weights(tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "matplotlib.figure.Figure.savefig", lambda figure, *_, **__: drawn.append(figure)
    )
    objects = [CurvePoint("objects", done, 2.0, done / 2, 1.0) for done in (0.5, 1.0)]
    relations = [CurvePoint("relations", 1.0, 9.0, math.nan, 1.0)]
    for curve in (objects, objects + relations):
        write_plot(tmp_path / "curve.png", curve, "lab")
    alone, both = drawn
    loss, score = alone.axes
    assert "lab" in alone.get_suptitle()
    assert (loss.get_ylabel(), score.get_ylabel()) == ("training loss", "MRR of hidden classes")
    _, kept = score.lines
    assert (list(kept.get_xdata()), list(kept.get_ydata())) == ([1.0], [0.5])
    assert kept.get_label() == "kept weights (average): 0.500"
    # Without annotated validation scenes, the second phase has no score.
    assert [len(axis.lines) for axis in both.axes] == [1, 1, 2, 0]
    assert both.axes[3].texts[0].get_text() == "no validation scenes"


def test_relation_biases_start_at_log_odds(data):
    """Of a relation among all annotated ones, and of a triple among the scenes with annotations."""
    scenes = [s.evidence for s in data.train.scenes if s.evidence.observed.any()]

    def check(bias, held, total):
        expected = np.log((held + 0.5) / (total - held + 0.5))
        assert bias == pytest.approx(expected, abs=1e-4)

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


def test_a_checkpoint_that_is_broken_or_another_configuration_s_is_refused(data, tmp_path):
    Trainer(small_config(), data, tmp_path).run()
    with pytest.raises(RunError, match="another configuration"):
        Trainer(small_config(**{"objects.steps": 11}), data, tmp_path).resume()
    (tmp_path / "checkpoint.pt").write_bytes(b"not a checkpoint")
    with pytest.raises(
        RunError, match=r"checkpoint\.pt: cannot be read: it is damaged.*--fresh"
    ) as bad:
        Trainer(small_config(), data, tmp_path).resume()
    assert "\n" not in str(bad.value)
    (tmp_path / "checkpoint.pt").unlink()
    (tmp_path / "checkpoint.pt").mkdir()
    with pytest.raises(RunError, match=r"checkpoint\.pt: cannot be read: Is a directory$"):
        Trainer(small_config(), data, tmp_path).resume()
    assert not Trainer(small_config(), data, tmp_path / "empty").resume()


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


def test_a_finished_run_is_read_back(data, tmp_path, whole):
    config = small_config()
    tmp_path.mkdir(exist_ok=True)
    with pytest.raises(RunError, match="no finished run"):
        load_run(tmp_path)
    save_run(tmp_path, config, whole[0])
    run = load_run(tmp_path)
    assert run.config == config
    assert isinstance(run.machine, Triway)
    assert same(whole[1], state(run.machine))
