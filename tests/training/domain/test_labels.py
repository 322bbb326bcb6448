from __future__ import annotations

import pytest

from tests.training.evaluation.scenes import scene as encoded_scene
from tests.training.scenes import scene
from training.datasets.names import Names
from training.domain.labels import count_labels, lookalikes, outside_vocabulary

NAMES = Names(base=("cup", "table"), aliases={"sofa": ("couch",)})


def test_spellings_and_aliases_count_as_one_label() -> None:
    scenes = [scene("a", "Lab Stool", "lab_stools", "couch"), scene("b", "lab stool", "sofa")]
    found = {label.name: label for label in count_labels(scenes, NAMES)}
    assert set(found) == {"lab stool", "sofa"}
    stool = found["lab stool"]
    assert stool.mentions == 3
    assert set(stool.spellings) == {"Lab Stool", "lab_stools", "lab stool"}
    assert found["sofa"].mentions == 2


def many(label: str, count: int, *others: str) -> list:
    return [scene(f"{label} {k}", label, *others) for k in range(count)]


def pairs(scenes):
    return {
        (pair.name, pair.like): pair
        for pair in lookalikes(count_labels(scenes, NAMES), scenes, NAMES)
    }


def test_uncertain_lookalikes_are_not_merged() -> None:
    both = many("pallet rack", 30) + many("pallet jack", 2) + many("pallet rack", 1, "pallet jack")
    frequent = many("hammers", 30) + many("hamper", 12)
    short = many("blade", 30) + many("blaze", 1)
    for scenes in (both, frequent, short):
        assert [pair.merged for pair in pairs(scenes).values()] == [False]


def test_numbered_and_curated_names_are_no_lookalikes() -> None:
    assert not pairs(many("conveyor 1", 20) + many("conveyor 2", 1))
    curated = Names(base=("cushion", "pushion"))
    scenes = many("cushion", 30) + many("pushion", 1)
    assert not lookalikes(count_labels(scenes, curated), scenes, curated)


def test_a_misspelling_is_merged_into_one_label() -> None:
    labels = {"soldering iron": 60, "soldering irom": 40, "soldering irok": 2}
    found = pairs([one for label, count in labels.items() for one in many(label, count)])
    assert [pair.name for pair in found.values() if pair.merged] == ["soldering irok"]


@pytest.mark.parametrize(
    ("unknown", "named", "line"),
    [
        ([(), ()], True, ""),
        (
            [("balcony", "sofa bed"), ("Sofa_beds",), ("sofa bed",), ()], True,
            '2 labels in 3 scenes are not in the vocabulary: "sofa bed" (3 scenes), "balcony" '
            "(1 scene); they are left out",
        ),
        (
            [("balcony",)], True,
            '1 label in 1 scene is not in the vocabulary: "balcony" (1 scene); it is left out',
        ),
        (
            [("a", "b")] * 1200, False,
            "2 labels in 1,200 scenes are not in the vocabulary; they are left out",
        ),
    ],
)  # fmt: skip
def test_labels_outside_the_vocabulary_are_one_line(unknown, named, line) -> None:
    scenes = [encoded_scene([0], unknown=labels) for labels in unknown]
    assert outside_vocabulary(scenes, named=named) == line


def test_the_line_about_many_labels_is_bounded() -> None:
    scenes = [encoded_scene([0], unknown=tuple(f"label {k}" for k in range(99)))]
    line = outside_vocabulary(scenes, named=True)
    assert '"label 0" (1 scene)' in line
    assert "91 more; they are left out" in line
    assert len(line) < 300
