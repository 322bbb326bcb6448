"""Which drawn scenes are drawn again: too small ones, and those with an intruder."""

from __future__ import annotations

import pytest

from app.registry.description import CountSlope, Thresholds
from tests.questions.answers import generate, outliers
from tests.questions.artifacts import LARGER, larger_artifact, scene_of

LOCAL = [name for name, spec in LARGER.items() if spec.form == "local"]
# Every object is an intruder, and none is.
ALL, NONE = (Thresholds(low=p, medium=p, high=p) for p in (0.0, 1.0))


def drawn(artifact, scene, **options):
    return generate(artifact, scene, count=24, seed=3, steps=4, **options)


@pytest.mark.parametrize("name", LOCAL)
def test_scenes_that_are_too_small_are_drawn_again(name):
    """Of eight attempts the last stands whatever it is, so that some may still be small."""
    rooms = LARGER[name].C + 1
    free = sorted(len(one.objects) for one in drawn(larger_artifact(name), scene_of([])))
    # Half of the scenes are smaller, or nearly so.
    least = free[12] if free[12] > free[0] else free[-1]
    artifact = larger_artifact(name, smallest=(least,) * rooms)
    large = [len(one.objects) for one in drawn(artifact, scene_of([]))]
    assert sum(size < least for size in free) > sum(size < least for size in large)


@pytest.mark.parametrize("name", LOCAL)
def test_the_last_attempt_stands(name):
    """Where every scene is refused, as many come back as where none is."""
    refused = drawn(larger_artifact(name, outlier_thresholds=ALL), scene_of([0]))
    assert len(refused) == 24
    assert all("bed" in one.objects for one in refused)
    again = drawn(larger_artifact(name, outlier_thresholds=ALL), scene_of([0]))
    assert refused == again
    assert refused != drawn(larger_artifact(name, outlier_thresholds=NONE), scene_of([0]))


def test_given_objects_are_never_a_reason():
    """All classes are given: whatever they are, nothing is drawn again."""
    scene = scene_of(list(range(9)))
    first, second = (
        drawn(larger_artifact("triway-local", outlier_thresholds=limits), scene)
        for limits in (ALL, NONE)
    )
    assert first == second


def test_unlikely_classes_are_drawn_again():
    """Fewer of what raises an alarm are left."""
    entry = CountSlope(slope=-1.0)
    counts = []
    for limits in (NONE, Thresholds(low=0.5, medium=0.5, high=0.5)):
        artifact = larger_artifact("triway-local", outlier=entry, outlier_thresholds=limits)
        scenes = drawn(artifact, scene_of([]))
        labels = artifact.vocabulary.labels
        counts.append(
            sum(
                entry.probability > 0.5
                for one in scenes
                for entry in outliers(
                    artifact, scene_of([labels.index(label) for label in one.objects])
                ).outliers
            )
        )
    assert counts[1] < counts[0]
