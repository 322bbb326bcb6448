import math
from dataclasses import replace

import numpy as np
import pytest

from app.model import Counts
from app.model.fields import TensorGroup
from app.registry.tensors import read_group
from app.scene import CANONICAL, ObjectClass, Vocabulary
from tests.training.evaluation.furnished_rooms import VOCABULARY, room_model, rooms
from tests.training.evaluation.scenes import scene
from training.datasets.cases import MOST, counted_classes, scene_rng, some_instances
from training.datasets.sources import SOURCES
from training.evaluation.setting import Setting
from training.evaluation.statistics_tasks import counts_task
from training.fit.count_statistics import fit_counts

CHAIR, DESK, TABLE, WALL = range(4)
NAMES = ("chair", "desk", "table", "wall")
CLASSES = [ObjectClass(name, structure=name == "wall") for name in NAMES]
WORDS = Vocabulary(CLASSES, ("office", "kitchen"))
FEW, MANY = (0.62, 0.24, 0.10, 0.04), (0.2, 0.3, 0.3, 0.2)


def furnished(number: int, seed: int, source: str = "toy"):
    """Few chairs at a desk, more at a table; walls in every scene."""
    rng = np.random.default_rng(seed)
    found = []
    for k in range(number):
        anchor, law = (DESK, FEW) if k % 2 else (TABLE, MANY)
        chairs = int(rng.choice(4, p=law)) + 1
        name = f"{source} {seed} {k}"
        found.append(scene([CHAIR] * chairs + [anchor, WALL], source=source, group=name, name=name))
    return found


def expected(counts: Counts, anchor: int, listed: int) -> float:
    _, p = counts.distribution(len(WORDS), np.array([CHAIR, anchor]), np.array([listed, 1]))
    return float(p[0] @ np.arange(1, MOST + 1))


def exact(law: tuple[float, ...], listed: int) -> float:
    """The posterior mean in scenes that list chairs and anchor: half list one chair, and half any
    number of chairs."""
    weight = [
        p * (0.5 * (listed == 1) + 0.5 / n) if n >= listed else 0.0 for n, p in enumerate(law, 1)
    ]
    return sum(n * w for n, w in enumerate(weight, 1)) / sum(weight)


def test_the_scene_moves_the_expected_number():
    """1,000 scenes. With three other seeds, the largest error is 0.13."""
    counts = fit_counts(furnished(1000, 1), WORDS)
    assert counts.classes.tolist() == [CHAIR]
    for anchor, law in ((DESK, FEW), (TABLE, MANY)):
        for listed in (1, 2):
            assert expected(counts, anchor, listed) == pytest.approx(
                exact(law, listed), abs=0.15
            ), (anchor, listed)
    check_stored_exactly(counts, len(WORDS), 2)


def check_stored_exactly(group: TensorGroup, classes: int, rooms: int) -> None:
    again = read_group(type(group), group.tensors(), len(CANONICAL), classes, rooms)
    assert again is not None
    for name, tensor in group.tensors().items():
        assert np.array_equal(again.tensors()[name], tensor)
        if tensor.ndim > 1:
            assert np.array_equal(tensor.astype(np.float16), tensor), "half precision changes it"


@pytest.mark.parametrize(("groups", "most"), [(19, 4), (20, 7)])
def test_a_listed_number_needs_twenty_groups_that_have_it(groups, most):
    # A group has two scenes, one of them with fewer chairs.
    many = [
        scene([CHAIR] * chairs + [TABLE], group=f"many {k}", name=f"many {k} {chairs}")
        for k in range(groups)
        for chairs in (2, 7 + k)
    ]
    assert fit_counts([*furnished(400, 0), *many], WORDS).most.tolist() == [most]


def test_a_part_lists_what_its_docstring_says():
    whole = scene([CHAIR] * 30 + [DESK, DESK, TABLE, WALL], room=1)
    parts = [some_instances(whole, WORDS.structure, scene_rng(whole, seed)) for seed in range(2000)]
    assert {len(part.classes) for part in parts} == {1, 2, 3}
    listed = [int(part.listed[0]) for part in parts if part.classes[0] == CHAIR]
    assert {int(part.number[0]) for part in parts if part.classes[0] == CHAIR} == {MOST}
    share = np.bincount(listed, minlength=MOST + 1)[1:] / len(listed)
    law = np.full(MOST, 0.5 / MOST)
    law[0] += 0.5
    # The standard error of a share of 1,250 draws is at most .014.
    assert share == pytest.approx(law, abs=0.06)
    assert np.mean([part.room == 1 for part in parts]) == pytest.approx(0.5, abs=0.05)


def test_a_source_counts_only_if_labels_repeat_and_lists_are_complete():
    once = [scene([CHAIR, DESK], source="once") for _ in range(40)]
    partial = [replace(entry, complete=False) for entry in furnished(40, 0, "partial")]
    counting = counted_classes([*once, *partial, *furnished(40, 0)], WORDS)
    assert counting.keys() == {"toy"}
    assert counting["toy"].tolist() == [True, True, True, False]
    assert fit_counts([*once, *partial], WORDS) is None


def test_alfred_counts_only_movable_objects(monkeypatch):
    monkeypatch.setitem(SOURCES, "toy", SOURCES["alfred"])
    assert counted_classes(furnished(40, 0), WORDS)["toy"].tolist() == [True, False, False, False]


def test_no_statistics_where_the_data_cannot_tell():
    assert fit_counts(furnished(12, 0), WORDS) is None
    # Of two groups with the same other class, one has one chair in each scene, and one has four.
    words = Vocabulary([ObjectClass(name) for name in ("chair", *"abcdefghijklmnopqrst")])
    misleading = [
        scene([CHAIR] * chairs + [other], group=f"{other} {chairs}", name=f"{other} {chairs} {k}")
        for other in range(1, 21)
        for chairs in (1, 4)
        for k in range(8)
    ]
    assert fit_counts(misleading, words) is None
    # With the groups of half of the classes, nothing misleads.
    fair = [one for one in misleading if (int(one.group.split()[0]) % 2) == (one.group[-1] == "4")]
    assert fit_counts(fair, words) is not None


def test_frames_and_written_numbers_teach_no_counts():
    for source in ("sunrgbd", "inventories"):
        assert fit_counts(furnished(60, 0, source), WORDS) is None
    assert fit_counts(furnished(60, 0), WORDS) is not None


def test_every_source_weighs_as_much_as_the_others():
    """Each share has a standard deviation of 2 %, from the parts that list no chair."""

    def rooms_of(source: str, number: int, chairs: int):
        classes = [CHAIR] * chairs + [DESK]
        names = [f"{source}{k}" for k in range(number)]
        return [scene(classes, source=source, group=name, name=name) for name in names]

    counts = fit_counts([*rooms_of("many", 600, 2), *rooms_of("few", 150, 4)], WORDS)
    share = np.exp(counts.log_share[0])
    assert share[1] == pytest.approx(share[3], rel=0.1)
    assert math.isclose(share.sum(), 1, rel_tol=1e-2)


def test_generated_rooms_beat_the_class_mean():
    """400 rooms to learn from, 200 others to test; the seeds are fixed."""
    train, test = rooms(400, 0), rooms(200, 2)
    artifact = replace(room_model(), counts=fit_counts(train.scenes, VOCABULARY))
    found = counts_task(artifact, Setting(test, None, train)).metrics
    change = found["change of error, class mean"].figure()
    assert change.high < 0
    error, mean = found["error of the expected count"], found["error of the class mean"]
    assert change.value == pytest.approx(error.value - mean.value)
    assert found["count in the interval"].value > 0.75
    assert found["proposals that are right"].value > 0.5
    # The task needs counts, and a source that counts.
    bare = replace(test, scenes=[scene([0, 1]) for _ in range(20)])
    assert counts_task(artifact, Setting(bare, None, bare)) is None
    assert counts_task(room_model(), Setting(test, None, test)) is None
