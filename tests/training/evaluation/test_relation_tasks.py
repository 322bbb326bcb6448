import numpy as np
import pytest
import torch

from app.scene import CANONICAL, ObjectClass, Vocabulary
from tests.questions.artifacts import larger_artifact
from tests.training.evaluation.scenes import (
    FLOOR,
    NO_STRUCTURE,
    WIDE,
    WIDE_STRUCTURE,
    V,
    flat,
    knowing,
    random_scenes,
    scene,
    tensors,
    toy,
)
from training.datasets import AnnotatedObject, AnnotatedScene, encode
from training.datasets.batches import seen_triples
from training.evaluation.asking import score_relations
from training.evaluation.relation_tasks import (
    complete_scenes,
    draw_false_triple,
    expected_hits,
    false_hits,
    r_precision,
    score_scenes,
    unseen,
    with_observed,
)

A = len(CANONICAL)
DATA = tensors(random_scenes(30), WIDE)


def by_hand(batch):
    """left(0,1) before left(1,0) before front(1,0); equal classes are no candidates."""
    values = torch.zeros(len(batch), 2, 2, 2)
    values[:, 0, 0, 1] = 3
    values[:, 0, 1, 0] = 2
    values[:, 1, 1, 0] = 1
    values[:, :, [0, 1], [0, 1]] = 9
    return values


class Spy:
    """A score that knows nothing and keeps the rows that it was asked about."""

    def __init__(self):
        self.rows = []

    def __call__(self, batch):
        self.rows += [batch.rows(torch.tensor([k])) for k in range(len(batch))]
        return flat(batch)


def related(triples):
    return [one.evidence for one in DATA.scenes if one.evidence.holds.sum() >= triples]


def test_r_precision_by_hand():
    """Two annotated triples; the two best scores hit one of them."""
    data = tensors([toy([0, 1], [(0, 0, 1), (1, 1, 0)]), toy([0, 1], [(0, 0, 1)]), toy([0, 1])])
    scored = score_scenes(data, NO_STRUCTURE, by_hand)
    ratio = r_precision(scored, 3)
    assert (ratio.denominators.tolist(), ratio.skipped) == ([2, 1, 0], 1)
    assert ratio.value == pytest.approx(2 / 3)
    assert ratio.mean_over_scenes().value == pytest.approx((1 / 2 + 1) / 2)
    first = scored[:1]
    assert r_precision([first[0].rows(first[0].relation == 0)], 1).value == 1.0
    assert [r_precision(first, 1, first=k).value for k in (1, 3, 20)] == [0.5, 1.0, 1.0]
    # left(0, 1) was seen; of the others left(1, 0) comes first and front(1, 0) is the true one.
    new = r_precision(unseen(first, torch.tensor([[0, 0, 1]]), V), 1)
    assert (new.denominators.tolist(), new.value) == ([1], 0.0)
    both = torch.tensor([[0, 0, 1], [0, 1, 0]])
    assert r_precision(unseen(first, both, V), 1).value == 1.0


def test_scores_that_know_everything_or_nothing():
    """A flat score hits R of R out of k candidates: R² / k in expectation."""
    knows, n = knowing(DATA), len(DATA)
    for scored in (score_scenes, complete_scenes):
        assert r_precision(scored(DATA, WIDE_STRUCTURE, knows), n).value == 1.0
        for asked in scored(DATA, WIDE_STRUCTURE, flat):
            held = asked.truth.sum()
            hits = expected_hits(asked.score, asked.truth, held)
            assert not held or hits == pytest.approx(held**2 / len(asked.score))
    assert false_hits(DATA, WIDE_STRUCTURE, knows).value == 1.0
    chance = [1 / evidence.holds.sum() for evidence in related(2)]
    assert false_hits(DATA, WIDE_STRUCTURE, flat).value == pytest.approx(np.mean(chance))


def test_expected_hits_shares_ties():
    values, truth = np.array([2.0, 1, 1, 1]), np.array([False, True, False, False])
    assert expected_hits(values, truth, 2) == pytest.approx(1 / 3)
    assert expected_hits(values, truth, 9) == 1.0
    assert expected_hits(np.full(4, -np.inf), truth, 1) == pytest.approx(1 / 4)


def test_structure_is_no_end_of_a_relation():
    data = tensors([scene([0, 1, 2], [(0, 0, 1), (0, 0, 2), (1, 0, 2)])])
    (scored,) = score_scenes(data, FLOOR, flat)
    assert (len(scored.score), scored.truth.sum()) == (A * 2, 2)
    assert false_hits(data, FLOOR, flat).value == 1 / 2


def test_a_question_of_t1a_observes_no_relation():
    """Without `counts`, the number of instances is unknown."""
    spy = Spy()
    data = tensors([scene([0, 1, 1], [(0, 0, 1)])])
    score_scenes(data, NO_STRUCTURE, spy)
    score_scenes(data, NO_STRUCTURE, spy, counts=False)
    assert not any(bool(one.holds.any()) or bool(one.observed.any()) for one in spy.rows)
    assert [one.counts.tolist() for one in spy.rows] == [[[1, 2]], [[0, 0]]]


def test_a_score_of_nan_is_an_error():
    data = tensors([scene([0, 1], [(0, 0, 1)])])
    with pytest.raises(FloatingPointError, match="NaN"):
        score_scenes(data, NO_STRUCTURE, lambda batch: flat(batch) * float("nan"))


def test_seen_triples_are_counted_by_scene():
    scenes = [scene([0, 1], [(0, 0, 1)]), scene([0, 1], [(0, 0, 1), (1, 1, 0)])]
    assert seen_triples(scenes, V).tolist() == [[0, 0, 1], [1, 1, 0]]
    assert seen_triples(scenes, V, minimum=2).tolist() == [[0, 0, 1]]


def test_halves_are_disjoint_and_together_the_truth():
    """Given plus asked is all; nothing given, nor its mirror image, is asked."""
    spy = Spy()
    asked = complete_scenes(DATA, WIDE_STRUCTURE, spy)
    for one, own, evidence in zip(spy.rows, asked, related(2), strict=True):
        n = len(evidence.classes)
        truth, given = torch.from_numpy(evidence.holds), one.holds[0, :, :n, :n] > 0
        assert bool((given <= truth).all())
        assert int(one.holds.sum()) == int(truth.sum()) // 2
        assert bool((one.observed == (one.holds > 0)).all())
        mirrored = given.mT & ~given
        assert len(own.score) == A * n * (n - 1) - int((given | mirrored).sum())
        assert own.truth.sum() == int((truth & ~given & ~mirrored).sum())


def test_a_relation_in_both_spellings_is_one_triple():
    """left(a, b) and right(b, a): not given in one spelling and asked in the other."""
    objects = tuple(AnnotatedObject(id=k, label=label) for k, label in enumerate(("bed", "lamp")))
    twice = AnnotatedScene("s", "toy", "g", None, objects, ((0, "left", 1), (1, "right", 0)))
    vocabulary = Vocabulary([ObjectClass("bed"), ObjectClass("lamp")])
    data = tensors(encode([twice], vocabulary), len(vocabulary))
    assert r_precision(complete_scenes(data, torch.zeros(2, dtype=torch.bool), flat), 1) is None


def test_classes_related_both_ways_are_stated_of_different_instances():
    """Two lamps on either side of a bed: left(lamp, bed) and left(bed, lamp) hold of classes."""
    artifact = larger_artifact("triway-implications")
    classes, known = [0, 1, 1], artifact.spec.A
    both = scene(classes, [(0, 0, 1), (0, 1, 0)], relations=known)
    data = tensors([both, scene(classes, [(0, 0, 1)], relations=known)], artifact.spec.V)
    batch = data.batch(torch.arange(2))
    question = with_observed(batch, batch.holds > 0)
    values = score_relations(artifact, question, given=True)
    blind = score_relations(artifact, question, given=False)
    assert torch.isfinite(values).all()
    assert not torch.allclose(values[0], values[1])
    torch.testing.assert_close(blind[0], blind[1])


def test_one_triple_is_replaced_by_a_false_one():
    """All others stay; what replaces it shares two of relation, subject, object with it."""
    spy = Spy()
    false_hits(DATA, WIDE_STRUCTURE, spy)
    kinds = set()
    for one, evidence in zip(spy.rows, related(2), strict=True):
        n = len(evidence.classes)
        stated = one.holds[0, :, :n, :n].numpy() > 0
        assert bool((one.observed == (one.holds > 0)).all())
        (gone,) = np.argwhere(evidence.holds & ~stated)
        ((a, i, j),) = np.argwhere(stated & ~evidence.holds)
        (other,) = np.flatnonzero(gone != (a, i, j))
        kinds.add(int(other))
        assert not evidence.holds[a, j, i]
        assert i != j
    assert kinds == {0, 1, 2}


def test_without_a_false_triple_there_is_no_case():
    rng = np.random.default_rng(0)
    holds, off = np.ones((1, 2, 2), np.bool_), ~np.eye(2, dtype=np.bool_)
    assert draw_false_triple(holds & off, np.broadcast_to(off, holds.shape), rng) is None
    one = np.zeros((1, 2, 2), np.bool_)
    one[0, 0, 1] = True
    assert draw_false_triple(one, np.broadcast_to(off, one.shape), rng) is None
    data = tensors([scene([0, 1], [(0, 0, 1)]), scene([0, 1], [(0, 0, 1), (1, 0, 1)])])
    hits = false_hits(data, NO_STRUCTURE, flat)
    assert (hits.numerators.tolist(), hits.skipped) == ([0, 1 / 2], 1)
    assert false_hits(tensors([scene([0, 1])]), NO_STRUCTURE, flat) is None
