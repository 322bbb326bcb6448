from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.training.evaluation.scenes import FLOOR, NO_STRUCTURE, V, in_order, scene, tensors
from training.evaluation.parts import (
    Ranking,
    all_but_one,
    draw_parts,
    exactly,
    one_quarter,
    rank_hidden,
    share_bin,
    up_to_longest,
    validation_score,
)


@pytest.mark.parametrize(
    ("classes", "size", "listed"),
    [
        *((4, size, k) for size, k in ((one_quarter, 1), (all_but_one, 3), (exactly(2), 2))),
        *((2, size, 1) for size in (one_quarter, all_but_one, up_to_longest)),
        (4, exactly(4), 0),
        *((classes, up_to_longest, 0) for classes in (0, 1)),
    ],
)
def test_the_size_of_a_part(classes, size, listed):
    """Listed and hidden classes are the scene; small scenes are skipped."""
    data = tensors([scene(range(classes))])
    parts = draw_parts(data, NO_STRUCTURE, size)
    assert (len(parts.scene), parts.skipped) == (listed > 0, listed == 0)
    for v, hidden in zip(parts.v, parts.hidden, strict=True):
        assert int(v.sum()) == listed
        assert torch.equal(v + hidden, data.v[0])


def test_structure_is_neither_listed_nor_hidden_nor_a_candidate():
    parts = draw_parts(tensors([scene([0, 1, 2])]), FLOOR, all_but_one, range(9))
    assert not (parts.v + parts.hidden)[:, FLOOR].any()
    ranking = rank_hidden(parts, FLOOR, 9.0 * FLOOR.float() + torch.zeros_like(parts.v))
    assert set(ranking.above.tolist()) == {0}
    # Two of three things are candidates besides the listed one.
    assert set(ranking.ties.tolist()) == {2}


def test_every_length_up_to_twelve_is_drawn():
    data = tensors([scene(range(20), name=f"n{k}") for k in range(200)], 20)
    parts = draw_parts(data, torch.zeros(20, dtype=torch.bool), up_to_longest)
    assert set(parts.v.sum(1).int().tolist()) == set(range(1, 13))


def test_parts_depend_on_the_scene_and_the_seed_alone():
    data = tensors([scene([0, 1, 2, 3], name=f"n{k}") for k in range(8)])
    whole = draw_parts(data, NO_STRUCTURE, exactly(2), (0, 1)).hidden
    alone = [draw_parts(tensors([one]), NO_STRUCTURE, exactly(2)).hidden for one in data.scenes]
    assert torch.equal(whole[:8], torch.cat(alone))
    assert not torch.equal(whole[:8], whole[8:])


def test_ties_score_their_expectation_under_random_order():
    """All four candidates are equal: the rank is uniform on 1..4."""
    parts = draw_parts(tensors([scene([0, 2])]), NO_STRUCTURE, all_but_one)
    ranking = rank_hidden(parts, NO_STRUCTURE, torch.zeros_like(parts.v))
    assert ranking.mrr().value == pytest.approx((1 + 1 / 2 + 1 / 3 + 1 / 4) / 4)
    assert ranking.top(1).value == pytest.approx(1 / 4)
    assert ranking.top(5).value == 1.0


def test_a_score_of_minus_infinity_ranks_last_and_nan_is_an_error():
    parts = draw_parts(tensors([scene([0, 2])]), NO_STRUCTURE, all_but_one)
    lowest = torch.zeros_like(parts.v).masked_fill(parts.hidden, -torch.inf)
    assert rank_hidden(parts, NO_STRUCTURE, lowest).above.tolist() == [3]
    with pytest.raises(FloatingPointError, match="NaN"):
        Ranking.of(parts.scene, parts.scene, torch.full((1, V), torch.nan), 1)


def test_bins_of_the_listed_share():
    """All but one is a bin of its own, at any share."""
    listed = torch.tensor([1, 3, 4, 6, 7, 9, 1, 2])
    classes = torch.tensor([10, 10, 10, 10, 10, 10, 2, 8])
    assert share_bin(listed, classes).tolist() == [0, 0, 1, 1, 2, 3, 3, 0]


def test_the_validation_score_counts_real_sources_alike():
    """The score finds the classes of sunrgbd first, and those of 3dssg last; procthor is left out.
    Scenes {0, 1} of sunrgbd hide one class, which is first. Scenes {3, 4} of 3dssg hide one class,
    which is last of four candidates."""
    few = [scene([0, 1], source="sunrgbd", name=f"s{k}") for k in range(3)]
    many = [scene([3, 4], source="3dssg", name=f"d{k}") for k in range(9)]
    other = [scene([0, 4], source="procthor")]
    data = tensors([*few, *many, *other])
    seen = []

    def score(v, bins):
        assert bins.tolist() == [3] * len(v)
        seen.append(v)
        return in_order(v)

    assert validation_score(score, data, NO_STRUCTURE) == pytest.approx((1 + 1 / 4) / 2)
    assert sum(map(len, seen)) == 2 * 12
    only = validation_score(lambda v, _: in_order(v), tensors(other), NO_STRUCTURE)
    assert only == pytest.approx(1) or only == pytest.approx(1 / 4)


def test_the_validation_score_gives_short_lists_their_bin():
    data = tensors([scene(range(20), source="sunrgbd", name=f"n{k}") for k in range(60)], 20)
    share = {0: (0, 0.3), 1: (0.3, 0.6), 3: (0.95, 0.95)}  # at most 12 of 20 are listed
    drawn = set()

    def score(v, bins):
        drawn.update(bins.tolist())
        for listed, b in zip((v.sum(1) / 20).tolist(), bins.tolist(), strict=True):
            assert share[b][0] - 1e-6 <= listed <= share[b][1] + 1e-6
        return torch.zeros_like(v)

    value = validation_score(score, data, torch.zeros(20, dtype=torch.bool))
    assert drawn == {0, 1, 3}
    # All candidates but the other hidden classes are equal, so the only candidate is first.
    assert value == 1.0


def test_the_validation_score_without_hidden_classes_is_undefined():
    single = tensors([scene([0], source="sunrgbd")])
    assert np.isnan(validation_score(lambda v, _: v, single, NO_STRUCTURE))
    listed = [replace(scene([0, 1]), complete=False)]
    assert validation_score(lambda v, _: in_order(v), tensors(listed), NO_STRUCTURE) > 0
