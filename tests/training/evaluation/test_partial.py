"""T2 partial by hand: what is hidden, how it is ranked, and that it cannot leak."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors
from training.evaluation import asking, partial
from training.evaluation.contenders import Contender
from training.evaluation.missing import LeakError
from training.evaluation.partial import (
    SHARES,
    difference,
    hide,
    partial_score,
    partial_task,
    rank_hidden,
)
from training.evaluation.setting import Setting

FIXED = torch.tensor([5.0, 4, 3, 2, 1])


def fixed(v):
    return FIXED.expand_as(v)


@pytest.mark.parametrize(("share", "shown"), [(0.25, 1), (0.5, 2), (0.75, 3), (None, 3)])
def test_so_many_are_shown(share, shown):
    """Of four classes; the more are shown, the fewer of the same are hidden."""
    data = tensors([scene([0, 1, 2, 4])])
    found = hide(data, NO_STRUCTURE, share)
    assert int(found.v.sum()) == shown
    assert int(found.hidden.sum()) == 4 - shown
    assert torch.equal(found.v + found.hidden, data.v)
    assert bool((found.hidden <= hide(data, NO_STRUCTURE, 0.25).hidden).all())


@pytest.mark.parametrize("share", SHARES.values())
def test_one_is_shown_and_one_hidden_at_least(share):
    found = hide(tensors([scene([0, 3]), scene([1])]), NO_STRUCTURE, share)
    assert found.scene.tolist() == [0]
    assert (int(found.v.sum()), int(found.hidden.sum())) == (1, 1)


def test_structure_is_always_shown_and_never_counted():
    structure = NO_STRUCTURE.clone()
    structure[0] = True
    data = tensors([scene([0, 1, 2])])
    found = hide(data, structure, 0.25)
    assert found.v[0, 0] == 1
    assert int(found.v.sum()) == 2
    # Class 0 has the best score, and stands in nobody's way.
    ranking = rank_hidden(found, structure, fixed)
    assert ranking.mrr.value == 1.0


def test_other_hidden_classes_are_not_wrong():
    """Of {0, 1, 3} one is shown: the first hidden one is first, the second has only 2 above it."""
    data = tensors([scene([0, 1, 3])])
    found = hide(data, NO_STRUCTURE, 0.25)
    hidden = found.hidden[0].nonzero().squeeze(1).tolist()
    ranking = rank_hidden(found, NO_STRUCTURE, fixed)
    above = [sum(c < h for c in range(5) if c not in (0, 1, 3)) for h in hidden]
    assert ranking.mrr.value == pytest.approx(np.mean([1 / (n + 1) for n in above]))
    # Two hidden of the four absent ones: all are among the first five.
    assert ranking.precision.value == pytest.approx(2 / 5)


def test_ties_are_expectations():
    found = hide(tensors([scene([0, 3])]), NO_STRUCTURE, None)
    ranking = rank_hidden(found, NO_STRUCTURE, torch.zeros_like)
    assert ranking.mrr.value == pytest.approx((1 + 1 / 2 + 1 / 3 + 1 / 4) / 4)


def test_questions_depend_on_the_scene_alone():
    data = tensors([scene([0, 1, 2, 3], name=f"n{k}") for k in range(8)])
    whole = hide(data, NO_STRUCTURE, 0.5).hidden
    alone = [hide(tensors([one]), NO_STRUCTURE, 0.5).hidden for one in data.scenes]
    assert torch.equal(whole, torch.cat(alone))
    assert not torch.equal(whole, hide(data, NO_STRUCTURE, 0.5, seed=1).hidden)


@pytest.mark.parametrize("share", SHARES.values())
def test_a_score_that_knows_what_is_hidden_is_caught(share):
    data = rooms(30, 1)
    found = hide(data, STRUCTURE, share)
    turns = iter([*found.hidden, *found.hidden, *found.hidden])

    def cheat(v):
        return torch.stack([next(turns).double() for _ in v])

    with pytest.raises(LeakError, match="something leaks"):
        rank_hidden(found, STRUCTURE, cheat)


def test_a_model_that_knows_what_is_hidden_is_caught(monkeypatch):
    """Planted behind the question itself."""
    data = rooms(30, 1)
    setting = Setting(data, STRUCTURE)
    turns = iter(list(hide(data, STRUCTURE, 0.5).hidden.numpy()) * 3)
    honest = asking.missing_probabilities

    def cheat(artifact, asked, coverage=None):
        found = honest(artifact, asked, coverage)
        return np.where(np.isfinite(found), found + next(turns), found)

    monkeypatch.setattr(partial, "missing_probabilities", cheat)
    with pytest.raises(LeakError, match="something leaks"):
        partial_task(Contender(artifact=room_model()), setting)


def test_a_published_model_is_compared_with_itself():
    data = rooms(30, 1)
    outcome = partial_task(Contender(artifact=room_model()), Setting(data, STRUCTURE, limit=10))
    assert outcome.scenes == 10
    for share in SHARES:
        found, closed, change = (
            outcome.metrics[name].value
            for name in (
                f"MRR, {share}",
                f"MRR, {share}, unlisted absent",
                f"change of MRR, {share}",
            )
        )
        assert change == pytest.approx(found - closed)
        assert 0 < found <= 1
    assert next(iter(outcome.metrics)) == "MRR, 50 %"


def test_a_baseline_takes_part_without_a_coverage():
    setting = Setting(tensors([scene([0, 1, 3])]), NO_STRUCTURE)
    metrics = partial_task(Contender(objects=fixed), setting).metrics
    assert set(metrics) == {f"{m}, {s}" for m in ("MRR", "precision@5") for s in SHARES}
    assert partial_task(Contender(), Setting(rooms(5, 1), STRUCTURE)) is None


def test_the_score_is_the_service_s_ranking():
    """Absent classes alone, and by probability."""
    data = rooms(10, 1)
    v = hide(data, STRUCTURE, 0.5).v
    values = partial_score(room_model())(v)
    for row, own in zip(v, values, strict=True):
        scene_ = asking.of_classes(row.nonzero().squeeze(1).tolist())
        p = torch.from_numpy(asking.missing_probabilities(room_model(), scene_))
        usable = p > -torch.inf
        assert torch.equal(usable, (row == 0) & ~STRUCTURE)
        assert torch.allclose(own[usable].exp(), p[usable])


def test_differences_are_of_the_same_items():
    found = hide(tensors([scene([0, 1, 3])]), NO_STRUCTURE, 0.5)
    ranking = rank_hidden(found, NO_STRUCTURE, fixed)
    assert difference(ranking.mrr, ranking.mrr).value == 0
    with pytest.raises(ValueError, match="different items"):
        difference(ranking.mrr, ranking.precision)
