import re
from collections import defaultdict
from functools import cache

import pytest
import torch

from tests.training.research.baselines.furnished import (
    BEDROOM,
    FLOOR,
    KITCHEN,
    LEFT,
    STRUCTURE,
    V,
    furnished,
    scene,
    tensors,
)
from training.evaluation import selection
from training.evaluation.baselines import PLACED, placed_product
from training.evaluation.object_tasks import removed_places
from training.evaluation.outlier_tasks import moved_cases
from training.evaluation.relation_tasks import with_observed
from training.evaluation.selection import TRIALS, Baseline, drawn_settings, halving
from training.research.baselines import BASELINES, object_models

TRAIN, VALIDATION = furnished(300, seed=1), furnished(60, seed=2)
EVERY = tuple(BASELINES.values())
OBJECTS, OF_ROOMS, OF_RELATIONS, COMPLETIONS, (SUPPORTERS,) = (
    [one for one in EVERY if one.answer is answer]
    for answer in (
        selection.OBJECTS, selection.ROOMS, selection.RELATIONS, selection.COMPLETION,
        selection.MISPLACED,
    )
)  # fmt: skip


PROGRESS = defaultdict(list)


@pytest.fixture(scope="module", autouse=True)
def _short_courses():
    """A few steps suffice for two kinds of rooms."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(object_models, "_STEPS", 60)
        yield


def named(baselines):
    return pytest.mark.parametrize("baseline", baselines, ids=lambda baseline: baseline.name)


@cache
def fitted(baseline: Baseline):
    """One fit of each, shared by the tests."""
    say = PROGRESS[baseline.name].append
    return baseline.fit(TRAIN, VALIDATION, STRUCTURE, seed=0, progress=say)


@cache
def value(baseline: Baseline) -> float:
    score = getattr(fitted(baseline), baseline.answer.fields[0])
    return baseline.answer.judge(VALIDATION, STRUCTURE, score)


def answers(baseline: Baseline, score):
    if baseline in OBJECTS:
        return score(VALIDATION.v)
    if baseline is PLACED:
        return score(removed_places(VALIDATION, STRUCTURE)[2])
    if baseline is SUPPORTERS:
        cases = moved_cases(VALIDATION, STRUCTURE)
        return torch.tensor([entry["probability"] for case in cases for entry in score(case.moved)])
    if baseline in OF_ROOMS:
        return score(VALIDATION.v, "toy")
    return score(VALIDATION.batch(torch.arange(20)))


# These have few settings, or none.
FEW = ("popularity", "most common room type", "relation popularity")


@named(EVERY)
def test_the_best_of_enough_settings_is_chosen(baseline):
    """On scenes of one kind, a baseline has a quarter of its settings for the sets of scenes."""
    best = value(baseline)
    lines = (line.rsplit(": ", 1) for line in PROGRESS[baseline.name])
    names, values = zip(*lines, strict=True)
    assert len(set(names)) == len(names)
    assert best == pytest.approx(max(map(float, values)), abs=1e-4)
    settings = {re.sub(r",? ?(steps|epochs) \d+", "", name) for name in names}
    chooses = 4 if "scenes" in names[0] else 1
    assert baseline.name in FEW or chooses * len(settings) >= TRIALS


def test_the_best_of_the_short_fits_are_fitted_in_full():
    settings = drawn_settings(rate=range(10), size=range(10))
    assert len({tuple(setting.values()) for setting in settings}) == TRIALS

    def fit(setting, share):
        yield {"share": share}, setting["rate"] + share

    search = halving(settings, fit, ((TRIALS, 0.1), (2, 1.0)))
    tried = [next(search)]
    while len(tried) < TRIALS + 2:
        tried.append(search.send(tried[-1][1]))
    with pytest.raises(StopIteration):
        search.send(0.0)
    best = sorted((setting["rate"] for setting in settings), reverse=True)[:2]
    full = [parameters["rate"] for parameters, _ in tried if parameters["share"] == 1.0]
    assert sorted(full, reverse=True) == best


@named(OF_ROOMS[1:])
def test_rooms_follow_their_objects(baseline):
    assert value(baseline) > value(OF_ROOMS[0]) + 0.3
    v = torch.zeros(2, V)
    v[0, list(KITCHEN[:2])] = v[1, list(BEDROOM[:2])] = 1.0
    for profile in ("", "toy"):
        log_p = fitted(baseline).rooms(v, profile)
        torch.testing.assert_close(log_p.exp().sum(1), torch.ones(2))
        assert log_p.argmax(1).tolist() == [0, 1]


@named(OBJECTS[1:])
def test_objects_belong_to_their_room(baseline):
    """Popularity cannot tell a kitchen from a bedroom: of 8 classes alike it finds 1 in 4 or so."""
    assert value(baseline) > value(OBJECTS[0]) + 0.1
    v = torch.zeros(1, V)
    v[0, [*KITCHEN[:3], FLOOR]] = 1.0
    score = fitted(baseline).missing(v)[0]
    assert score[KITCHEN[3]] > score[BEDROOM[3]]


@named(OBJECTS)
def test_object_scores_are_numbers_and_scenes_do_not_mix(baseline):
    score = fitted(baseline).missing
    scenes = torch.cat([VALIDATION.v[:20], torch.zeros(1, V)])
    values = score(scenes)
    assert values.shape == (21, V)
    candidates = (scenes == 0) & ~STRUCTURE
    assert torch.isfinite(values[candidates]).all()
    alone = torch.cat([score(row.unsqueeze(0)) for row in scenes])
    torch.testing.assert_close(alone[candidates], values[candidates], rtol=1e-4, atol=1e-4)


@named(EVERY)
def test_stochastic_fits_depend_on_the_seed_alone(baseline):
    """By the first setting that a baseline tries."""
    torch.manual_seed(123)
    state = torch.get_rng_state()
    first, again, other = (
        answers(baseline, next(baseline.propose(VALIDATION, STRUCTURE, seed))[1])
        for seed in (0, 0, 1)
    )
    assert torch.equal(torch.get_rng_state(), state), "the global generator was disturbed"
    assert torch.equal(first, again)
    assert torch.equal(first, other) is not baseline.stochastic


@named(OF_RELATIONS[1:])
def test_relations_beat_popularity(baseline):
    assert value(baseline) > value(OF_RELATIONS[0]) + 0.2


@named(OF_RELATIONS)
def test_relation_scores_ignore_the_true_relations(baseline):
    batch = VALIDATION.batch(torch.arange(10))
    blank = with_observed(batch)
    score = fitted(baseline).relations
    assert score(batch).shape == batch.holds.shape
    assert torch.equal(score(batch), score(blank))


def test_closure_completes_chains_that_the_table_cannot():
    """Where left is drawn at random, only what is given tells how the chain goes on."""
    generator = torch.Generator().manual_seed(0)

    def shuffled(count):
        scenes = []
        for k in range(count):
            row = torch.randperm(6, generator=generator).tolist()
            chain = [(LEFT, i, j) for place, i in enumerate(row) for j in row[place + 1 :]]
            scenes.append(scene(range(6), chain, name=str(k)))
        return tensors(scenes)

    train, held_out = shuffled(60), shuffled(60)
    table, closure = (
        b.answer.judge(held_out, STRUCTURE, b.fit(train, held_out, STRUCTURE).completion)
        for b in COMPLETIONS
    )
    # Half of the ordered pairs hold, so the table is right by chance alone.
    assert table < 0.7
    assert closure > table + 0.1


def test_the_placed_table_finds_the_missing_class():
    """On the second class lies the first of its room; the product with EASE is no worse."""
    assert value(PLACED) > 0.8
    ease, table = (fitted(b) for b in (BASELINES["EASE"], PLACED))
    product = placed_product("EASE", ease, table)
    assert "× EASE" in product.name
    score = product.fit(TRAIN, VALIDATION, STRUCTURE).at_place
    assert product.answer.judge(VALIDATION, STRUCTURE, score) >= value(PLACED) - 0.02


@named(EVERY)
def test_nothing_to_learn_from_is_an_error(baseline):
    related = [("observed relation", [0, 1])] if baseline.answer.of_relations else []
    for what, classes in (("objects", []), *related):
        with pytest.raises(ValueError, match=f"the 1 training scenes contain no {what}"):
            baseline.fit(tensors([scene(classes, annotated=False)]), VALIDATION, STRUCTURE)


def test_a_score_that_is_no_number_is_an_error():
    answer = selection.Answer((), lambda *_: float("nan"))
    broken = Baseline("broken", lambda *_: iter([({}, None)]), answer)
    with pytest.raises(FloatingPointError, match="broken"):
        broken.fit(TRAIN, VALIDATION, STRUCTURE)
