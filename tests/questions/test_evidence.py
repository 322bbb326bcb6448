"""A scene in the layouts of the machines."""

from __future__ import annotations

import pytest
import torch

from app.scene import Scene, SceneObject, derive_relations
from tests.questions.artifacts import LARGER, larger_artifact, scene_of
from training.fit.oracle.evidence import draw_context, observe
from training.fit.oracle.units import mean_log_p, units_between
from training.machines.arrays import machine_of


def triples_of(edges, values):
    """The (a, i, j) of the units that are on."""
    on = (values[0] > 0).nonzero().flatten().tolist()
    return {
        (int(edges.relation[0, e]), int(edges.subject[0, e]), int(edges.object[0, e])) for e in on
    }


@pytest.mark.parametrize("name", LARGER)
def test_stated_relations_are_observed_where_the_machine_has_units(name):
    machine = machine_of(larger_artifact(name).weights)
    known = {(int(a), int(i), int(j)) for a, i, j in machine.triples.tolist() if i != j}
    a, i, j = sorted(known)[0]
    unseen = next(
        (b, i, j) for b in range(4) if machine.spec.variant == "triway" or (b, i, j) not in known
    )
    scene = scene_of([i, j], sorted({(a, 0, 1), (unseen[0], 0, 1)}))
    found = observe(machine, scene)
    expected = {(a, i, j)} | ({unseen} if machine.spec.variant == "triway" else set())
    assert found.units is not None
    assert triples_of(found.units.edges, found.evidence.observed) == expected
    assert triples_of(found.units.edges, found.evidence.r) == expected


def test_only_classes_that_a_relation_touches_get_units_in_the_local_form():
    machine = machine_of(larger_artifact("triway-local").weights)
    assert observe(machine, scene_of([0, 1, 2])).units is None
    found = observe(machine, scene_of([0, 1, 2, 3], [(1, 3, 0)]))
    assert found.touched.tolist() == [True, False, False, True]
    assert found.unit_count == 4 * 2 * 2
    whole = observe(
        machine_of(larger_artifact("triway-seed").weights), scene_of([0, 1, 2, 3], [(1, 3, 0)])
    )
    assert whole.unit_count == 4 * 4 * 4


@pytest.mark.parametrize("name", ["triway-local", "triway-seed"])
def test_poses_show_what_does_not_hold(name):
    plain = scene_of([0, 1, 2])
    poses = derive_relations([[1, 0, 0], [1, 1, 0], [30, 0, 0]], [[0.5, 0.5, 0.5]] * 3)
    found = observe(
        machine_of(larger_artifact(name).weights), Scene(plain.objects, ((0, 1, 0),), poses=poses)
    )
    seen = triples_of(found.units.edges, found.evidence.observed)
    assert seen == {(a, i, j) for a in range(4) for i, j in ((0, 1), (1, 0))}
    assert triples_of(found.units.edges, found.evidence.r) == {(0, 1, 0)}


@pytest.mark.parametrize("name", LARGER)
def test_taking_classes_out_takes_their_relations_out(name):
    machine = machine_of(larger_artifact(name).weights)
    classes = [0, 1, 2]
    stated = [(0, 0, 1), (1, 1, 2), (2, 2, 0)]
    found = observe(machine, scene_of(classes, stated))
    whole = triples_of(found.units.edges, found.evidence.observed)
    removed = torch.tensor([[True, False, False], [False, True, True], [False, False, False]])
    rest = found.without(removed)
    assert rest.v[:, classes].tolist() == [[0, 1, 1], [1, 0, 0], [1, 1, 1]]
    assert rest.v.sum() == 6
    for row, gone in enumerate(({0}, {1, 2}, set())):
        kept = triples_of(found.units.edges, rest.observed[row : row + 1])
        assert kept == {t for t in whole if not gone & set(t[1:])}


@pytest.mark.parametrize("name", LARGER)
def test_units_between_any_classes(name):
    """The grid and the flat layout name the same units."""
    machine = machine_of(larger_artifact(name).weights)
    subjects, objects = torch.tensor([4, 1, 7]), torch.tensor([2, 4])
    units = units_between(machine, subjects, objects)
    edges = units.edges
    names = (edges.relation[0] * 9 + edges.subject[0]) * 9 + edges.object[0]
    grid = units.grid(names.double(), -1.0)
    known = set(((machine.triples[:, 0] * 9 + machine.triples[:, 1]) * 9
                 + machine.triples[:, 2]).tolist())  # fmt: skip
    for a in range(4):
        for x, i in enumerate(subjects.tolist()):
            for y, j in enumerate(objects.tolist()):
                key = (a * 9 + i) * 9 + j
                exists = machine.spec.variant == "triway" or key in known
                assert grid[a, x, y] == (key if exists else -1)
    flat = units.flat(units.grid(names.double(), 0.0))
    there = torch.zeros(len(names), dtype=torch.bool)
    there[units.place[units.exists]] = True
    assert torch.equal(flat, torch.where(there, names.double(), 0.0))


def test_both_tails_of_a_probability_keep_their_digits():
    weight = torch.full((2, 1), 0.5)
    logits = torch.tensor([[-80.0, 20.0, 0.0], [-80.0, 22.0, 0.0]])
    on, off = mean_log_p(weight, logits)
    exact = logits.double().sigmoid().mean(0).log()
    rest = logits.double().neg().sigmoid().mean(0).log()
    torch.testing.assert_close(on.double(), exact, atol=1e-4, rtol=1e-6)
    torch.testing.assert_close(off.double(), rest, atol=1e-4, rtol=1e-6)


def test_many_relations_get_fewer_draws(monkeypatch):
    machine = machine_of(larger_artifact("triway-local").weights)
    small = observe(machine, scene_of([0, 1], [(0, 0, 1)])).evidence
    assert len(draw_context(machine, small).h1) == 64
    monkeypatch.setattr("training.fit.oracle.evidence._RELATION_DRAWS", 16 * 16)
    assert len(draw_context(machine, small).h1) == 16
    assert len(draw_context(machine, small, rows=1000).h1) == 8


def test_confidence_is_soft_presence():
    machine = machine_of(larger_artifact("triway-local").weights)
    scene = Scene((SceneObject("a", "bed", 0, 0.25), SceneObject("b", "lamp", 1)))
    assert observe(machine, scene).evidence.v[0, :3].tolist() == [0.25, 1.0, 0.0]
