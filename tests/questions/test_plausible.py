"""Generated scenes that are drawn again: too small scenes, and scenes with an intruder."""

from __future__ import annotations

import pytest

from app.registry.description import Thresholds
from tests.questions.answers import generate, outliers
from tests.questions.artifacts import LABELS, LARGER, larger_artifact, scene_of

LOCAL = [name for name, spec in LARGER.items() if spec.is_local]


def thresholds(p):
    return Thresholds(low=p, medium=p, high=p)


# Every object is an intruder, or none is.
ALL, NONE = thresholds(0.0), thresholds(1.0)


def draw(name, scene, **calibration):
    return generate(larger_artifact(name, **calibration), scene, count=24, seed=3, steps=4)


@pytest.mark.parametrize("name", LOCAL)
def test_too_small_scenes_are_drawn_again(name):
    """The last attempt is accepted, so some scenes may still be small."""
    free = sorted(len(scene.objects) for scene in draw(name, scene_of([])))
    # About half of the scenes are smaller.
    least = free[12] if free[12] > free[0] else free[-1]
    scenes = draw(name, scene_of([]), smallest=(least,) * (LARGER[name].C + 1))
    assert sum(size < least for size in free) > sum(len(one.objects) < least for one in scenes)


@pytest.mark.parametrize("name", LOCAL)
def test_the_last_attempt_is_accepted(name):
    """Every scene has an intruder, and the answer is still complete."""
    scenes = draw(name, scene_of([0]), outlier_thresholds=ALL)
    assert len(scenes) == 24
    assert all("bed" in scene.objects for scene in scenes)
    assert scenes == draw(name, scene_of([0]), outlier_thresholds=ALL)
    assert scenes != draw(name, scene_of([0]), outlier_thresholds=NONE)


def test_listed_objects_are_never_intruders():
    """The evidence contains all classes, so no scene is drawn again."""
    scene = scene_of(list(range(len(LABELS))))
    one, other = (draw("triway-local", scene, outlier_thresholds=limits) for limits in (ALL, NONE))
    assert one == other


def test_scenes_with_intruders_are_drawn_again():
    """Fewer intruders remain."""
    plain, counts = larger_artifact("triway-local"), []
    for limits in (NONE, thresholds(0.5)):
        scenes = draw("triway-local", scene_of([]), outlier_thresholds=limits)
        judged = [outliers(plain, scene_of(list(map(LABELS.index, one.objects)))) for one in scenes]
        counts.append(sum(entry.probability > 0.5 for one in judged for entry in one.outliers))
    assert counts[1] < counts[0]
