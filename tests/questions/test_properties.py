"""Properties of every answer of every machine, for any weights."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.questions.answer import significant
from app.scene import CANONICAL, OPPOSITES, RELATIONS, Scene
from app.scene.spatial_relations import LATERAL
from tests.questions.answers import disagreements, misplaced, missing, outliers, relations
from tests.questions.artifacts import LABELS, LARGER, STRUCTURE, larger_artifact, scene_of

pytestmark = pytest.mark.usefixtures("without_minimums")

NAMES = tuple(LARGER)
ARTIFACTS = {name: larger_artifact(name) for name in NAMES}
ALL = 4096
"""A `top_k` above the number of entries."""


@st.composite
def scenes(draw, minimum=1):
    """Up to seven objects, also several of a class, with a few consistent relations."""
    classes = draw(st.lists(st.integers(0, len(LABELS) - 1), min_size=minimum, max_size=7))
    n = len(classes)
    stated = []
    if n > 1 and draw(st.booleans()):
        ends = st.tuples(st.integers(0, 4), st.integers(0, n - 1), st.integers(0, n - 1))
        for a, i, j in draw(st.lists(ends, max_size=4, unique=True)):
            if i != j and (a, j, i) not in stated:
                stated.append((a, i, j))
    complete = bool(stated) and draw(st.booleans())
    return scene_of(classes, stated or None, complete=complete)


artifacts = st.sampled_from(NAMES).map(ARTIFACTS.__getitem__)
few = settings(max_examples=60)


def is_descending(values):
    values = list(values)
    return values == sorted(values, reverse=True)


def triples_of(entries):
    return {(entry.subject, entry.relation, entry.object) for entry in entries}


@few
@given(artifacts, scenes(), st.none() | st.floats(0, 1))
def test_missing(artifact, scene, coverage):
    entries = missing(artifact, scene, top_k=len(LABELS), coverage=coverage)
    first = {thing.label: k for k, thing in reversed(list(enumerate(scene.objects)))}
    assert {entry.label for entry in entries} == set(LABELS) - first.keys() - STRUCTURE
    assert all(0 <= entry.probability <= 1 for entry in entries)
    assert is_descending(entry.probability for entry in entries)
    for entry in entries:
        places = entry.placements
        assert len(places) == (3 if first.keys() - STRUCTURE else 0)
        assert is_descending(place.probability for place in places)
        assert len({(place.relation, place.object) for place in places}) == len(places)
        assert not {scene.objects[place.object].label for place in places} & STRUCTURE
        reasons = {reason.object: reason.log_odds_change for reason in entry.because}
        assert len(reasons) == len(entry.because) == min(3, len(first.keys() - STRUCTURE))
        assert set(reasons) <= {first[label] for label in first.keys() - STRUCTURE}
        assert is_descending(map(abs, reasons.values()))
        assert all(math.isfinite(change) and change for change in reasons.values())


@few
@given(artifacts, scenes(), st.sets(st.integers(0, 8), min_size=1), st.integers(1, 9))
def test_candidates_and_top_k_select_entries_without_changing_them(
    artifact, scene, candidates, top_k
):
    every = missing(artifact, scene, top_k=len(LABELS))
    some = missing(artifact, scene, top_k=top_k, candidates=sorted(candidates))
    chosen = [entry for entry in every if LABELS.index(entry.label) in candidates][:top_k]
    assert [entry[:3] for entry in some] == [entry[:3] for entry in chosen]


@few
@given(artifacts, scenes(minimum=2))
def test_relations(artifact, scene):
    entries = relations(artifact, scene, top_k=ALL)
    objects = [k for k, thing in enumerate(scene.objects) if thing.label not in STRUCTURE]
    p = {(e.subject, CANONICAL.index(e.relation), e.object): e.probability for e in entries}
    assert len(p) == len(entries) == 5 * len(objects) * (len(objects) - 1)
    for (subject, relation, object_), value in p.items():
        assert subject != object_
        assert {subject, object_} <= {*objects}
        assert 0 <= value + p[object_, relation, subject] <= 1 + 1e-5
    # Entries of equal probability are ordered by subject, object and relation.
    keys = [(-value, i, j, a) for (i, a, j), value in p.items()]
    assert keys == sorted(keys)


@few
@given(artifacts, scenes(minimum=2), st.floats(0, 1), st.integers(1, 30))
def test_top_k_and_the_least_probability_cut_both_lists(artifact, scene, least, top_k):
    for question in (relations, disagreements):
        every = question(artifact, scene, top_k=ALL)
        some = question(artifact, scene, top_k=top_k, min_probability=least)
        assert some == tuple(entry for entry in every if entry.probability >= least)[:top_k]


def test_disagreements_of_selected_pairs_in_either_direction():
    """Pairs may contain structure."""
    artifact = ARTIFACTS["triway-states"]
    pairs = [(x, y) for x in range(6) for y in range(x)]
    scene = scene_of([0, 1, 2, 3, 4, 8], [(k % 4, x, y) for k, (x, y) in enumerate(pairs)])
    every = disagreements(artifact, scene, pairs=pairs, top_k=ALL)
    reverse = [(y, x) for x, y in pairs]
    assert disagreements(artifact, scene, pairs=reverse, top_k=ALL) == every
    assert any(5 in (d.subject, d.object) for d in every)


@few
@given(artifacts, scenes(minimum=2))
def test_opposites_have_the_same_probability_and_evidence(artifact, scene):
    plain = relations(artifact, scene, top_k=ALL)
    both = relations(artifact, scene, top_k=ALL, include_opposites=True)
    expected = {(*e,) for e in plain}
    expected |= {(e.object, OPPOSITES[e.relation], e.subject, *e[3:]) for e in plain}
    assert {(*entry,) for entry in both} == expected
    assert len(both) == len(expected)


@few
@given(artifacts, scenes(minimum=2), st.data(), st.booleans())
def test_pairs_select_ordered_pairs(artifact, scene, data, opposites):
    index = st.integers(0, len(scene.objects) - 1)
    pair = st.tuples(index, index).filter(lambda pair: pair[0] != pair[1])
    pairs = data.draw(st.lists(pair, min_size=1, max_size=3))
    entries = relations(artifact, scene, top_k=ALL, pairs=pairs, include_opposites=opposites)
    names = RELATIONS if opposites else CANONICAL
    expected = {(x, name, y) for x, y in pairs for name in names}
    assert triples_of(entries) == expected
    assert len(entries) == len(expected)


@few
@given(artifacts, scenes(), st.none() | st.floats(0, 1))
def test_outliers(artifact, scene, threshold):
    """Each object once, the least fitting first. The instances of a class have equal entries."""
    answer = outliers(artifact, scene, threshold=threshold)
    assert misplaced(artifact, scene) == answer.misplaced
    # The service compares probabilities and thresholds before it rounds them.
    least = 1.0 if threshold is None else threshold
    assert answer.threshold == pytest.approx(least, rel=1e-5)
    assert sorted(entry.object for entry in answer.outliers) == list(range(len(scene.objects)))
    is_structure = [entry.label in STRUCTURE for entry in answer.outliers]
    assert is_structure == sorted(is_structure), "structure comes last"
    scores = [(-e.log_odds, e.object) for e in answer.outliers if e.label not in STRUCTURE]
    assert scores == sorted(scores)
    labels = {thing.label for thing in scene.objects}
    assert len({entry[1:] for entry in answer.outliers}) == len(labels)
    for entry in answer.outliers:
        assert entry.label == scene.objects[entry.object].label
        assert (entry.log_odds is None) == (entry.label in STRUCTURE)
        assert (entry.probability == 0) == (entry.label in STRUCTURE)
        if entry.probability != pytest.approx(least, rel=1e-5):
            alone = len(labels - STRUCTURE) == 1
            assert entry.is_outlier == (entry.probability > least and not alone)
        changes = [reason.log_odds_change for reason in entry.because]
        assert all((change > 0) == entry.is_outlier for change in changes)
        assert is_descending(map(abs, changes))
        others = [scene.objects[reason.object].label for reason in entry.because]
        assert len(set(others)) == len(others) <= 3
        assert entry.label not in others
        assert entry.is_outlier or entry.usually_with == ()
        assert len(entry.usually_with) <= 3
        assert not set(entry.usually_with) & labels
    things = {k for k, thing in enumerate(scene.objects) if thing.label not in STRUCTURE}
    names = [thing.label for thing in scene.objects]
    stated = {
        (i, CANONICAL[a], j)
        for a, i, j in scene.triples
        # Stacks of one class are not judged.
        if {i, j} <= things and (a in LATERAL or names[i] != names[j])
    }
    assert triples_of(answer.misplaced) == stated
    ids = [thing.id for thing in scene.objects]
    assert all(entry.moved in (ids[entry.subject], ids[entry.object]) for entry in answer.misplaced)
    assert len(answer.misplaced) == len(stated)
    assert is_descending(entry.probability for entry in answer.misplaced)


@few
@given(artifacts, scenes(minimum=2), st.randoms(use_true_random=False))
def test_the_order_of_the_objects_does_not_matter(artifact, scene, random):
    order = list(range(len(scene.objects)))
    random.shuffle(order)
    new = {old: new for new, old in enumerate(order)}
    table, moved = scene.relations, np.array([new[k] for k in range(len(order))])
    if table is not None:
        table = replace(table, subject=moved[table.subject], object=moved[table.object])
    shuffled = Scene(tuple(scene.objects[k] for k in order), table, scene.room_type)

    def summaries(scene, order):
        answer = outliers(artifact, scene)
        entries = (*relations(artifact, scene, top_k=ALL), *answer.misplaced)
        different = disagreements(artifact, scene, top_k=ALL)
        return (
            {(order[e.subject], e.relation, order[e.object], e.probability) for e in entries},
            {(order[d.subject], order[d.object], d.expected, d.probability) for d in different},
            [(entry.label, entry.probability) for entry in missing(artifact, scene)],
            {(order[entry.object], entry.log_odds) for entry in answer.outliers},
        )

    assert summaries(scene, range(len(order))) == summaries(shuffled, order)


@pytest.mark.parametrize("name", NAMES)
def test_an_empty_scene(name):
    artifact, empty = ARTIFACTS[name], scene_of([])
    assert relations(artifact, empty) == disagreements(artifact, empty) == ()
    assert outliers(artifact, empty)._asdict() == {
        "warnings": (), "threshold": 1.0, "outliers": (), "misplaced": ()
    }  # fmt: skip
    entries = missing(artifact, empty, top_k=len(LABELS))
    assert len(entries) == len(LABELS) - len(STRUCTURE)
    assert all(entry.placements == entry.because == () for entry in entries)


@pytest.mark.parametrize("name", NAMES)
def test_a_doubtful_object_weighs_less(name):
    """Near confidence 0, the answers are those of a scene without the object."""
    bed, lamp = scene_of([0, 1]).objects
    doubtful = Scene((bed, replace(lamp, confidence=1e-6)))
    present, unlikely, absent = (
        {e.label: e.log_odds for e in missing(ARTIFACTS[name], scene, candidates=range(2, 8))}
        for scene in (scene_of([0, 1]), doubtful, scene_of([0]))
    )
    assert unlikely == pytest.approx(absent, abs=1e-4)
    assert present != pytest.approx(absent, abs=1e-2)


def test_numbers_have_six_significant_digits():
    """Also numbers without an exact power of ten."""
    numbers = [0.1 + 0.2, 123456.7, 999999.96, 1e300, -1e-300, 5e-324, 0.0]
    assert significant(np.array(numbers)) == [float(f"{x:.6g}") for x in numbers]
    rng = np.random.default_rng(0)
    numbers = rng.normal(size=4096) * 10.0 ** rng.integers(-12, 4, 4096)
    assert significant(numbers) == [float(f"{x:.6g}") for x in numbers]
