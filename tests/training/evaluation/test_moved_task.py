from itertools import count

import numpy as np
import pytest

from tests.training.evaluation.furnished_rooms import STRUCTURE, rooms
from tests.training.evaluation.scenes import NO_STRUCTURE, scene, tensors, values_of
from training.evaluation.asking import LeakError
from training.evaluation.outlier_tasks import flagged, moved_cases, moved_task
from training.evaluation.setting import Setting

LEFT, ON = 0, 2
POSED = rooms(20, 2)
LISTED = tensors(
    [
        *(scene([0, 1, 2, 3], [(ON, 1, 0), (ON, 2, 0), (LEFT, 1, 2)]) for _ in range(8)),
        *(scene([0, 1], [(LEFT, 1, 0)]) for _ in range(2)),
        scene([0, 1]),
    ]
)
BOTH = [(POSED, STRUCTURE), (LISTED, NO_STRUCTURE)]


def keyed(request):
    """What tells two requests apart."""
    return request.triples, tuple(thing.position for thing in request.objects)


def oracle(scenes, structure, *, names=("moved", "subject")):
    """A score that knows the moved objects."""
    moved = {keyed(case.moved): case.object for case in moved_cases(scenes, structure)}

    def score(request):
        if keyed(request) not in moved:
            return [{"subject": "0", "probability": 0.3}]
        right = dict.fromkeys(names, moved[keyed(request)])
        return [{"subject": "", "probability": 0.9} | right, {"subject": "0", "probability": 0.95}]

    return score


@pytest.mark.parametrize(("scenes", "structure"), BOTH)
def test_each_scene_gives_a_moved_and_an_untouched_case(scenes, structure):
    cases = moved_cases(scenes, structure)
    assert len(cases) == (len(POSED) if scenes is POSED else 8)
    for case in cases:
        assert case.moved.room_type is case.untouched.room_type is None
        index = int(case.object)
        if scenes is POSED:
            assert case.moved.relations is case.untouched.relations is None
            assert case.moved.objects[index] != case.untouched.objects[index]
        else:
            (new,) = set(case.moved.triples) - set(case.untouched.triples)
            assert new[:2] == (ON, index)


@pytest.mark.parametrize(("scenes", "structure"), BOTH)
@pytest.mark.parametrize(
    ("names", "named", "is_flagged"),
    [(("moved", "subject"), 1, 1), (("moved",), 1, 1), (("subject",), 0, 1), ((), 0, 0)],
)
def test_the_field_moved_names_and_a_subject_flags(scenes, structure, names, named, is_flagged):
    outcome = moved_task(oracle(scenes, structure, names=names), Setting(scenes, structure))
    # The second entry is about object 0, which moves in some rooms.
    zero = np.mean([case.object == "0" for case in moved_cases(scenes, structure)])
    assert values_of(outcome) == {
        "named first": named,
        "flagged at 5 % alarms": pytest.approx(max(is_flagged, zero)),
    }
    related = sum(bool(entry.evidence.holds.any()) for entry in scenes.scenes)
    assert (outcome.scenes, outcome.skipped) == (related, 2 if scenes is LISTED else 0)


def test_the_threshold_alarms_in_at_most_one_of_twenty_scenes_of_the_source():
    untouched = np.concatenate([np.arange(40) / 40, 10 + np.arange(10)])
    source = np.repeat([0, 1], [40, 10])
    suspicion = np.concatenate([np.full(20, 37 / 40), np.full(20, 37.5 / 40), np.full(10, 19.0)])
    # Two of 40 scenes exceed 37 / 40. Ten scenes allow no alarm.
    expected = np.repeat([False, True, False], [20, 20, 10])
    assert flagged(suspicion, untouched, source).tolist() == expected.tolist()
    assert flagged(untouched, untouched, source)[:40].mean() == 0.05


def test_a_model_without_entries_names_and_flags_nothing():
    outcome = moved_task(lambda _: [], Setting(LISTED, NO_STRUCTURE))
    assert [metric.value for metric in outcome.metrics.values()] == [0, 0]
    silent = tensors([scene([0, 1], [(LEFT, 1, 0)])])
    assert moved_task(lambda _: [], Setting(silent, NO_STRUCTURE)) is None


def test_a_score_that_follows_the_order_is_caught():
    turn = count()
    leaking = lambda _: [{"subject": "0", "probability": next(turn) / 1e4}]  # noqa: E731
    with pytest.raises(LeakError):
        moved_task(leaking, Setting(LISTED, NO_STRUCTURE))
    undefined = lambda _: [{"subject": "0", "probability": np.nan}]  # noqa: E731
    with pytest.raises(FloatingPointError, match="NaN"):
        moved_task(undefined, Setting(LISTED, NO_STRUCTURE))
