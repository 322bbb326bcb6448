import pytest
import torch

from app.model import PlaceFit
from app.scene import CANONICAL, OPPOSITES, Scene, SceneObject
from tests.questions.answers import missing as ask_missing
from tests.questions.artifacts import LARGER, larger_artifact
from tests.training.evaluation.scenes import (
    FLOOR,
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    in_order,
    scene,
    tensors,
    values_of,
)
from training.evaluation.asking import LeakError, score_placed
from training.evaluation.object_tasks import (
    SEEDS,
    leave_one_out_at,
    missing_task,
    rank_missing,
    removed_places,
)
from training.evaluation.parts import all_but_one, draw_parts
from training.evaluation.setting import Places, Setting


def test_metrics_by_hand():
    """The only hidden class is first in one scene, and third in the other one. The first scene has
    one unknown label besides two known ones, so a removed object of it is unknown in a third of the
    cases."""
    data = tensors([scene([0, 1], unknown=("x",)), scene([3, 4]), scene([2], unknown=("x",) * 5)])
    outcome = missing_task(in_order, Setting(data, NO_STRUCTURE))
    values = values_of(outcome)
    assert values["MRR, one removed"] == values["MRR, 25 % shown"] == pytest.approx((1 + 1 / 4) / 2)
    assert values["MRR, one removed, structure listed"] == values["MRR, one removed"]
    assert (values["top-1"], values["top-3"], values["top-5"]) == (1 / 2, 1 / 2, 1)
    assert values["MRR, unknown labels score 0"] == pytest.approx((1 + 1 / 4) / (3 / 2 + 1))
    assert outcome.metrics["MRR, one removed"].n == 2 * len(SEEDS)
    assert (outcome.scenes, outcome.skipped) == (3, 1)
    assert missing_task(in_order, Setting(tensors([scene([0])]), FLOOR)) is None


@pytest.mark.parametrize("structure_listed", [False, True])
def test_the_score_sees_the_listed_classes_alone(structure_listed):
    """Also the second time. Structure is listed in its own metrics alone."""
    seen = []

    def spy(v):
        seen.append(v.clone())
        return in_order(v)

    data = tensors([scene([0, 1, 2, 3], [(0, 0, 1)])])
    ranking = rank_missing(data, FLOOR, spy, structure_listed=structure_listed)
    first, again = seen
    assert sorted(again.tolist()) == sorted(first.tolist())
    assert bool((first[:, FLOOR] == structure_listed).all())
    assert bool((first[:, ~FLOOR].sum(1) == 2).all())
    assert not first[torch.arange(3), torch.from_numpy(ranking.target)].any()


@pytest.mark.parametrize("first", [3, 9])
def test_a_planted_cheater_is_caught(first):
    """A score that counts the questions, however many objects the first scene has."""
    data = tensors([scene(range(first)), scene([1, 3, 4]), scene([0, 10])], WIDE)
    hidden = draw_parts(data, WIDE_STRUCTURE, all_but_one, SEEDS).hidden.float()
    turns = iter([*hidden] * 3)
    with pytest.raises(LeakError, match="leaks information"):
        rank_missing(data, WIDE_STRUCTURE, lambda v: torch.stack([next(turns) for _ in v]))


def test_every_class_in_a_relation_is_removed_once_with_one_of_its_relations():
    data = tensors([scene([0, 1, 1, 2, 3], [(0, 0, 1), (2, 2, 1)]), scene([0], [])])
    row, target, places = removed_places(data, NO_STRUCTURE)
    assert (row.tolist(), target.tolist()) == ([0, 0, 0], [0, 1, 2])
    columns = (places.relation, places.anchor, places.outgoing)
    asked = list(zip(*(column.tolist() for column in columns), strict=True))
    assert asked[0] == (0, 1, True)
    assert asked[1] in [(0, 0, False), (2, 2, False)]
    assert asked[2] == (2, 1, True)
    assert places.counts[:2].tolist() == [[0, 2, 1, 1, 0], [1, 0, 1, 1, 0]]


def test_ranks_at_a_place_by_hand():
    """left(0, 1) and front(2, 1) in {0, 1, 2}; the score prefers higher classes."""
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (1, 2, 1)])])
    found, relation = leave_one_out_at(
        data, NO_STRUCTURE, lambda places: torch.arange(5.0).expand_as(places.v)
    )
    # Absent but the target: 3 and 4, both above it.
    assert found.mrr().value == pytest.approx(1 / 3)
    assert found.mrr().n == 3
    assert sorted(relation.tolist()) in ([0, 0, 1], [0, 1, 1])
    none, relation = leave_one_out_at(data, NO_STRUCTURE, lambda places: torch.zeros_like(places.v))
    assert none.mrr(relation == 0).value == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)


def test_structure_and_equal_classes_give_no_place():
    structure = torch.arange(len(NO_STRUCTURE)) == 4
    found = scene([0, 0, 1, 4], [(0, 0, 4), (3, 0, 1)])
    found.evidence.holds[2, 0, 0] = True
    _, target, places = removed_places(tensors([found]), structure)
    assert sorted(target.tolist()) == [0, 1]
    assert places.relation.tolist() == [3, 3]
    assert not places.v[:, 4].any()
    assert len(removed_places(tensors([scene([0, 4], [(0, 0, 4)])]), structure)[0]) == 0


@pytest.mark.parametrize("outgoing", [True, False])
@pytest.mark.parametrize("name", ["rbm", "triway"])
def test_the_question_names_the_place_as_a_robot_does(name, outgoing):
    """On-top of the first of two objects of class 2, by the relation as the missing object's."""
    entry = PlaceFit(relation=0.8, intercept=0.2)
    artifact = larger_artifact(name, at=(entry,) * LARGER[name].A, coverage=0.7)
    v = torch.zeros(2, artifact.spec.V)
    v[:, [0, 2, 5]] = 1.0
    number = v.clone()
    number[:, 2] = 2.0
    # Another row must not disturb the first.
    relation, anchor = torch.tensor([2, 0]), torch.tensor([2, 5])
    places = Places(v, number, relation, anchor, torch.tensor([outgoing, not outgoing]))
    values = score_placed(artifact, places)[0]
    things = tuple(SceneObject(str(k), "x", c) for k, c in enumerate([0, 2, 2, 5]))
    spoken = CANONICAL[2] if outgoing else OPPOSITES[CANONICAL[2]]
    answers = ask_missing(artifact, Scene(things), top_k=artifact.spec.V, at=(spoken, 1))
    for answer in answers:
        found = values[artifact.vocabulary.index(answer.label)]
        assert float(found.exp()) == pytest.approx(answer.probability, rel=1e-5)
    # Structure and what is there are no candidates.
    assert int((values > -torch.inf).sum()) == len(answers)
