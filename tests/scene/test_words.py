from pathlib import Path

import numpy as np
import pytest

from app.scene import ObjectClass, Vocabulary
from app.scene.words import WordVectors, class_vectors, word_vectors
from training.fit.configuration import DataConfig
from training.runs.pipeline import read_sources, split_and_encode

VECTORS = np.array([[4, 0], [0, 2], [0, 0], [3, 3], [3, -4]], dtype=np.int8)
FOUND = WordVectors(("coffee", "table", "zero", "the", "sofa"), VECTORS, 0.5)


def test_vectors_of_words() -> None:
    found = FOUND
    assert found.dimensions == 2
    half = np.sqrt(0.5)
    for text, vector in (
        ("coffee", (1, 0)),
        ("Coffee_Tables", (half, half)),
        ("the table", (0, 1)),
        ("table x", (0, 1)),
        ("the", (half, half)),
    ):
        assert found.of(text) == pytest.approx(np.array(vector)), text
    for text in ("zero", "lamp", "table x y", "", "-"):
        assert found.of(text) is None, text


def test_classes_have_the_mean_vector_of_label_and_aliases() -> None:
    classes = (
        ObjectClass("coffee table"),
        ObjectClass("settee", ("davenport", "sofa", "table")),
        ObjectClass("coffee", ("lectern",)),
        ObjectClass("futon", parent="settee"),
        ObjectClass("lamp"),
    )
    names = [(entry.label, *entry.aliases) for entry in classes]
    vectors, found = class_vectors(FOUND, names, Vocabulary(classes).parents.tolist())
    assert found.tolist() == [True] * 4 + [False]
    assert vectors.dtype == np.float32
    half = np.sqrt(0.5)
    assert vectors[0] == pytest.approx([half, half])
    assert vectors[1] == pytest.approx(np.array([0.6, 0.2]) / np.sqrt(0.4))
    assert vectors[2] == pytest.approx([1, 0])
    assert vectors[3].tolist() == vectors[1].tolist()
    assert not vectors[4].any()


def test_training_reads_the_vectors_of_the_repository(tmp_path: Path) -> None:
    data = DataConfig(sources=("rooms",), vocabulary="rooms", rooms=40, words=True)
    scenes = split_and_encode(data, read_sources(data, tmp_path), tmp_path)
    words = dict(zip(scenes.vocabulary.labels, scenes.words, strict=True))
    assert words["sofa"] @ words["armchair"] > words["sofa"] @ words["toilet"] + 0.2
    parents = scenes.training_data().parents
    assert parents.tolist() == scenes.vocabulary.parents.tolist()
    assert (parents >= 0).any()


def test_the_shipped_vectors_tell_similar_words() -> None:
    found = word_vectors()
    assert (len(found.words), found.dimensions) == (41_306, 100)
    assert found.vectors.dtype == np.int8
    sofa, couch, whale = (found.of(word) for word in ("sofa", "couch", "whale"))
    assert sofa @ couch > 0.6 > 0.3 > sofa @ whale
    assert found.of("qwrtzx") is None


@pytest.mark.parametrize("label", ["bed", "zxqvwa"])
def test_a_word_has_a_meaning_only_beside_a_known_class_that_is_no_structure(label: str) -> None:
    floor = ObjectClass("floor", structure=True)
    word = Vocabulary([floor, ObjectClass(label)]).meaning("sofa")
    assert (word is None) == (label == "zxqvwa")
