from __future__ import annotations

import pytest

from tests.training.evaluation.scenes import scene as encoded_scene
from tests.training.scenes import scene
from training.datasets.vocabulary import Names
from training.domain.look import count_labels, outside_vocabulary, similar_labels

NAMES = Names(base=("cup", "table"), aliases={"sofa": ("couch",)})


def test_spellings_and_aliases_count_as_one_label() -> None:
    scenes = [scene("a", "Lab Stool", "lab_stools", "couch"), scene("b", "lab stool", "sofa")]
    found = {label.name: label for label in count_labels(scenes, NAMES)}
    assert set(found) == {"lab stool", "sofa"}
    stool = found["lab stool"]
    assert stool.mentions == 3
    assert set(stool.spellings) == {"Lab Stool", "lab_stools", "lab stool"}
    assert found["sofa"].mentions == 2


def test_likely_typing_errors_are_found() -> None:
    counts = {
        "oscilloscope": 30,
        "osciloscope": 2,
        # Names that are short, curated or numbered are different objects.
        "blad": 9,
        "blat": 1,
        "table": 9,
        "tables top": 3,
        "conveyor 1": 8,
        "conveyor 2": 1,
    }
    scenes = [scene(f"{label} {k}", label) for label, n in counts.items() for k in range(n)]
    (pair,) = similar_labels(count_labels(scenes, NAMES), NAMES)
    assert [(label.name, label.mentions) for label in pair] == [
        ("osciloscope", 2),
        ("oscilloscope", 30),
    ]
    curated = Names(base=("cushion", "pushion"))
    assert not list(similar_labels(count_labels([scene("a", *curated.base)], curated), curated))


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
