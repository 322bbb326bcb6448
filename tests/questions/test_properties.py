"""What holds of every answer of every machine, whatever its weights."""

from __future__ import annotations

import math

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.scene import CANONICAL, OPPOSITES, RELATIONS, Scene, canonicalise, contradiction
from tests.questions.answers import misplaced, missing, outliers, relations
from tests.questions.artifacts import LABELS, LARGER, STRUCTURE, larger_artifact, scene_of

pytestmark = pytest.mark.usefixtures("the_likeliest_is_expected")

NAMES = tuple(LARGER)
ARTIFACTS = {name: larger_artifact(name) for name in NAMES}


@st.composite
def scenes(draw, minimum=1):
    """Up to seven objects, classes repeated or not, with a few consistent relations."""
    classes = draw(st.lists(st.integers(0, len(LABELS) - 1), min_size=minimum, max_size=7))
    n = len(classes)
    stated = []
    if n > 1 and draw(st.booleans()):
        ends = st.tuples(st.integers(0, 3), st.integers(0, n - 1), st.integers(0, n - 1))
        for triple in draw(st.lists(ends, max_size=4, unique=True)):
            if triple[1] != triple[2] and not contradiction([*stated, triple]):
                stated.append(triple)
    complete = bool(stated) and draw(st.booleans())
    return scene_of(classes, stated or None, complete=complete)


names = st.sampled_from(NAMES)
few = settings(max_examples=60)


def permuted(scene, order):
    """The same scene with its objects in another order: place k holds what was at order[k]."""
    place = {old: new for new, old in enumerate(order)}
    objects = tuple(scene.objects[k] for k in order)
    stated = scene.relations and tuple((a, place[i], place[j]) for a, i, j in scene.relations)
    return Scene(objects, stated, scene.relations_complete, scene.room_type)


@few
@given(names, scenes())
def test_missing(name, scene):
    """All unlisted things, best first; of each at most three placements, best first, never at
    structure, each relation and anchor once; and the strongest three reasons, one object for its
    class."""
    answers = missing(ARTIFACTS[name], scene, top_k=len(LABELS))
    first = {thing.label: k for k, thing in reversed(list(enumerate(scene.objects)))}
    assert {answer.label for answer in answers} == set(LABELS) - first.keys() - STRUCTURE
    assert all(0 <= answer.probability <= 1 for answer in answers)
    assert is_descending(answer.probability for answer in answers)
    for answer in answers:
        places = answer.placements
        assert len(places) == (3 if first.keys() - STRUCTURE else 0)
        assert is_descending(place.probability for place in places)
        assert len({(place.relation, place.object) for place in places}) == len(places)
        assert not {scene.objects[place.object].label for place in places} & STRUCTURE
        objects = [because.object for because in answer.because]
        assert len(objects) == len(set(objects)) == min(3, len(first))
        assert set(objects) <= set(first.values())
        assert is_descending(abs(because.log_odds_change) for because in answer.because)
        assert all(math.isfinite(because.log_odds_change) for because in answer.because)


def is_descending(values):
    values = list(values)
    return values == sorted(values, reverse=True)


@few
@given(names, scenes(), st.sets(st.integers(0, 8), min_size=1), st.integers(1, 9))
def test_candidates_and_top_k_choose_but_do_not_rescale(name, scene, candidates, top_k):
    artifact = ARTIFACTS[name]
    everything = {a.label: a for a in missing(artifact, scene, top_k=len(LABELS))}
    some = missing(artifact, scene, top_k=top_k, candidates=sorted(candidates))
    allowed = [label for label in everything if LABELS.index(label) in candidates]
    assert [answer.label for answer in some] == allowed[:top_k]
    for answer in some:
        assert answer.probability == everything[answer.label].probability
        assert answer.log_odds == everything[answer.label].log_odds


@few
@given(st.sampled_from([name for name in NAMES if LARGER[name].form == "local"]), scenes())
def test_a_reason_is_the_difference_to_the_scene_without_it(name, scene):
    """Where no relation is given: asked of the smaller scene, whatever else is in it."""
    artifact = ARTIFACTS[name]
    bare = Scene(scene.objects)
    without = {}
    for answer in missing(artifact, bare):
        for object_, change in answer.because:
            label = scene.objects[object_].label
            if label not in without:
                rest = tuple(thing for thing in scene.objects if thing.label != label)
                answers = missing(artifact, Scene(rest), top_k=len(LABELS))
                without[label] = {a.label: a.log_odds for a in answers}
            expected = answer.log_odds - without[label][answer.label]
            assert change == pytest.approx(expected, abs=2e-5, rel=1e-4)


@few
@given(names, scenes(minimum=2))
def test_relations(name, scene):
    """Exclusive pairs, no structure, no object to itself, best first with ties by position."""
    answers, _ = relations(ARTIFACTS[name], scene, top_k=4096)
    things = [k for k, t in enumerate(scene.objects) if t.label not in STRUCTURE]
    assert len(answers) == 4 * len(things) * (len(things) - 1)
    p = {(a.subject, a.relation, a.object): a.probability for a in answers}
    assert len(p) == len(answers)
    for (subject, relation, object_), value in p.items():
        assert subject != object_
        assert subject in things
        assert object_ in things
        assert 0 <= value + p[object_, relation, subject] <= 1 + 1e-6
    keys = [(-a.probability, a.subject, a.object, CANONICAL.index(a.relation)) for a in answers]
    assert keys == sorted(keys)


@few
@given(names, scenes(minimum=2), st.floats(0, 1), st.integers(1, 30))
def test_both_answers_are_cut_by_top_k_and_probability(name, scene, least, top_k):
    everything = relations(ARTIFACTS[name], scene, top_k=4096)
    some = relations(ARTIFACTS[name], scene, top_k=top_k, min_probability=least)
    for cut, whole in zip(some, everything, strict=True):
        assert cut == tuple(a for a in whole if a.probability >= least)[:top_k]


@few
@given(names, scenes(minimum=2))
def test_disagreements(name, scene):
    """A pair once, as it was stated, where something else is likelier than all that was stated of
    any two instances of these classes; largest ratio first."""
    _, found = relations(ARTIFACTS[name], scene, top_k=4096)
    stated = {(CANONICAL[a], x, y) for a, x, y in scene.relations or ()}
    stated |= {(OPPOSITES[a], y, x) for a, x, y in stated}
    of_classes = {(a, scene.objects[x].label, scene.objects[y].label) for a, x, y in stated}
    for d in found:
        subject, object_ = (scene.objects[k].label for k in (d.subject, d.object))
        assert set(d.observed) == {a for a, x, y in stated if (x, y) == (d.subject, d.object)}
        assert len(set(d.observed)) == len(d.observed) > 0
        # Some relation that was stated leads this way.
        assert d.observed[0] in CANONICAL
        assert (d.expected, subject, object_) not in of_classes
        assert 1 >= d.probability > d.observed_probability > 0
        assert not {subject, object_} & STRUCTURE
    assert len({frozenset((d.subject, d.object)) for d in found}) == len(found)
    assert is_descending(d.probability / d.observed_probability for d in found)


def test_disagreements_of_chosen_pairs_either_way_round():
    """Of structure too, where it is asked for."""
    artifact = ARTIFACTS["triway-wide"]
    pairs = [(x, y) for x in range(6) for y in range(x)]
    scene = scene_of([0, 1, 2, 3, 4, 8], [(k % 4, x, y) for k, (x, y) in enumerate(pairs)])
    everything = relations(artifact, scene, pairs=pairs, top_k=4096)[1]
    turned = [(y, x) for x, y in pairs]
    assert relations(artifact, scene, pairs=turned, top_k=4096)[1] == everything
    assert len(everything) > 3

    def assert_same(found, expected):
        # Sums in float32, in an order that depends on how many pairs are asked about.
        assert found.probability == pytest.approx(expected.probability, rel=1e-5)
        assert found.observed_probability == pytest.approx(expected.observed_probability, rel=1e-5)
        same = {"probability": 0.0, "observed_probability": 0.0}
        assert found._replace(**same) == expected._replace(**same)

    for d in everything:
        (alone,) = relations(artifact, scene, pairs=[(d.object, d.subject)], top_k=4096)[1]
        assert_same(alone, d)
    things = [d for d in everything if 5 not in (d.subject, d.object)]
    assert len(things) < len(everything)
    for found, expected in zip(relations(artifact, scene, top_k=4096)[1], things, strict=True):
        assert_same(found, expected)


def test_a_relation_of_one_instance_explains_the_others():
    """Two chairs stand otherwise than expected; but one may, where the other stands so."""
    artifact, seen = ARTIFACTS["triway-wide"], 0
    for name in RELATIONS:
        chairs = [canonicalise(0, name, chair) for chair in (1, 2)]
        _, both = relations(artifact, scene_of([0, 3, 3], chairs))
        if both:
            assert [d.expected for d in both] == [both[0].expected] * 2
            subject, object_ = (0, 2) if both[0].subject == 0 else (2, 0)
            as_expected = canonicalise(subject, both[0].expected, object_)
            assert not relations(artifact, scene_of([0, 3, 3], [chairs[0], as_expected]))[1]
            seen += 1
    assert seen > 3


@few
@given(names, scenes(minimum=2))
def test_opposites_say_the_same(name, scene):
    plain, _ = relations(ARTIFACTS[name], scene, top_k=4096)
    both, _ = relations(ARTIFACTS[name], scene, top_k=4096, include_opposites=True)
    expected = {(a.subject, a.relation, a.object, a.probability) for a in plain}
    expected |= {(a.object, OPPOSITES[a.relation], a.subject, a.probability) for a in plain}
    assert {(a.subject, a.relation, a.object, a.probability) for a in both} == expected
    assert len(both) == len(expected)


@few
@given(names, scenes(minimum=2), st.data(), st.booleans())
def test_pairs_choose_ordered_pairs(name, scene, data, opposites):
    """All relations of the subject to the object, structure included, and no other pair."""
    n = len(scene.objects)
    place = st.integers(0, n - 1)
    pair = st.tuples(place, place).filter(lambda p: p[0] != p[1])
    pairs = data.draw(st.lists(pair, min_size=1, max_size=3))
    answers, _ = relations(
        ARTIFACTS[name], scene, top_k=4096, pairs=pairs, include_opposites=opposites
    )
    spelled = [*CANONICAL, *(OPPOSITES[a] for a in CANONICAL)] if opposites else CANONICAL
    expected = {(x, a, y) for x, y in pairs for a in spelled}
    assert {(a.subject, a.relation, a.object) for a in answers} == expected
    assert len(answers) == len(expected)


@few
@given(names, scenes())
def test_outliers(name, scene):
    """Every object once, least fitting first; instances of one class alike."""
    _, found, unlikely = outliers(ARTIFACTS[name], scene)
    assert misplaced(ARTIFACTS[name], scene) == unlikely
    assert sorted(answer.object for answer in found) == list(range(len(scene.objects)))
    structure = ARTIFACTS[name].vocabulary.structure
    wall = [bool(structure[scene.objects[answer.object].class_index]) for answer in found]
    assert wall == sorted(wall), "structure comes last"
    keys = [
        (answer.log_odds, answer.object)
        for answer, last in zip(found, wall, strict=True)
        if not last
    ]
    assert keys == sorted(keys)
    by_class: dict[str, set] = {}
    for answer in found:
        assert answer.label == scene.objects[answer.object].label
        assert math.isfinite(answer.log_odds)
        by_class.setdefault(answer.label, set()).add((answer.log_odds, answer.because))
        assert len(answer.because) <= min(3, len({t.label for t in scene.objects}) - 1)
        changes = [because.log_odds_change for because in answer.because]
        assert all((change < 0) == answer.is_outlier for change in changes)
        assert changes == sorted(changes, key=abs, reverse=True)
        assert answer.is_outlier or answer.usually_with == ()
        assert len(answer.usually_with) <= 3
        assert not set(answer.usually_with) & {t.label for t in scene.objects}
        others = [scene.objects[because.object].label for because in answer.because]
        assert answer.label not in others
        assert len(set(others)) == len(others)
    assert all(len(values) == 1 for values in by_class.values())
    assert len(unlikely) == len(scene.relations or ())
    stated = {(CANONICAL[a], i, j) for a, i, j in scene.relations or ()}
    assert {(a.relation, a.subject, a.object) for a in unlikely} == stated
    assert is_descending(answer.probability for answer in unlikely)


@few
@given(names, scenes(), st.floats(0, 1))
def test_the_threshold_decides(name, scene, threshold):
    found = outliers(ARTIFACTS[name], scene, threshold=threshold)
    assert found.threshold == threshold
    for answer in found.outliers:
        assert answer.is_outlier == (answer.probability >= threshold)


@few
@given(names, scenes(minimum=2), st.randoms(use_true_random=False))
def test_the_order_of_the_objects_does_not_matter(name, scene, random):
    artifact = ARTIFACTS[name]
    order = list(range(len(scene.objects)))
    random.shuffle(order)
    other = permuted(scene, order)
    assert {
        (a.subject, a.relation, a.object, a.probability)
        for a in relations(artifact, scene, top_k=4096)[0]
    } == {
        (order[a.subject], a.relation, order[a.object], a.probability)
        for a in relations(artifact, other, top_k=4096)[0]
    }
    assert {
        (d.subject, d.object, d.expected, d.probability)
        for d in relations(artifact, scene, top_k=4096)[1]
    } == {
        (order[d.subject], order[d.object], d.expected, d.probability)
        for d in relations(artifact, other, top_k=4096)[1]
    }
    assert [(a.label, a.probability) for a in missing(artifact, scene)] == [
        (a.label, a.probability) for a in missing(artifact, other)
    ]
    _, found, misplaced = outliers(artifact, scene)
    _, found2, misplaced2 = outliers(artifact, other)
    assert {(a.object, a.log_odds) for a in found} == {
        (order[a.object], a.log_odds) for a in found2
    }
    assert {(a.subject, a.relation, a.object, a.probability) for a in misplaced} == {
        (order[a.subject], a.relation, order[a.object], a.probability) for a in misplaced2
    }


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_scene(name):
    empty = scene_of([])
    assert relations(ARTIFACTS[name], empty) == ((), ())
    assert outliers(ARTIFACTS[name], empty) == (1.0, (), ())
    answers = missing(ARTIFACTS[name], empty, top_k=len(LABELS))
    assert len(answers) == len(LABELS) - len(STRUCTURE)
    assert all(answer.placements == () for answer in answers)


@pytest.mark.parametrize("name", NAMES)
def test_a_doubtful_object_weighs_less(name):
    """Confidence 1 is presence; towards 0 the answers become those of a scene without it."""
    artifact = ARTIFACTS[name]
    sure = scene_of([0, 1])
    doubtful = [
        Scene((sure.objects[0], type(sure.objects[1])("lamp_1", "lamp", 1, confidence)))
        for confidence in (1.0, 1e-6)
    ]
    absent = list(range(2, 8))
    log_odds = [
        {a.label: a.log_odds for a in missing(artifact, s, candidates=absent)}
        for s in (sure, *doubtful, scene_of([0]))
    ]
    assert log_odds[0] == log_odds[1]
    assert log_odds[2] == pytest.approx(log_odds[3], abs=1e-4)
    assert log_odds[0] != pytest.approx(log_odds[3], abs=1e-2)


@pytest.mark.parametrize(
    ("question", "options", "message"),
    [
        (relations, {"top_k": 0}, "top_k"),
        (relations, {"min_probability": 1.5}, "min_probability"),
        (relations, {"min_probability": math.nan}, "min_probability"),
        (relations, {"pairs": [(0, 0)]}, "pair"),
        (relations, {"pairs": [(0, 2)]}, "pair"),
        (relations, {"pairs": [(-1, 0)]}, "pair"),
        (missing, {"top_k": 0}, "top_k"),
        (missing, {"coverage": -0.1}, "coverage"),
        (missing, {"coverage": 1.1}, "coverage"),
        (missing, {"coverage": math.nan}, "coverage"),
        (missing, {"candidates": [9]}, "candidate 9"),
        (missing, {"candidates": [-1]}, "candidate -1"),
        (missing, {"at": ("left", 2)}, "anchor 2"),
        (missing, {"at": ("near", 0)}, "near"),
        (outliers, {"threshold": -0.1}, "threshold"),
        (outliers, {"threshold": math.nan}, "threshold"),
    ],
)
def test_bad_input_is_refused(question, options, message):
    with pytest.raises(ValueError, match=message):
        question(ARTIFACTS["triway-local"], scene_of([0, 1]), **options)


@pytest.mark.parametrize("question", [relations, missing, outliers])
def test_classes_and_rooms_must_be_the_machine_s(question):
    scene = scene_of([0, 1])
    unknown = type(scene.objects[0])("x", "x", None)
    beyond = type(scene.objects[0])("x", "x", 9)
    for bad in (unknown, beyond):
        with pytest.raises(ValueError, match="class_index"):
            question(ARTIFACTS["triway-local"], Scene((scene.objects[0], bad)))
    with pytest.raises(ValueError, match="room_type"):
        question(ARTIFACTS["triway-local"], Scene(scene.objects, room_type=2))


@few
@given(names, scenes(minimum=2))
def test_details_change_nothing_else(name, scene):
    artifact = ARTIFACTS[name]
    bare = missing(artifact, scene, details=False)
    assert bare == tuple(
        answer._replace(placements=(), because=()) for answer in missing(artifact, scene)
    )
    _, judged, stated = outliers(artifact, scene, details=False)
    _, explained, again = outliers(artifact, scene)
    assert judged == tuple(answer._replace(because=(), usually_with=()) for answer in explained)
    assert stated == again
