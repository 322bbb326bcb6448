"""T2, T2 partial and T2-at by hand, and that nothing of a hidden object can leak."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from app.registry import CountSlope, PairSlope
from app.scene import CANONICAL, OPPOSITES, Scene, SceneObject
from tests.questions.answers import missing as ask_missing
from tests.questions.artifacts import artifact_of
from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    larger_machine,
    random_scenes,
    scene,
    tensors,
)
from training.evaluation import asking
from training.evaluation import missing_tasks as missing
from training.evaluation.artifact_model import placed_score
from training.evaluation.asking import LeakError
from training.evaluation.missing_tasks import (
    SHARES,
    hide,
    leave_one_out,
    leave_one_out_at,
    partial_score,
    partial_task,
    rank_hidden,
    removed_places,
)
from training.evaluation.model import Model, Places
from training.evaluation.setting import Setting

DATA = tensors(random_scenes(20), WIDE)
FLOOR = torch.tensor([False, True, False, False, False])


def fixed(v):
    """Class 0 before 1 before 2, ..."""
    return torch.tensor([5.0, 4, 3, 2, 1]).expand_as(v)


def test_metrics_by_hand():
    """Class 0 is found in three scenes, class 2 comes second in all, class 4 last of two."""
    data = tensors([scene([0, 2]), scene([0, 2]), scene([0, 2, 4]), scene([3])])
    found = leave_one_out(data, NO_STRUCTURE, fixed)
    assert found.target.tolist() == [0, 2, 0, 2, 0, 2, 4]
    assert found.above.tolist() == [0, 1, 0, 1, 0, 1, 2]
    assert (found.scenes, found.skipped) == (4, 1)
    metrics = found.metrics()
    assert metrics["MRR"].value == pytest.approx((3 * 1 + 3 / 2 + 1 / 3) / 7)
    assert metrics["MRR"].n == 7
    assert metrics["MRR, macro by class"].value == pytest.approx((1 + 1 / 2 + 1 / 3) / 3)
    assert metrics["top-1"].value == pytest.approx(3 / 7)
    assert metrics["top-2"].value == pytest.approx(6 / 7)
    # A label outside the vocabulary scores 0; the last scene is skipped, whatever else it holds.
    unknown = found.with_unknown(np.array([1, 0, 0, 5]))
    assert unknown.value == pytest.approx(metrics["MRR"].value * 7 / 8)


def test_ties_score_their_expectation_under_random_order():
    """All equal, 4 candidates: the rank is uniform on 1..4."""
    result = leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, torch.zeros_like)
    expected = (1 + 1 / 2 + 1 / 3 + 1 / 4) / 4
    assert result.reciprocal_rank() == pytest.approx([expected] * 2)
    assert result.top(1) == pytest.approx([1 / 4] * 2)
    assert result.top(5) == pytest.approx([1.0] * 2)
    hidden = hide(tensors([scene([0, 3])]), NO_STRUCTURE, None)
    assert rank_hidden(hidden, NO_STRUCTURE, torch.zeros_like)[0].value == pytest.approx(expected)


def test_structure_is_neither_removed_nor_a_candidate():
    result = leave_one_out(tensors([scene([0, 1, 2])]), FLOOR, lambda v: 9.0 * FLOOR.expand_as(v))
    assert result.target.tolist() == [0, 2]
    assert result.above.tolist() == [0, 0]


def test_the_removed_object_cannot_leak():
    """What is scored never sees the target, the second time either."""
    seen = []

    def spy(v):
        seen.append(v.clone())
        return torch.zeros_like(v)

    leave_one_out(tensors([scene([0, 1, 2], [(0, 0, 1)])]), NO_STRUCTURE, spy)
    shown, shown_again = seen
    assert sorted(shown_again.tolist()) == sorted(shown.tolist())
    assert shown.tolist() == [[0, 1, 1, 0, 0], [1, 0, 1, 0, 0], [1, 1, 0, 0, 0]]


CHEATERS = {
    "its relations dangle": lambda evidence, x, target: (
        [target] if evidence.holds[:, x].any() or evidence.holds[:, :, x].any() else []
    ),
    "the whole scene": lambda evidence, x, target: evidence.classes.tolist(),
    "the removed object": lambda evidence, x, target: [target],
}


@pytest.mark.parametrize("cheater", CHEATERS)
@pytest.mark.parametrize("first", [3, 9])
def test_a_planted_cheater_is_caught(cheater, first):
    """A score that counts the questions, however many objects the first scene has."""
    large = scene(range(first), [(0, 0, 1), (1, 1, 2)])
    data = tensors([large, scene([1, 3, 4], [(2, 1, 4)]), scene([0, 10])], WIDE)
    hints = []
    for entry in data.scenes:
        for x, target in enumerate(entry.evidence.classes.tolist()):
            row = torch.zeros(WIDE)
            row[CHEATERS[cheater](entry.evidence, x, target)] = 1.0
            hints.append(row)
    turns = iter(hints * 3)
    with pytest.raises(LeakError, match="leaks information"):
        leave_one_out(data, WIDE_STRUCTURE, lambda v: torch.stack([next(turns) for _ in v]))


def test_a_score_that_is_no_number_is_an_error():
    with pytest.raises(FloatingPointError, match="NaN"):
        leave_one_out(tensors([scene([0, 2])]), NO_STRUCTURE, lambda v: v * float("nan"))


def test_the_room_type_of_the_scene_is_told():
    """A score that knows what belongs to each room finds it there alone."""
    told = []

    def score(v, room):
        told.extend(room.tolist())
        return torch.eye(5)[room + 1]

    data = tensors([scene([0, 1, 2], room=0), scene([0, 1, 2], room=1)])
    result = leave_one_out(data, NO_STRUCTURE, score, with_room=True)
    assert told[:6] == [0, 0, 0, 1, 1, 1]
    assert result.above[[1, 5]].tolist() == [0, 0]
    assert result.ties[0] > 0


# ------------------------------------------------------------------------------------- T2 partial


@pytest.mark.parametrize(("share", "shown"), [(0.25, 1), (0.5, 2), (0.75, 3), (None, 3)])
def test_so_many_are_shown(share, shown):
    """Of four classes; the more are shown, the fewer of the same are hidden."""
    data = tensors([scene([0, 1, 2, 4])])
    found = hide(data, NO_STRUCTURE, share)
    assert (int(found.v.sum()), int(found.hidden.sum())) == (shown, 4 - shown)
    assert torch.equal(found.v + found.hidden, data.v)
    assert bool((found.hidden <= hide(data, NO_STRUCTURE, 0.25).hidden).all())
    # One is shown and one hidden at least.
    small = hide(tensors([scene([0, 3]), scene([1])]), NO_STRUCTURE, share)
    assert small.scene.tolist() == [0]
    assert (int(small.v.sum()), int(small.hidden.sum())) == (1, 1)


def test_structure_is_always_shown_and_never_counted():
    found = hide(tensors([scene([0, 1, 2])]), FLOOR, 0.25)
    assert found.v[0, 1] == 1
    assert int(found.v.sum()) == 2
    # Class 1 has the best score, and is no candidate.
    assert rank_hidden(found, FLOOR, lambda v: FLOOR.float().expand_as(v) * 9 + fixed(v))[0].n == 1


def test_other_hidden_classes_are_not_wrong():
    """Of {0, 1, 3} one is shown: the first hidden one is first, the second has only 2 above it."""
    found = hide(tensors([scene([0, 1, 3])]), NO_STRUCTURE, 0.25)
    hidden = found.hidden[0].nonzero().squeeze(1).tolist()
    mrr, precision = rank_hidden(found, NO_STRUCTURE, fixed)
    above = [sum(c < h for c in (2, 4)) for h in hidden]
    assert mrr.value == pytest.approx(np.mean([1 / (n + 1) for n in above]))
    # Two hidden of the four absent ones: all are among the first five.
    assert precision.value == pytest.approx(2 / 5)
    with pytest.raises(ValueError, match="different items"):
        mrr - precision


def test_questions_depend_on_the_scene_alone():
    data = tensors([scene([0, 1, 2, 3], name=f"n{k}") for k in range(8)])
    whole = hide(data, NO_STRUCTURE, 0.5).hidden
    alone = [hide(tensors([one]), NO_STRUCTURE, 0.5).hidden for one in data.scenes]
    assert torch.equal(whole, torch.cat(alone))
    assert not torch.equal(whole, hide(data, NO_STRUCTURE, 0.5, seed=1).hidden)


def test_a_model_that_knows_what_is_hidden_is_caught(monkeypatch):
    """Planted behind the question itself."""
    data = rooms(30, 1)
    turns = iter(list(hide(data, STRUCTURE, 0.5).hidden.numpy()) * 3)
    honest = asking.missing_probabilities

    def cheat(artifact, asked, coverage=None):
        found = honest(artifact, asked, coverage)
        return np.where(np.isfinite(found), found + next(turns), found)

    monkeypatch.setattr(missing, "missing_probabilities", cheat)
    with pytest.raises(LeakError, match="leaks information"):
        partial_task(Model(artifact=room_model()), Setting(data, STRUCTURE))


def test_a_published_model_is_compared_with_itself():
    setting = Setting(rooms(30, 1), STRUCTURE, limit=10)
    outcome = partial_task(Model(artifact=room_model()), setting)
    assert outcome.scenes == 10
    for share in SHARES:
        names = f"MRR, {share}", f"MRR, {share}, unlisted absent", f"change of MRR, {share}"
        found, closed, change = (outcome.metrics[name].value for name in names)
        assert change == pytest.approx(found - closed)
        assert 0 < found <= 1
    assert next(iter(outcome.metrics)) == "MRR, 50 %"
    baseline = partial_task(
        Model(missing=fixed), Setting(tensors([scene([0, 1, 3])]), NO_STRUCTURE)
    )
    assert set(baseline.metrics) == {f"{m}, {s}" for m in ("MRR", "precision@5") for s in SHARES}


def test_the_score_is_the_service_s_ranking():
    """Absent classes alone, and by probability."""
    v = hide(rooms(10, 1), STRUCTURE, 0.5).v
    for row, own in zip(v, partial_score(room_model())(v), strict=True):
        asked = asking.of_classes(row.nonzero().squeeze(1).tolist())
        p = torch.from_numpy(asking.missing_probabilities(room_model(), asked))
        usable = p > -torch.inf
        assert torch.equal(usable, (row == 0) & ~STRUCTURE)
        assert torch.allclose(own[usable].exp(), p[usable])


# ------------------------------------------------------------------------------------------ T2-at


def test_every_class_in_a_relation_is_asked_for_once_by_one_of_its_relations():
    data = tensors([scene([0, 1, 1, 2, 3], [(0, 0, 1), (2, 2, 1)]), scene([0], [])])
    row, target, places = removed_places(data, NO_STRUCTURE)
    assert (row.tolist(), target.tolist()) == ([0, 0, 0], [0, 1, 2])
    columns = (places.relation, places.anchor, places.outgoing)
    asked = list(zip(*(column.tolist() for column in columns), strict=True))
    assert asked[0] == (0, 1, True)
    assert asked[1] in [(0, 0, False), (2, 2, False)]
    assert asked[2] == (2, 1, True)
    assert places.counts[:2].tolist() == [[0, 2, 1, 1, 0], [1, 0, 1, 1, 0]]


def test_the_class_at_a_place_cannot_leak():
    """It is neither present nor counted nor the anchor, and its relation was true."""
    row, target, places = removed_places(DATA, WIDE_STRUCTURE)
    each = torch.arange(len(row))
    assert bool((places.v[each, target] + places.counts[each, target] == 0).all())
    assert bool((places.v[each, places.anchor] == 1).all())
    assert torch.equal(places.v.sum(1), DATA.v[row].sum(1) - 1)
    for n, k in enumerate(row.tolist()):
        evidence = DATA.scenes[k].evidence
        x, y = np.searchsorted(evidence.classes, [target[n], places.anchor[n]])
        a = places.relation[n]
        assert evidence.holds[a, x, y] if places.outgoing[n] else evidence.holds[a, y, x]


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


def test_structure_and_equal_classes_are_not_asked():
    structure = NO_STRUCTURE.clone()
    structure[4] = True
    found = scene([0, 0, 1, 4], [(0, 0, 4), (3, 0, 1)])
    found.evidence.holds[2, 0, 0] = True
    _, target, places = removed_places(tensors([found]), structure)
    assert sorted(target.tolist()) == [0, 1]
    assert places.relation.tolist() == [3, 3]
    assert len(removed_places(tensors([scene([0, 4], [(0, 0, 4)])]), structure)[0]) == 0


@pytest.mark.parametrize("outgoing", [True, False])
@pytest.mark.parametrize("name", ["rbm", "triway-local"])
def test_the_question_names_the_place_as_a_robot_does(name, outgoing):
    """On-top of the first of two objects of class 2, by the relation as the missing object's."""
    slope = PairSlope(intercept=0.2, slope=0.7, log_count=0.3, log_classes=-0.4)
    counts = CountSlope(intercept=-0.3, slope=0.8, log_count=0.4)
    artifact = artifact_of(
        larger_machine(name), missing=counts, placement=(slope,) * 4, coverage=0.7
    )
    v = torch.zeros(2, artifact.spec.V)
    v[:, [0, 2, 5]] = 1.0
    number = v.clone()
    number[:, 2] = 2.0
    # Another row must not disturb the first.
    relation, anchor = torch.tensor([2, 0]), torch.tensor([2, 5])
    places = Places(v, number, relation, anchor, torch.tensor([outgoing, not outgoing]))
    values = placed_score(artifact)(places)[0]
    things = tuple(SceneObject(str(k), "x", c) for k, c in enumerate([0, 2, 2, 5]))
    spoken = CANONICAL[2] if outgoing else OPPOSITES[CANONICAL[2]]
    answers = ask_missing(artifact, Scene(things), top_k=artifact.spec.V, at=(spoken, 1))
    for answer in answers:
        found = values[artifact.vocabulary.index(answer.label)]
        assert float(found.exp()) == pytest.approx(answer.probability, rel=1e-5)
    # Structure and what is there are no candidates.
    assert int((values > -torch.inf).sum()) == len(answers)
