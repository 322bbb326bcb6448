import pytest
import torch

from app.scene import ObjectClass, Vocabulary
from tests.enumeration.small_machines import random_weights
from training.datasets.batches import Batch
from training.domain.translation import BEYOND, Translation, same_classes
from training.evaluation.asking import artifact_model
from training.evaluation.setting import Places
from training.fit.draft import draft_artifact
from training.machines import MachineSpec, build


def vocabulary(*labels: str, aliases: dict[str, tuple[str, ...]] | None = None) -> Vocabulary:
    return Vocabulary([ObjectClass(label, (aliases or {}).get(label, ())) for label in labels])


MODEL = vocabulary("bed", "cup", "lamp", "desk", "pen", aliases={"cup": ("mug",)})
V, A = len(MODEL), 4


@pytest.fixture(scope="module")
def model():
    machine = build(MachineSpec("triway", V=V, A=A, units=2, states=3, K=3))
    random_weights(machine, torch.Generator().manual_seed(0), 0.5)
    return artifact_model(draft_artifact(machine.eval(), MODEL))


def batch(classes: list[int], size: int, told: tuple[int, int, int] | None = None) -> Batch:
    n = len(classes)
    holds, observed = torch.zeros(1, A, n, n), torch.zeros(1, A, n, n, dtype=torch.bool)
    if told is not None:
        holds[(0, *told)], observed[(0, *told)] = 1.0, True
    v = torch.zeros(1, size)
    v[0, classes] = 1.0
    return Batch(
        torch.tensor([classes]), torch.ones(1, n, dtype=torch.int64), holds, observed,
        v, torch.tensor([-1]), torch.tensor([0]),
    )  # fmt: skip


def test_the_same_classes_in_another_order_get_the_same_answers(model) -> None:
    order = [3, 1, 4, 0, 2]
    shuffled = vocabulary(*(MODEL.labels[k] for k in order))
    assert not same_classes(shuffled, MODEL)
    assert same_classes(MODEL, vocabulary(*MODEL.labels))
    asked = Translation.between(shuffled, MODEL).translate(model)
    v = torch.tensor([[1.0, 0.0, 1.0, 0.0, 0.0], [0.0, 1.0, 1.0, 1.0, 0.0]])
    own = torch.zeros_like(v)
    own[:, order] = v
    torch.testing.assert_close(asked.missing(v), model.missing(own)[:, order])
    # A scene of classes 0, 1, 3 there is one of 3, 1, 0 here.
    for name in ("relations", "completion", "false_relations"):
        theirs = getattr(asked, name)(batch([0, 1, 3], V, (1, 0, 2)))
        ours = getattr(model, name)(batch([0, 1, 3], V, (1, 2, 0)))
        turned = ours[:, :, [2, 1, 0]][:, :, :, [2, 1, 0]]
        apart = ~torch.eye(3, dtype=torch.bool)
        # Translated scores are at least -BEYOND.
        torch.testing.assert_close(theirs[..., apart], turned.clamp(min=-BEYOND)[..., apart])
    there = Places(v[:1], v[:1], *(torch.tensor([x]) for x in (2, 0)), torch.tensor([True]))
    here = Places(own[:1], own[:1], *(torch.tensor([x]) for x in (2, 3)), torch.tensor([True]))
    absent = v[0] == 0
    theirs = asked.at_place(there)[:, absent]
    torch.testing.assert_close(theirs, model.at_place(here)[:, order][:, absent])


def test_aliases_are_matched_and_unknown_classes_rank_last(model) -> None:
    translation = Translation.between(vocabulary("mug", "bed", "unicorn"), MODEL)
    assert translation.model_class.tolist() == [1, 0, -1]
    v = torch.tensor([[0.0, 1.0, 1.0]])
    proposed = translation.translate(model).missing(v)
    assert proposed[0, 0] == model.missing(torch.tensor([[1.0, 0.0, 0.0, 0.0, 0.0]]))[0, 1]
    assert proposed[0, 2] == -BEYOND
    assert translation.translate(model).suspicion(v)[0, 2] == -BEYOND
    false = translation.translate(model).false_relations(batch([0, 1, 2], 3, (0, 0, 2)))
    assert false[0, 0, 0, 2] == BEYOND


def test_at_an_unknown_anchor_all_classes_are_unknown(model) -> None:
    asked = Translation.between(vocabulary("cup", "unicorn", "bed"), MODEL).translate(model)
    v = torch.tensor([[0.0, 1.0, 0.0]])
    places = Places(v, v, torch.tensor([0]), torch.tensor([1]), torch.tensor([True]))
    assert bool((asked.at_place(places) == -BEYOND).all())


def test_two_scene_classes_of_one_model_class_have_no_relation(model) -> None:
    asked = Translation.between(vocabulary("cup", "mug", "bed"), MODEL).translate(model)
    values = asked.relations(batch([0, 1, 2], 3))
    assert bool((values[0, :, 0, 1] == -BEYOND).all())
    assert bool((values[0, :, 0, 2] > -BEYOND).all())
    torch.testing.assert_close(values[0, :, 0, 2], values[0, :, 1, 2])
    # Both state one relation of the model class.
    once, twice = batch([0, 1, 2], 3, (0, 0, 2)), batch([0, 1, 2], 3, (0, 0, 2))
    twice.holds[0, 0, 1, 2], twice.observed[0, 0, 1, 2] = 1.0, True
    torch.testing.assert_close(asked.completion(twice), asked.completion(once))
