from dataclasses import replace

from tests.training.evaluation.furnished_rooms import room_model, rooms
from training.evaluation.outlier_tasks import ALARMS, EXCESS, Alarms, untouched_alarms
from training.fit.regression import recalibrated


def test_the_first_alarms_are_accepted_and_too_many_refused():
    refused = [
        Alarms("own", "objects", "medium", 100, k).objection() is not None for k in range(101)
    ]
    assert refused == sorted(refused)
    first = refused.index(True)
    assert Alarms("own", "objects", "medium", 100, first).at_least > EXCESS * ALARMS["medium"]
    assert 100 * EXCESS * ALARMS["medium"] < first < 30


def test_a_model_that_judges_upside_down_is_refused():
    """One scene of each group counts; relations count where object lists are incomplete."""
    artifact, scenes = room_model(), rooms(60, 3).scenes
    calm = recalibrated(artifact, outlier=None, outlier_lines=None)
    entry = artifact.calibration.outlier
    turned = recalibrated(artifact, outlier=entry.model_copy(update={"intercept": 50.0}))
    groups = len({scene.group for scene in scenes})
    for model, share in ((calm, 0), (turned, 1)):
        for found in untouched_alarms(model, scenes):
            alarms = share * groups if found.about == "objects" else 0
            assert (found.scenes, found.alarms) == (groups, alarms)
            assert (found.objection() is None) == (alarms == 0)
    partly = [replace(scene, complete=False) for scene in scenes]
    assert not any(found.alarms for found in untouched_alarms(turned, partly))
