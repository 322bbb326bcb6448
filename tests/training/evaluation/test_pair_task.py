from dataclasses import replace

import numpy as np
import pytest
import torch

from app.scene import CANONICAL
from app.scene.spatial_relations import INSIDE, STACKED
from tests.training.evaluation.furnished_rooms import STRUCTURE, room_model, rooms
from tests.training.evaluation.scenes import (
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    flat,
    knowing,
    random_scenes,
    scene,
    tensors,
    values_of,
)
from training.datasets.batches import seen_triples
from training.evaluation.asking import labels_alone, relation_probabilities
from training.evaluation.pair_task import (
    RARE,
    baseline_log_odds,
    lateral_shift,
    listed_pairs,
    pairs_task,
    service_score,
    without_inside,
)
from training.evaluation.setting import Model, Setting

LEFT, ON, ABOVE, A = 0, 2, 3, len(CANONICAL)
DATA = tensors(random_scenes(20), WIDE)


def log_odds(p):
    """A relation score of the same values everywhere, by relation and direction of the places."""

    def score(batch):
        n = batch.classes.shape[1]
        values = torch.full(batch.holds.shape, -20.0)
        for (a, back), value in p.items():
            mask = torch.ones(n, n).triu(1).T if back else torch.ones(n, n).triu(1)
            values[:, a] += mask * (torch.tensor(value).logit() + 20)
        return values

    return score


def test_questions_are_pairs_of_things_with_a_vertical_relation():
    structure = torch.arange(len(NO_STRUCTURE)) == 3
    data = tensors(
        [
            scene([0, 1, 2, 3], [(ON, 1, 0), (LEFT, 0, 1), (LEFT, 1, 2), (ON, 2, 3)]),
            scene([0, 1], [(LEFT, 0, 1)]),
        ]
    )
    (asked,) = listed_pairs(data, structure)
    assert asked.scene.evidence.classes[asked.pairs].tolist() == [[0, 1]]
    # left(0, 1) and on-top(1, 0): the first to the second, then back.
    assert np.flatnonzero(asked.listed[0]).tolist() == [LEFT, A + ON]


EITHER = [scene([0, 1], [(ON, 1, 0)]), scene([0, 1], [(ON, 0, 1)])]
SEVERAL = [scene([0, 1], [(ON, 1, 0), (LEFT, 0, 1)])]


@pytest.mark.parametrize(
    ("scenes", "p", "accuracy", "log_loss"),
    [
        # on-top back has .6 of a total of 1: it is the likeliest, and its share is .6.
        (EITHER, {(ON, True): 0.6, (ON, False): 0.3, (LEFT, False): 0.1}, 0.5, -np.log(0.18) / 2),
        # Any listed relation is right.
        (SEVERAL, {(ON, True): 0.3, (LEFT, False): 0.6, (ABOVE, True): 0.1}, 1.0, -np.log(0.9)),
        # Inside is no candidate.
        (EITHER[:1], {(INSIDE, True): 0.9, (ON, True): 0.6, (LEFT, True): 0.2}, 1.0, -np.log(0.75)),
    ],
)
def test_accuracy_and_log_loss_by_hand(scenes, p, accuracy, log_loss):
    setting = Setting(tensors(scenes), NO_STRUCTURE)
    metrics = pairs_task(Model(relations=log_odds(p)), setting).metrics
    assert metrics["accuracy"].value == accuracy
    assert metrics["log-loss"].value == pytest.approx(log_loss, rel=1e-4)


def test_perfect_and_ignorant_scores():
    setting = Setting(DATA, WIDE_STRUCTURE)
    assert pairs_task(Model(relations=knowing(DATA)), setting).metrics["accuracy"].value == 1
    ignorant = pairs_task(Model(relations=flat), setting).metrics
    asked = np.concatenate([one.listed for one in listed_pairs(DATA, WIDE_STRUCTURE)])
    listed = without_inside(asked)
    assert listed.shape == (len(asked), 8)
    assert ignorant["accuracy"].value == pytest.approx(listed.mean())
    assert ignorant["log-loss"].value == pytest.approx(-np.log(listed.mean(1)).mean())


def test_inside_pairs_have_ten_candidates():
    structure = torch.arange(len(NO_STRUCTURE)) == 3
    scenes = [
        scene([0, 1, 3], [(INSIDE, 1, 0), (INSIDE, 1, 3)]),
        scene([0, 1], [(INSIDE, 0, 1)]),
        scene([0, 1], [(LEFT, 0, 1)]),
    ]
    setting = Setting(tensors(scenes), structure)
    for p, accuracy in (
        ({(INSIDE, True): 0.5, (ON, True): 0.4}, 1 / 2),
        ({(INSIDE, True): 0.5, (INSIDE, False): 0.6}, 1 / 2),
        ({(INSIDE, True): 0.5, (ON, True): 0.6}, 0),
    ):
        outcome = pairs_task(Model(relations=log_odds(p)), setting)
        assert values_of(outcome) == {"accuracy of ten, inside pairs": accuracy}
        assert outcome.scenes == 2
    ignorant = pairs_task(Model(relations=flat), setting).metrics
    assert ignorant["accuracy of ten, inside pairs"].value == pytest.approx(1 / 10)


def test_unseen_pairs_are_those_that_no_training_relation_joins():
    data = tensors([scene([0, 1, 2], [(ON, 1, 0), (ON, 2, 1)])])
    # left(1, 0) is listed in training: the pair is seen, whatever the relation.
    train = tensors([scene([0, 1, 2], [(LEFT, 1, 0)])])
    for seen in (None, seen_triples(train.scenes, 5)):
        setting = Setting(data, NO_STRUCTURE, train, seen)
        metrics = pairs_task(Model(relations=flat), setting).metrics
        assert (metrics["accuracy"].n, metrics["accuracy, unseen pairs"].n) == (2, 1)
    unknown = pairs_task(Model(relations=flat), Setting(data, NO_STRUCTURE)).metrics
    assert "accuracy, unseen pairs" not in unknown


def test_rare_classes_are_those_that_training_relates_to_few():
    """Class 0 is related to RARE + 1 others, all others to it alone: (0, 1) has a rare end."""
    V = RARE + 3
    train = tensors([scene([0, k], [(ON, k, 0)]) for k in range(1, V - 1)], V)
    none = torch.zeros(V, dtype=torch.bool)
    for other in (1, V - 1):
        data = tensors([scene([0, other], [(ON, other, 0)])], V)
        metrics = pairs_task(Model(relations=flat), Setting(data, none, train)).metrics
        assert metrics["accuracy, rare classes"].n == 1
    train = tensors([scene([a, b], [(ON, a, b)]) for a in range(V) for b in range(a)], V)
    metrics = pairs_task(Model(relations=flat), Setting(data, none, train)).metrics
    assert "accuracy, rare classes" not in metrics


def test_the_service_score_is_that_of_the_first_instances():
    asked = next(one for one in listed_pairs(rooms(20, 2), STRUCTURE) if len(one.pairs) > 2)
    p = service_score(room_model())(asked)
    every = relation_probabilities(room_model(), labels_alone(asked.scene))
    own = asked.scene.instance_classes
    classes = asked.scene.evidence.classes[asked.pairs]
    for (i, j), row in zip(classes.tolist(), p, strict=True):
        x, y = (int(np.flatnonzero(own == c)[0]) for c in (i, j))
        assert row == pytest.approx([*every[:, x, y], *every[:, y, x]])
    assert p.max() <= 1


def test_the_limit_counts_scenes_with_such_a_pair():
    silent = [scene([0, 1], [(LEFT, 0, 1)], name=f"s{k}") for k in range(20)]
    data = tensors([*silent, *(scene([0, 1], [(ON, 1, 0)], name=f"t{k}") for k in range(3))])
    setting = Setting(data, NO_STRUCTURE, limit=2)
    assert pairs_task(Model(relations=flat), setting).scenes == 2
    assert pairs_task(Model(relations=flat), replace(setting, scenes=tensors(silent))) is None
    assert pairs_task(Model(), setting) is None


@pytest.mark.parametrize(("side", "shift"), [(-0.2, 0.0), (0.2, -0.4), (0.5, -0.8), (5.0, 0.0)])
def test_a_rival_gets_the_shift_of_left_and_front_of_the_service(side, shift):
    """On-top has the log-odds 0, left the log-odds `side`. With a shift, both are right."""
    scenes = tensors([scene([0, 1], [(ON, 1, 0)], name=f"stack {k}") for k in range(4)])

    def relations(batch):
        log_odds = torch.full(batch.holds.shape, -9.0)
        log_odds[:, ON, 1, 0], log_odds[:, LEFT, 0, 1] = 0.0, side
        return log_odds

    questions = listed_pairs(scenes, NO_STRUCTURE, STACKED)
    found = lateral_shift(baseline_log_odds(scenes, relations), questions)
    assert found == shift
    setting = Setting(scenes, NO_STRUCTURE)
    values = [
        pairs_task(Model(relations=relations, lateral=x), setting).metrics["accuracy"].value
        for x in (0.0, found)
    ]
    assert values == [float(side < 0), float(side < 1)]
    assert lateral_shift(baseline_log_odds(scenes, relations), []) == 0.0
