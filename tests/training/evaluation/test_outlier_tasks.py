import numpy as np
import pytest
import torch

from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from tests.training.evaluation.scenes import FLOOR, NO_STRUCTURE, scene, tensors, values_of
from training.evaluation.asking import SENSITIVITIES, artifact_model, judge
from training.evaluation.object_tasks import SEEDS
from training.evaluation.outlier_tasks import (
    LAWS,
    alarms_task,
    by_signature,
    draw_intruders,
    hit_at_1,
    intruder_weights,
    outliers_task,
    signatures,
    with_intruders,
)
from training.evaluation.parts import draw_parts, exactly, of_classes
from training.evaluation.setting import Model, Setting, suspicion_of


def only_intruders(v):
    """The suspicion of a model that knows classes 0 to 2 as usual."""
    return torch.tensor([-5.0, -5, -5, 5, 5]).expand_as(v).masked_fill(v == 0, -torch.inf)


def test_hit_at_1_of_a_perfect_a_wrong_and_an_ignorant_suspicion():
    data = tensors([scene([0, 1, 2]) for _ in range(5)])
    cases = with_intruders(data, NO_STRUCTURE, None)
    wrong = lambda v: (-only_intruders(v)).masked_fill(v == 0, -torch.inf)  # noqa: E731
    scores = (only_intruders, 1.0), (wrong, 0.0), (suspicion_of(torch.zeros_like), 1 / 4)
    for suspicion, value in scores:
        hits = hit_at_1(data, cases, suspicion)
        assert (hits.value, hits.n) == (value, 5 * len(SEEDS))
    small = Setting(tensors([scene([0, 1])]), NO_STRUCTURE)
    assert outliers_task(Model(suspicion=wrong), small) is None


def test_an_object_is_judged_by_the_rest_without_itself():
    seen = []

    def spy(v):
        seen.append(v.clone())
        return torch.tensor([1.0, 2, 3, 4, 5]).expand_as(v)

    v = torch.tensor([[1.0, 1, 1, 0, 0], [0.0, 0, 0, 1, 1]])
    values = suspicion_of(spy, torch.tensor([8.0, 0, 0, 0, 0]), 0.5)(v)
    (others,) = seen
    assert others.sum(1).tolist() == [2, 2, 2, 1, 1]
    inf = torch.inf
    assert values.tolist() == [[3, -2, -3, -inf, -inf], [-inf, -inf, -inf, -4, -5]]


def test_a_request_lists_the_things_of_a_scene_and_an_absent_one():
    """Scenes of fewer than three things have no intruder."""
    data = tensors([scene([0, 1, 2, 3]), scene([0, 2]), scene([0, 1, 2])])
    index, v, intruder = with_intruders(data, FLOOR, None)
    assert index.tolist() == [0] * len(SEEDS)
    assert intruder.tolist() == [4] * len(SEEDS)
    assert v.tolist() == [[1, 0, 1, 1, 1]] * len(SEEDS)
    absent = torch.arange(len(FLOOR)) == 4
    drawn = draw_intruders(tensors([scene([0, 1, 2]) for _ in range(20)]), absent)
    assert set(drawn.tolist()) == {3}


def test_popular_intruders_follow_training():
    """3 is in nine training scenes, 4 in three: three of four draws are 3. Of 400 draws, outside
    250 to 350 with probability below 1e-7."""
    train = tensors([scene([0, 3])] * 6 + [scene([3, 4])] * 3)
    data = tensors([scene([0, 1, 2]) for _ in range(400)])
    added = draw_intruders(data, NO_STRUCTURE, intruder_weights(data, train)["by popularity"])
    assert set(added.tolist()) == {3, 4}
    assert 250 <= int((added == 3).sum()) <= 350


# Of six rooms 0, 1 and 2 have a class of their own each; 3 is everywhere, and 4 in rooms 0 and 1.
TOY = tensors(
    [scene([0, 3, 4], room=0) for _ in range(30)]
    + [scene([1, 3, 4], room=1) for _ in range(30)]
    + [scene([2, 3], room=2) for _ in range(30)]
    + [scene([3], room=room) for room in (3, 4, 5) for _ in range(30)]
    + [scene([2, 3]) for _ in range(50)]
)


def test_signature_classes_are_frequent_in_their_room_type_and_rare_elsewhere():
    """Lift of its own class 180 / 30 = 6; of class 4 in rooms 0 and 1 3; of class 3 1."""
    typical, share = signatures(TOY)
    assert [np.flatnonzero(row).tolist() for row in typical] == [[0], [1], [2], [], [], []]
    assert share[0].tolist() == [1, 0, 0, 1, 1]
    typical, share = signatures(tensors([*TOY.scenes, *(scene([0, 3], room=6) for _ in range(10))]))
    assert np.isnan(share[6]).all()
    assert not typical[6].any()


@pytest.mark.parametrize(("scenes", "times", "typical"), [(19, 19, 0), (30, 6, 1), (30, 5, 0)])
def test_rare_classes_and_rooms_have_no_signature(scenes, times, typical):
    """Under 20 scenes of the room, or the class in under a fifth of them."""
    some = [scene([0, 3] if k < times else [3], room=0) for k in range(scenes)]
    assert signatures(tensors([*some, *TOY.scenes[30:180]]))[0][0, 0] == typical


def test_intruders_are_typical_of_another_room_and_foreign_to_this_one():
    """Rooms 1 and 2 have one suitable class each; in a hundredth of the scenes is not foreign."""
    asked = [scene([0, 3, 4], room=0), scene([3, 4], room=-1), scene([0, 1, 3], room=0)]
    weights = by_signature(tensors(asked), TOY)
    assert weights.tolist() == [[0, 0.5, 0.5, 0, 0], [0] * 5, [0, 0, 1, 0, 0]]
    often = tensors([*TOY.scenes, scene([0, 2], room=0)])
    assert by_signature(tensors(asked[:1]), often).tolist() == [[0, 1, 0, 0, 0]]


def test_a_published_model_is_judged_as_the_service_ranks():
    data = rooms(40, 2)
    outcome = outliers_task(artifact_model(room_model()), Setting(data, STRUCTURE, rooms(400, 1)))
    names = {f"{name}, {law}" for name in ("hit@1", "flagged") for law in LAWS}
    assert set(outcome.metrics) == names
    index, v, intruder = with_intruders(data, STRUCTURE, None)
    hits, flagged = np.zeros(len(data)), np.zeros(len(data))
    for k, row, target in zip(index.tolist(), v, intruder.tolist(), strict=True):
        classes = row.nonzero().squeeze(1)
        answers = judge(room_model(), of_classes(classes.tolist()))
        place = int((classes == target).nonzero())
        first = answers[:, 0] == answers[:, 0].max()
        hits[k] += first[place] / first.sum()
        flagged[k] += answers[place, 1]
    groups = np.unique(data.group_ids, return_inverse=True)[1]
    for name, values in (("hit@1", hits), ("flagged", flagged)):
        assert outcome.metrics[f"{name}, uniform"].numerators == pytest.approx(
            np.bincount(groups, values)
        )


def test_alarms_by_hand():
    """A model that flags class 0 of each list at high sensitivity alone."""
    data = tensors([scene([0, 1, 2], name="a"), scene([0, 1, 2, 3], name="b"), scene([4])])

    def flags(v, sensitivity):
        return (v > 0) & (torch.arange(5) == 0) & (sensitivity == "high")

    outcome = alarms_task(flags, Setting(data, NO_STRUCTURE))
    expected = dict.fromkeys(
        (f"alarms, {s}, {n} classes" for s in SENSITIVITIES for n in (1, 2, 3)), 0.0
    )
    for n in (1, 2, 3):
        share = float(draw_parts(data, NO_STRUCTURE, exactly(n)).v[:, 0].mean())
        expected[f"alarms, high, {n} classes"] = pytest.approx(share)
    assert values_of(outcome) == expected
    assert outcome.skipped == 1


def test_without_room_types_and_training_scenes_there_are_fewer_laws():
    model = Model(suspicion=only_intruders)
    unknown = outliers_task(model, Setting(tensors([scene([0, 1, 2])]), NO_STRUCTURE, TOY))
    assert set(unknown.metrics) == {"hit@1, uniform", "hit@1, by popularity"}
    alone = outliers_task(model, Setting(tensors([scene([0, 1, 2])]), NO_STRUCTURE))
    assert set(alone.metrics) == {"hit@1, uniform"}
    assert outliers_task(Model(), Setting(TOY, NO_STRUCTURE, TOY)) is None
