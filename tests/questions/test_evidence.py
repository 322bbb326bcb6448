"""What is observed in the answer to relations: probabilities of evidence, and exclusions."""

from dataclasses import replace

import numpy as np
import pytest

from app import questions
from app.scene import RelationTable, Scene, SceneObject, observe
from app.scene.spatial_relations import ABOVE, CANONICAL, INSIDE, LEFT, ON_TOP
from tests.questions.answers import relations
from tests.questions.artifacts import (
    LABELS,
    LARGER,
    artifact_of,
    larger_artifact,
    random_machine,
    scene_of,
)

ARTIFACT = larger_artifact("triway-states", scale=1.5)
A = len(CANONICAL)
SIZE = (0.5, 0.5, 0.5)


def boxes(*bottoms, stated=None):
    """Boxes of 50 cm, of a class each."""
    centres = [(x, y, z + 0.25) for x, y, z in bottoms]
    objects = tuple(
        SceneObject(LABELS[k], LABELS[k], k, 1.0, p, SIZE) for k, p in enumerate(centres)
    )
    return Scene(objects, None if stated is None else RelationTable.stated(stated))


def entries(scene, **options):
    """A dictionary from (relation, subject, object) to the entry."""
    answer = relations(ARTIFACT, scene, top_k=4096, **options)
    return {(entry.relation, entry.subject, entry.object): entry for entry in answer}


def test_an_observed_relation_has_the_confidence_of_its_objects():
    """`expected` is the probability without the observation. Machines have no implications."""
    pairs = zip(scene_of([0, 1, 2]).objects, (0.9, 0.5, 1.0), strict=True)
    objects = tuple(replace(thing, confidence=c) for thing, c in pairs)
    plain = entries(Scene(objects))
    answer = entries(Scene(objects, RelationTable.stated([(ON_TOP, 1, 2), (LEFT, 0, 1)])))
    assert answer["on-top", 1, 2].probability == pytest.approx(0.5)
    assert answer["left", 0, 1].probability == pytest.approx(0.45)
    for key, entry in answer.items():
        if key in {("on-top", 1, 2), ("left", 0, 1)}:
            assert entry.observed
            assert entry.expected == pytest.approx(plain[key].probability, rel=1e-5)
        else:
            assert not entry.observed
            assert "expected" not in entry._fields


def test_stacked_objects_do_not_stand_beside_each_other():
    """A stacked relation excludes the pair's other relations, and left excludes stacked ones."""
    plain = entries(scene_of([0, 1, 2]))
    on_top, left = (entries(scene_of([0, 1, 2], [(a, 1, 0)])) for a in (ON_TOP, LEFT))
    stacked = {CANONICAL[a] for a in (ON_TOP, ABOVE, INSIDE)}
    excluded = 0
    for name in CANONICAL:
        for i, j in ((0, 1), (1, 0)):
            excluded += plain[name, i, j].probability > 0.02
            if (name, i, j) != ("on-top", 1, 0):
                assert on_top[name, i, j].probability <= 0.0100001
            if name in stacked:
                assert left[name, i, j].probability <= 0.0100001
    assert excluded > 4


def test_an_object_is_on_or_in_one_object_only():
    plain, answer = entries(scene_of([0, 1, 2])), entries(scene_of([0, 1, 2], [(INSIDE, 1, 0)]))
    assert max(plain[name, 1, 2].probability for name in ("on-top", "inside")) > 0.02
    assert max(answer[name, 1, 2].probability for name in ("on-top", "inside")) <= 0.0100001
    assert answer["on-top", 2, 1] == plain["on-top", 2, 1]


def test_a_complete_list_excludes_all_other_relations():
    answer = entries(scene_of([0, 1, 2], [(ON_TOP, 1, 2)], complete=True))
    assert answer.pop(("on-top", 1, 2)).probability == 1
    assert max(entry.probability for entry in answer.values()) == pytest.approx(0.01)


@pytest.mark.parametrize("stated", [None, ((ABOVE, 2, 3),)])
def test_boxes_exclude_stacked_relations_in_both_directions(stated):
    """The first two boxes are 2 m apart. Stated relations replace those of the poses only.

    The lift of box 3 over box 2 is 20 cm, so it may also touch it.
    """
    bottoms = [(0, 0, 0), (2.5, 0, 0), (9, 0, 0), (9, 0, 0.7)]
    scene = observe(boxes(*bottoms, stated=stated))
    plain, answer = entries(scene_of([0, 1, 2, 3])), entries(scene)
    excluded = 0
    for a in (ON_TOP, ABOVE, INSIDE):
        for i, j in ((0, 1), (1, 0)):
            key = CANONICAL[a], i, j
            assert answer[key].probability <= 0.0100001
            assert not answer[key].observed
            excluded += plain[key].probability > 0.02
    assert excluded > 2
    # Box 3 is above box 2, as the poses show.
    assert answer["above", 3, 2].observed == (stated is None)
    if stated is None:
        assert 0.5 < answer["above", 3, 2].probability < 1
        evidence = scene.relations
        for name in ("on-top", "above"):
            row = (evidence.relation == CANONICAL.index(name)) & (evidence.subject == 3)
            (p,) = evidence.probability[row & (evidence.object == 2)].tolist()
            assert answer[name, 3, 2].probability == pytest.approx(p, rel=1e-5)
    else:
        # A stated relation counts more than the boxes.
        assert answer["above", 2, 3].observed
        assert answer["above", 2, 3].probability == 1
        assert answer["above", 3, 2].probability <= 0.0100001


@pytest.mark.parametrize("said", [2.0, 1.0])
def test_lists_say_under_where_people_do(said):
    """Two scenes say that the lamp (1) is under the desk (2), or a single one, a possible error."""
    words = {
        "role_pair": np.array([1 * ARTIFACT.spec.V + 2], np.int32),
        "role_counts": np.array([(0, said, 0)], np.float32),
    }
    artifact = replace(ARTIFACT, places=replace(ARTIFACT.places, **words))
    scene = scene_of([1, 2, 3], [(ON_TOP, 1, 0)])

    def stated(**options):
        found = relations(artifact, scene, top_k=4096, **options)
        return {(e.subject, e.relation, e.object): e.probability for e in found if e.observed}

    assert stated() == {((0, "under", 1) if said > 1 else (1, "on-top", 0)): 1}
    # A caller who names the pairs, or wants both directions, gets them as they are.
    assert stated(pairs=[(1, 0)]) == {(1, "on-top", 0): 1}
    both = stated(include_opposites=True)
    assert both == {(1, "on-top", 0): 1, (0, "under", 1): 1}


def test_a_model_without_relations_states_the_observed_ones_only():
    spec = replace(LARGER["rbm"], T=0)
    artifact = artifact_of(random_machine(spec, 0.7))
    for stated, expected in ((None, []), ([(2, 1, 0)], [("on-top", True)])):
        answer = questions.relations(artifact, scene_of([2, 1, 3], stated))
        found = [(entry["relation"], entry["observed"]) for entry in answer["relations"]]
        assert found == expected
        assert all("expected" not in entry for entry in answer["relations"])
        assert answer["disagreements"] == []
        (warning,) = answer["warnings"]
        assert warning.code == "not-judged"
    assert questions.relations(larger_artifact("rbm"), scene_of([2, 1]))["warnings"] == []
