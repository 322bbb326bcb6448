"""The warning of scenes from several rooms: its gain by brute force, and the split."""

from dataclasses import replace
from itertools import combinations_with_replacement

import numpy as np
import pytest

from app.model.scene_model import RoomEvidence
from app.questions.several_rooms import MOST_ROOMS, gain, several_rooms
from tests.questions.artifacts import larger_artifact, scene_of


def by_force(r: np.ndarray) -> float:
    """The gain over 2 to `MOST_ROOMS` rooms of any types; r is (n, C)."""
    one, types = r.sum(0).max(), range(r.shape[1])
    sets = (s for K in range(2, MOST_ROOMS + 1) for s in combinations_with_replacement(types, K))
    return max(np.log(np.exp(r[:, list(s)]).mean(1)).sum() for s in sets) - one


def table(log: np.ndarray) -> RoomEvidence:
    """The evidence of classes without structure."""
    log = log.astype(np.float32)
    return RoomEvidence(log, np.exp(log), log.max(1), np.arange(len(log)))


@pytest.mark.parametrize("seed", range(8))
def test_the_gain_is_nearly_that_of_all_sets_of_types(seed):
    """The search is greedy from three starts, so it may miss better types."""
    rng = np.random.default_rng(seed)
    evidence = rng.normal(0, 2, (30, 7)).astype(np.float32)
    listed = np.sort(rng.permutation(30)[:12])
    value, types = gain(*table(evidence), np.append(rng.permutation(listed), listed[:3]), 0.0)
    best = by_force(evidence[listed].astype(float))
    assert 0.8 * best - 0.5 <= value <= best + 1e-3
    rows = evidence[listed][:, types].astype(float)
    own = np.log(np.exp(rows).mean(1)).sum() - evidence[listed].sum(0).max()
    assert value == pytest.approx(own, abs=1e-3)


def test_a_small_bound_ends_the_search():
    evidence = np.zeros((6, 4), np.float32)
    assert gain(*table(evidence), np.arange(6), 1.0)[0] == -np.inf


def test_few_classes_and_structure_have_no_gain():
    """The classes 6 and 7 are structure, and 8 is a word with the evidence of class 0."""
    evidence = table(np.random.default_rng(0).normal(0, 2, (8, 4)))
    evidence = evidence._replace(row=np.array([*range(6), -1, -1, 0]))
    for listed in ([0, 1, 2, 3, 4, 6, 7], [0, 1, 2, 3, 4, 8]):
        assert gain(*evidence, np.array(listed), -np.inf)[0] == -np.inf
    six, more = (gain(*evidence, np.array([0, 1, 2, 3, 4, 5, *x]), 0.0)[0] for x in ([], [6, 8]))
    assert -np.inf < six == more


@pytest.fixture
def model():
    """Classes 0 to 2 are of the first room type, and classes 3 to 5 of the second."""
    artifact = larger_artifact("triway-states", several_rooms=3.0)
    evidence = np.zeros((9, 2), np.float32)
    evidence[:3, 0] = evidence[3:6, 1] = 4.0
    vars(artifact)["room_evidence"] = table(evidence)
    return artifact


def test_the_warning_has_the_objects_of_each_room(model):
    (warning,) = several_rooms(model, scene_of([0, 3, 1, 4, 2, 5, 5]))
    assert (warning.code, warning.objects) == ("several-rooms", [])
    assert {one.room_type: one.objects for one in warning.rooms} == {
        "bedroom": ["bed_0", "lamp_2", "desk_4"],
        "office": ["chair_1", "sofa_3", "vase_5", "vase_6"],
    }


def test_positions_decide_where_there_are_any(model):
    """A class of the second type that stands among those of the first is in the first room."""
    scene = scene_of([0, 1, 2, 3, 4, 5, 5])
    places = [(0, 0), (1, 0), (2, 0), (8, 0), (9, 0), (10, 0), (0.5, 0)]
    pairs = zip(scene.objects, places, strict=True)
    objects = tuple(replace(one, position=(x, y, 0.0)) for one, (x, y) in pairs)
    (warning,) = several_rooms(model, replace(scene, objects=objects))
    rooms = {one.room_type: one.objects for one in warning.rooms}
    assert rooms == {
        "bedroom": ["bed_0", "lamp_1", "desk_2", "vase_6"],
        "office": ["chair_3", "sofa_4", "vase_5"],
    }


@pytest.mark.parametrize("classes", [[0, 1, 2, 6, 7], [0, 1, 2, 6, 7, 8, 0], [0, 3, 1, 4]])
def test_one_room_and_short_lists_give_no_warning(model, classes):
    assert several_rooms(model, scene_of(classes)) == []


def test_a_model_without_limit_or_room_types_gives_no_warning(model):
    everything = scene_of([0, 3, 1, 4, 2, 5])
    for artifact in (larger_artifact("triway-states"), larger_artifact("gbm", several_rooms=-1e9)):
        assert several_rooms(artifact, everything) == []


def test_weak_detections_and_a_stated_type_give_no_warning(model):
    scene = scene_of([0, 3, 1, 4, 2, 5, 5])
    assert several_rooms(model, scene)
    assert several_rooms(model, replace(scene, room_type=0)) == []
    weak = [replace(one, confidence=0.3) if k % 2 else one for k, one in enumerate(scene.objects)]
    assert several_rooms(model, replace(scene, objects=tuple(weak))) == []
