import pytest
import torch

from training.datasets import rooms_vocabulary
from training.seed import protocol
from training.seed.machines import VARIANTS, Free, Triway
from training.seed.scenes import Scenes

V = 4
TRIPLES = torch.tensor([[0, 0, 1], [1, 1, 2], [2, 2, 3]])
TEST = Scenes(
    torch.tensor([[1.0, 1, 1, 0], [1, 1, 0, 0]]),
    torch.tensor([[1.0, 1, 0], [1, 0, 0]]),
    torch.tensor([3, 1]),  # one listed triple of the first scene has no unit
    torch.tensor([True, True]),
)


def rng() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def everything(v, r, free, generator):
    return torch.where(free.v, 1.0, v), torch.where(free.r, 1.0, r)


def test_t1_counts_listed_relations_and_all_others():
    def first_two(v, r, free, generator):
        assert not r.any()
        assert torch.equal(v, TEST.v)
        assert not free.v.any()
        return v, torch.tensor([[1.0, 1, 0], [1, 1, 0]])

    assert protocol.relations_on(first_two, TEST, rng()) == {
        "T1 on": 3 / 4,
        "T1 precision": 3 / 4,
        "T1 relations on a scene": 2,
        "T1 listed relations a scene": 2,
    }
    unlisted = Scenes(TEST.v, 0 * TEST.r, 0 * TEST.labelled, ~TEST.annotated)
    assert protocol.relations_on(first_two, unlisted, rng()) == {}


@pytest.mark.parametrize("left", [True, False])
def test_t2_removes_one_class_with_or_without_its_relations(left):
    def check(v, r, free, generator):
        removed = (TEST.v - v).bool()
        assert removed.sum(1).tolist() == [1, 1]
        assert torch.equal(free.v, v == 0)
        touched = removed[:, TRIPLES[:, 1]] | removed[:, TRIPLES[:, 2]]
        assert torch.equal(r, TEST.r if left else TEST.r * ~touched)
        absent = (TEST.v[:, TRIPLES[:, 1]] * TEST.v[:, TRIPLES[:, 2]]) == 0
        assert torch.equal(free.r, absent if left else absent | touched)
        return everything(v, r, free, generator)

    assert protocol.removed_on(check, TRIPLES, TEST, left, rng()) == {"on": 1, "false objects": 1.5}
    figures = protocol.removed_on(protocol.nothing_answer, TRIPLES, TEST, left, rng())
    assert figures == {"on": 0, "false objects": 0}


def test_t3_has_both_denominators():
    figures = protocol.extra_errors(protocol.nothing_answer, TEST, rng())
    assert figures["T3 error / V"] == pytest.approx(1 / V)
    assert figures["T3 error / objects"] == pytest.approx(2 / 5)
    assert figures["T3 extra off"] == 0
    figures = protocol.extra_errors(lambda v, r, free, _: (0 * v, r), TEST, rng())
    assert figures["T3 error / V"] == pytest.approx(5 / 8)
    assert figures["T3 error / objects"] == figures["T3 extra off"] == 1


def test_the_frequency_row_draws_what_training_scenes_list():
    answer = protocol.frequency_answer(TRIPLES, TEST)
    n = 40_000
    v = torch.ones(n, V)
    every = Free(torch.zeros(n, V, dtype=torch.bool), torch.ones(n, 3, dtype=torch.bool))
    _, r = answer(v, torch.zeros(n, 3), every, rng())
    torch.testing.assert_close(r.mean(0), torch.tensor([1.0, 1.0, 0.0]))
    every = Free(torch.ones(n, V, dtype=torch.bool), every.r)
    v, r = answer(0 * v, torch.zeros(n, 3), every, rng())
    torch.testing.assert_close(v.mean(0), torch.tensor([1.0, 1.0, 0.5, 0.0]), atol=0.01, rtol=0)
    torch.testing.assert_close(r.mean(0), torch.tensor([1.0, 0.5, 0.0]), atol=0.01, rtol=0)


@pytest.mark.parametrize("schedule", [(1.0,), protocol.ANNEALED])
@pytest.mark.parametrize("name", list(VARIANTS))
def test_the_leak_of_t2_and_repeated_figures(name, schedule):
    """A relation that is left on pulls its removed object in a Triway alone."""
    variant = VARIANTS[name]
    machine = variant.kind(TRIPLES, V, 6, variant.H2 and 3, rng())
    machine.b.data.fill_(-60.0)
    machine.d.data.fill_(200.0)
    answer = protocol.machine_answer(machine, schedule)
    figures = protocol.measure(answer, TRIPLES, TEST, 0)
    assert figures["T2 on, relations left"] == (1 if variant.kind is Triway else 0)
    assert figures["T2 on, relations deleted"] == 0
    assert figures == protocol.measure(answer, TRIPLES, TEST, 0)


def test_t4_draws_scenes_of_a_hidden_unit():
    """Unit 0 is on in every training scene, and alone switches classes 0 and 1 on."""
    machine = Triway(TRIPLES, V, 2, 0, rng())
    for weight in machine.parameters():
        weight.data.zero_()
    machine.b.data.fill_(-30.0)
    machine.W.data[:2, 0] = 60.0
    machine.c1.data.fill_(-90.0)
    figures, classes = protocol.generate(machine, TEST, rooms_vocabulary(), 0)
    assert figures["T4 objects a scene, others mean"] == 2
    assert figures["T4 objects a scene, others zero"] == 1  # unit 1 draws nothing
    assert figures["T4 pairs seen, others zero"] == 1
    labels = [entry.label for entry in rooms_vocabulary().objects]
    assert set(classes["unit 0, others zero"][:2]) == set(labels[:2])
