"""Placements of missing objects, and their offsets in metres."""

import math
from collections import namedtuple
from dataclasses import replace
from importlib import import_module
from itertools import compress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import expit

from app.model import CountSlope, Offsets
from app.model.calibration import PlaceFit
from app.model.statistics import UNOBSERVED, offsets_of_missing, rotated
from app.questions.placements import Place, place_log_p
from app.questions.posterior import Posterior
from app.scene import RELATIONS, ObjectClass, Scene, SceneObject, Vocabulary
from app.scene.spatial_relations import ABOVE, CANONICAL, FRONT, INSIDE, LEFT, ON_TOP, canonicalise
from scene_client.frames import viewer_axes
from tests.questions.answers import missing, without_minimums
from tests.questions.artifacts import (
    LABELS,
    LARGER,
    STRUCTURE,
    larger_artifact,
    scene_of,
)

V = LARGER["triway"].V
A = len(CANONICAL)


def test_only_likely_places_and_strong_reasons_are_listed():
    """Places with 3/4 of the first place's probability, and reasons that change odds threefold."""
    scene = scene_of([0, 1, 2, 3], [(2, 1, 0)])
    further_places, reasons = [], []
    for name in ("rbm", "triway", "triway-states"):
        artifact = larger_artifact(name, scale=1.0)
        with without_minimums():
            every = missing(artifact, scene)
        for entry, complete in zip(missing(artifact, scene), every, strict=True):
            first, *others = complete.placements
            likely = [place.probability >= 0.75 * first.probability for place in others]
            strong = [abs(one.log_odds_change) >= math.log(3) for one in complete.because]
            assert entry == complete._replace(
                placements=(first, *compress(others, likely)),
                because=(*compress(complete.because, strong),),
            )
            further_places += likely
            reasons += strong
    assert {*further_places} == {*reasons} == {True, False}


def test_no_place_is_listed_below_one_in_twenty():
    scene, log_odds = scene_of([0, 1, 2]), math.log(0.05 / 0.95)
    for change, count in ((-0.01, 0), (0.01, 3)):
        slopes = (CountSlope(intercept=log_odds + change, slope=0.0),) * A
        artifact = larger_artifact("triway", placement=slopes)
        entries = missing(artifact, scene)
        assert {len(entry.placements) for entry in entries} == {count}
        entries = missing(artifact, scene, at=("left", 1))
        assert {entry.placements[0].object for entry in entries} == {1}
        assert {len(entry.placements) for entry in entries} == {max(count, 1)}


# On-top is likelier than all other relations.
SLOPES = tuple(CountSlope(intercept=4.0 if a == ON_TOP else -4.0) for a in range(A))
ARTIFACT = larger_artifact("triway", placement=SLOPES)


@pytest.mark.usefixtures("without_minimums")
def test_no_place_is_under_an_object_on_top_of_another():
    def under(*stated):
        entries = missing(ARTIFACT, scene_of([0, 1], list(stated)), top_k=9)
        places = [place for entry in entries for place in entry.placements]
        return {place.object for place in places if place.relation == "under"}

    assert 0 in under()
    assert 0 not in under((ON_TOP, 0, 1))
    assert 0 not in under((INSIDE, 0, 1))
    assert 1 in under((ON_TOP, 0, 1))


def offsets_of_every_pair(V: int = V) -> Offsets:
    """Random offsets, different for each pair of classes."""
    rng = np.random.default_rng(0)
    nothing = np.zeros((A, V, 6), np.float32)
    spread = rng.uniform(0.1, 0.6, (A * V * V, 3))
    return Offsets(
        relation=np.concatenate([rng.normal(size=(A, 3)), np.full((A, 3), 0.25)], 1).astype("f4"),
        relation_scenes=np.full(A, 9),
        subject=nothing,
        object=nothing,
        pair=np.arange(A * V * V),
        pair_offset=np.concatenate([rng.normal(size=(A * V * V, 3)), spread], 1).astype("f4"),
        pair_scenes=np.arange(1, A * V * V + 1),
    )


Offset = namedtuple("Offset", "mean std scenes")
OFFSETS = offsets_of_every_pair()
VIEWER = viewer_axes()


def offset_of(relation, missing, anchor, outgoing=True, axes=VIEWER, offsets=OFFSETS):
    ends = (np.array([value]) for value in (relation, missing, anchor, outgoing))
    mean, std, scenes = offsets_of_missing(offsets.tables, *ends, axes is not None)
    values = *rotated(mean, std, np.eye(3) if axes is None else np.array(axes)), scenes
    mean, std, scenes = (value[0].tolist() for value in values)
    return None if scenes == UNOBSERVED else Offset(tuple(mean), tuple(std), scenes)


@given(st.integers(0, A - 1), st.integers(0, V - 1), st.integers(0, V - 1))
def test_opposite_relations_have_negative_offsets(a, i, j):
    """left(i, j) and right(j, i) are the same fact."""
    to, back = offset_of(a, i, j), offset_of(a, j, i, outgoing=False)
    assert back == to._replace(mean=tuple(-x for x in to.mean))


@given(st.floats(-7, 7), st.booleans())
def test_the_offset_turns_with_the_viewer(yaw, optical):
    """Compared with turned samples from the offset of the standard viewer."""
    plain = offset_of(LEFT, 1, 2)
    frame = "camera_optical_frame" if optical else "map"
    offset = offset_of(LEFT, 1, 2, axes=viewer_axes(frame, yaw))
    c, s = math.cos(yaw), math.sin(yaw)
    turn = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    if optical:
        turn = np.array([[0, -1, 0], [0, 0, -1], [1, 0, 0]]) @ turn
    assert offset.mean == pytest.approx(turn @ plain.mean, abs=2e-3)
    samples = np.random.default_rng(1).normal(plain.mean, plain.std, (20_000, 3))
    # The standard error of a standard deviation is 0.5 %.
    assert offset.std == pytest.approx((samples @ turn.T).std(axis=0), rel=0.03)


def test_unknown_offsets():
    """Left and front without a viewer, and relations without poses in training."""
    assert offset_of(LEFT, 1, 2, axes=None) is None
    assert offset_of(FRONT, 1, 2, outgoing=False, axes=None) is None
    none = {"pair": np.zeros(0, np.int64), "pair_offset": np.zeros((0, 6), "f4")}
    counts = {"relation_scenes": np.array([1, 0, 9, 9, 9]), "pair_scenes": np.zeros(0, np.int64)}
    partial = replace(OFFSETS, **counts, **none)
    assert offset_of(FRONT, 1, 2, offsets=partial) is None
    assert offset_of(LEFT, 1, 2, offsets=partial).scenes == 0


@pytest.mark.parametrize("name", ["rbm", "triway-states", "triway"])
def test_placements_have_the_offsets_of_their_classes(name):
    artifact = larger_artifact(name)
    scene = Scene(
        tuple(
            SceneObject(str(k), "", index, position=(0.0, 0.0, 0.0))
            for k, index in enumerate((2, 0, 8, 2, 4))
        )
    )
    entries, bare = (missing(replace(artifact, offsets=some), scene) for some in (OFFSETS, None))
    for entry, other in zip(entries, bare, strict=True):
        assert entry.label == other.label
        index = artifact.vocabulary.index(entry.label)
        assert [place[:3] for place in entry.placements] == list(other.placements)
        for place in entry.placements:
            relation, subject, _ = canonicalise("missing", place.relation, "anchor")
            anchor = scene.objects[place.object].class_index
            assert place.offset == offset_of(relation, index, anchor, subject == "missing")


@pytest.mark.usefixtures("without_minimums")
def test_no_place_is_inside_an_object_that_is_too_small():
    sizes = {"sofa": (2.0, 0.9, 0.8), "vase": (0.1, 0.1, 0.3)}
    classes = [ObjectClass(label, size=sizes.get(label)) for label in LABELS[:V]]
    inside = tuple(CountSlope(intercept=9.0 if a == INSIDE else -9.0) for a in range(A))
    artifact = larger_artifact("triway-states", placement=inside)
    artifact = replace(artifact, vocabulary=Vocabulary(classes, ("bedroom", "office")), places=None)

    def first(candidate, anchor):
        (entry,) = missing(artifact, scene_of([anchor]), candidates=[candidate])
        return {place.relation: place.probability for place in entry.placements}

    sofa, vase, chair = 4, 5, 3
    # The relation of a pair without unit has a probability of 0.
    assert first(sofa, vase).get("inside", 0) < 1e-6
    assert first(vase, sofa).get("contains", 0) < 1e-6
    assert first(sofa, chair)["inside"] > 1e-3


@pytest.mark.usefixtures("without_minimums")
def test_a_smaller_anchor_holds_nothing_and_is_not_looked_for_below_or_in_a_thing():
    """A sofa is not on, in or under a vase, and no vase is on the sofa. It may be above a rug."""
    sizes = {"sofa": (2.0, 0.9, 0.8), "vase": (0.1, 0.1, 0.3), "bed": (2.1, 2.0, 0.6)}
    classes = [ObjectClass(label, size=sizes.get(label)) for label in LABELS[:V]]
    vocabulary = Vocabulary(classes, ("bedroom", "office"))
    sofa, vase, chair, bed = 4, 5, 3, 0
    for a, name in ((ON_TOP, "on-top"), (ON_TOP, "under"), (ABOVE, "above"), (ABOVE, "below"),
                    (INSIDE, "contains")):  # fmt: skip
        likely = tuple(CountSlope(intercept=9.0 if k == a else -9.0) for k in range(A))
        artifact = larger_artifact("triway-states", placement=likely)
        artifact = replace(artifact, vocabulary=vocabulary, places=None)

        def p(anchor, artifact=artifact, name=name):
            (entry,) = missing(artifact, scene_of([anchor]), candidates=[sofa])
            return {place.relation: place.probability for place in entry.placements}.get(name, 0)

        is_listed = [p(anchor) > 1e-3 for anchor in (vase, bed, chair)]
        # The size of the chair is unknown. A bed does not fit into a sofa.
        expected = {"above": [True, True, True], "contains": [False, False, True]}
        assert is_listed == expected.get(name, [False, True, True]), name


module = import_module("app.questions.missing")  # the package has a function of this name
NAMES = ["rbm", "triway", "triway-states"]
FITS = tuple(PlaceFit(relation=0.3 + 0.2 * a, counts=0.1 * a, intercept=0.5 - a) for a in range(5))
STATED = [(2, 1, 0), (0, 0, 3)]


def by_hand(artifact, scene, name, anchor, coverage):
    """Dictionaries from the label of every unlisted class to its probability and to its place's."""
    relation, subject, _ = canonicalise("missing", name, "anchor")
    fit, is_subject = artifact.calibration.at[relation], subject == "missing"
    listed = {thing.label for thing in scene.objects}
    classes = [k for k, label in enumerate(LABELS) if label not in {*STRUCTURE, *listed}]
    posterior = Posterior(artifact, scene)
    z = posterior.absent_log_odds(np.array(classes), coverage)
    log_p = place_log_p(posterior, np.array(classes), Place(relation, anchor, is_subject))
    of_anchor = scene.objects[anchor].class_index
    ratio = artifact.places.log_ratio(relation, of_anchor, outgoing=is_subject)
    of_place = expit(fit.intercept + fit.relation * log_p + fit.counts * ratio[classes])
    labels = [LABELS[k] for k in classes]
    of_class = (expit(z) * of_place).tolist()
    return dict(zip(labels, of_class, strict=True)), dict(zip(labels, of_place, strict=True))


@pytest.mark.parametrize("machine", NAMES)
@pytest.mark.parametrize("name", RELATIONS)
@pytest.mark.parametrize(("block", "coverage"), [(32, 0.5), (2, 0.4)])
def test_all_classes_have_the_probability_of_the_formula(
    monkeypatch, machine, name, block, coverage
):
    """The product of the probabilities of class and place. The default coverage is 1/2."""
    monkeypatch.setattr(module, "_BLOCK", block)
    artifact, scene = larger_artifact(machine, at=FITS), scene_of([0, 1, 2, 3], STATED)
    expected, of_place = by_hand(artifact, scene, name, 2, coverage)
    options = {} if coverage == 0.5 else {"coverage": coverage}
    entries = missing(artifact, scene, at=(name, 2), top_k=9, **options)
    assert [entry.label for entry in entries] == sorted(
        expected, key=expected.__getitem__, reverse=True
    )
    for entry in entries:
        assert entry.probability == pytest.approx(expected[entry.label], rel=1e-4)
        assert entry.probability == pytest.approx(expit(entry.log_odds), rel=1e-4)
        assert entry.placements[0].probability == pytest.approx(of_place[entry.label], rel=1e-4)


def count_scored(monkeypatch):
    """Return a list that gets the classes whose relation is scored, in blocks of a single class."""
    scored = []

    def counted(posterior, candidates, place):
        scored.extend(candidates.tolist())
        return place_log_p(posterior, candidates, place)

    monkeypatch.setattr(module, "_BLOCK", 1)
    monkeypatch.setattr(module, "place_log_p", counted)
    return scored


@pytest.mark.parametrize("machine", NAMES)
@pytest.mark.parametrize("name", ["on-top", "under", "left", "contains"])
@pytest.mark.parametrize("top_k", [1, 2, 4])
def test_an_early_stop_leaves_the_likeliest_classes_as_they_are(monkeypatch, machine, name, top_k):
    """With blocks of a single class, the function scores as few classes as possible."""
    artifact, scene = larger_artifact(machine, at=FITS), scene_of([0, 2], None)
    every = missing(artifact, scene, at=(name, 1), top_k=9, details=False)
    scored = count_scored(monkeypatch)
    some = missing(artifact, scene, at=(name, 1), top_k=top_k, details=False)
    assert [entry.label for entry in some] == [entry.label for entry in every[:top_k]]
    for entry, other in zip(some, every, strict=False):
        assert entry[1:] == pytest.approx(other[1:], rel=1e-5)
    assert top_k <= len(scored) == len(set(scored)) <= len(every)
