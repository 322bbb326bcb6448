import numpy as np
import pytest

from app.questions.where import where
from app.scene.spatial_relations import ON_TOP
from tests.questions.artifacts import LABELS, larger_artifact
from tests.training.evaluation.scenes import scene, tensors
from training.datasets.homes import NOWHERE, home_cases
from training.evaluation.setting import Setting
from training.evaluation.where_task import _top, kept_objects, rooms_of, where_task
from training.fit.regression import structure_of

V = len(LABELS)
BED, LAMP, DESK, CHAIR, SOFA, VASE, SHELF, RUG, WALL = range(V)


def homes(number: int, source: str = "procthor") -> list:
    """Homes of a bedroom, an office and a living room. A lamp is on the desk of the office."""
    made = []
    for k in range(number):
        rooms = [[BED, RUG, WALL], [DESK, LAMP, CHAIR, WALL], [SOFA, VASE, RUG, BED, WALL]]
        for name, room in enumerate(rooms):
            on_desk = [(ON_TOP, LAMP, DESK)] if LAMP in room else []
            place = {"source": source, "group": f"h{k}", "name": f"h{k} {name}"}
            made.append(scene(room, on_desk, room=[0, 1, -1][name], relations=5, **place))
    return made


@pytest.fixture(scope="module")
def model():
    return larger_artifact("triway-states")


@pytest.fixture(scope="module")
def setting(model):
    return Setting(tensors(homes(4), V), structure_of(model))


def test_figures_are_those_of_the_answers(model, setting):
    metrics = where_task(model, setting).metrics
    first, three, place, popular, right = [], [], [], [], []
    of_places = []  # whether the first place is right
    for case in home_cases(setting.scenes.scenes, model.vocabulary.structure, setting.seed):
        answer = where(model, rooms_of(model, case), case.thing)
        right.append(int(answer["rooms"][0]["room"]) == case.room)
        top = answer["places"][0]
        if case.room == NOWHERE or case.thing != LAMP:
            of_places.append(int(top["room"]) == case.room and "relation" not in top)
        if case.room == NOWHERE:
            continue
        first.append(right[-1])
        three.append(True)  # of three rooms
        popular.append(case.room == 2)  # five objects
        if case.thing == LAMP:  # the only thing with a supporter
            kept = kept_objects(case.rooms[1], LAMP, model.vocabulary.structure)
            on_desk = case.rooms[1].instance_classes[kept[int(top.get("object", 0))]] == DESK
            is_there = top["room"] == "1" and top.get("relation") in ("on-top", "inside")
            place.append(bool(is_there and on_desk))
            of_places.append(place[-1])
    assert metrics["first room"].value == pytest.approx(np.mean(first))
    assert metrics["first three"].value == np.mean(three)
    assert metrics["first room, popularity"].value == pytest.approx(np.mean(popular))
    assert metrics["first place"].value == pytest.approx(np.mean(place))
    assert 0 <= metrics["first room, rooms alone"].value <= 1
    assert 0 <= metrics["ECE"].value <= 1
    assert metrics["ECE, places"].truth.tolist() == of_places


def test_ties_are_in_random_order():
    values = np.array([0.5, 0.2, 0.2, 0.1])
    assert [_top(values, room, 1) for room in range(4)] == [1, 0, 0, 0]
    assert [_top(values, room, 2) for room in range(4)] == [1, 0.5, 0.5, 0]
    assert [_top(np.zeros(4), room, 3) for room in range(4)] == [0.75] * 4


def test_only_homes_take_part(model):
    others = Setting(tensors(homes(4, source="sunrgbd"), V), structure_of(model))
    assert where_task(model, others) is None
    gbm = larger_artifact("gbm")
    assert where_task(gbm, Setting(tensors(homes(4), V), structure_of(gbm))) is None
