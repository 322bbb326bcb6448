"""The model of detectors. Bounds of shares are five standard deviations."""

import numpy as np
import pytest

from app.scene import ObjectClass, Vocabulary
from tests.training.evaluation.scenes import scene
from training.datasets import detections
from training.datasets.detections import (
    GHOST,
    GHOSTS,
    INTRUDER,
    MISSED,
    RIGHT_LAW,
    SWAPPED,
    SWAPPED_LAW,
    Detector,
)

LABELS = ("cup", "bowl", "glass", "bottle", "plate", "spoon", "fork", "cat", "wall", "toaster")
CAT, WALL, TOASTER = 7, 8, 9
JUDGED = range(7)
VOCABULARY = Vocabulary(
    [ObjectClass(label, structure=label == "wall", anywhere=label == "cat") for label in LABELS]
)
FREQUENCY = np.array([0.5, 0.3, 0.2, 0.1, 0.1, 0.1, 0.1, 0.2, 0.9, 0.0])
DETECTOR = Detector.of(VOCABULARY, FREQUENCY)
SCENES = 4000


@pytest.fixture(scope="module")
def seen():
    """All detections of 4,000 scenes of a cup, a bowl, a cat and a wall."""
    rng, encoded = np.random.default_rng(0), scene([0, 1, CAT, WALL])
    drawn = [DETECTOR.draw(encoded, VOCABULARY.structure.tolist(), rng) for _ in range(SCENES)]
    return detections.Detections(*map(np.concatenate, zip(*drawn, strict=True)))


def near(share: float, n: int) -> object:
    return pytest.approx(share, abs=5 * np.sqrt(share * (1 - share) / n))


def test_objects_are_missed_and_swapped_as_stated(seen):
    assert not np.isin(seen.truth, (WALL, INTRUDER)).any()
    objects = seen.truth >= 0
    assert objects.sum() / (3 * SCENES) == near(1 - MISSED, 3 * SCENES)
    cups = seen.truth == 0
    assert (~seen.right[cups]).mean() == near(SWAPPED, cups.sum())
    # A cat is never swapped and has no second label.
    cats = seen.truth == CAT
    assert seen.right[cats].all()
    assert (seen.other[cats] == -1).all()


def test_ghosts_have_the_frequency_of_their_classes(seen):
    ghosts = seen.classes[seen.truth == GHOST]
    chances = int((seen.truth >= 0).sum()) + SCENES
    assert len(ghosts) / chances == near(GHOSTS, chances)
    assert set(ghosts.tolist()) <= set(JUDGED)
    shares = FREQUENCY[: len(JUDGED)] / FREQUENCY[: len(JUDGED)].sum()
    for c in JUDGED:
        assert (ghosts == c).mean() == near(shares[c], len(ghosts))


def test_confidences_have_the_stated_means(seen):
    swapped = (seen.truth == 0) & ~seen.right
    for law, confidence in (
        (RIGHT_LAW, seen.confidence[seen.right]),
        (SWAPPED_LAW, seen.confidence[swapped]),
        (SWAPPED_LAW, seen.other_confidence[swapped]),
    ):
        mean = law[0] / sum(law)
        assert confidence.mean() == pytest.approx(mean, abs=5 * 0.25 / np.sqrt(len(confidence)))


def test_the_second_label_of_a_swapped_object_is_the_true_one(seen):
    swapped = (seen.truth >= 0) & ~seen.right
    np.testing.assert_array_equal(seen.other[swapped], seen.truth[swapped])
    right = seen.right & (seen.other >= 0)
    assert (seen.other[right] != seen.classes[right]).all()
    assert not np.isin(seen.other[right], (CAT, WALL, TOASTER)).any()


def test_an_intruder_is_a_class_that_is_absent():
    rng = np.random.default_rng(0)
    encoded = scene([0, 1])
    seen = DETECTOR.draw(encoded, VOCABULARY.structure.tolist(), rng)
    added = [DETECTOR.with_intruder(seen, encoded.instance_classes, rng) for _ in range(50)]
    for one in added:
        assert one.truth[-1] == INTRUDER
        assert one.right[-1]
        assert one.classes[-1] in range(2, 7)


def test_an_empty_scene_can_have_no_detection():
    rng = np.random.default_rng(0)
    sizes = [len(DETECTOR.draw(scene([]), (), rng).classes) for _ in range(50)]
    assert set(sizes) == {0, 1}
