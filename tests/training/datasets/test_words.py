from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.scene import ObjectClass, Vocabulary
from training.datasets import DatasetError, words
from training.datasets.words import class_vectors, read_word_vectors
from training.fit.configuration import DataConfig
from training.runs.pipeline import read_sources, split_and_encode

WORDS = np.array(["coffee", "table", "zero", "the", "sofa"])
VECTORS = np.array([[4, 0], [0, 2], [0, 0], [3, 3], [3, -4]], dtype=np.int8)
SCALE = np.float32(0.5)


def save(folder: Path, **changes: Any) -> Path:
    path = folder / "vectors.npz"
    arrays = {"words": WORDS, "vectors": VECTORS, "scale": SCALE} | changes
    np.savez(path, **{name: value for name, value in arrays.items() if value is not None})
    return path


def test_vectors_of_words(tmp_path: Path) -> None:
    found = read_word_vectors(save(tmp_path))
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


def test_classes_have_the_mean_vector_of_label_and_aliases(tmp_path: Path) -> None:
    classes = (
        ObjectClass("coffee table"),
        ObjectClass("settee", ("davenport", "sofa", "table")),
        ObjectClass("coffee", ("lectern",)),
        ObjectClass("futon", parent="settee"),
        ObjectClass("lamp"),
    )
    vectors, found = class_vectors(read_word_vectors(save(tmp_path)), Vocabulary(classes))
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
    assert scenes.words is not None
    words = dict(zip(scenes.vocabulary.labels, scenes.words, strict=True))
    assert words["sofa"] @ words["armchair"] > words["sofa"] @ words["toilet"] + 0.2
    parents = scenes.training_data().parents
    assert parents.tolist() == scenes.vocabulary.parents.tolist()
    assert (parents >= 0).any()


@pytest.mark.parametrize(
    ("changes", "problem"),
    [
        ({"words": None}, "words: is missing"),
        ({"words": np.array([1, 2, 3, 4, 5])}, "words: must be 1 to"),
        ({"words": np.array(["a", "A", "b", "c", "d"])}, "words: contains a word twice"),
        ({"words": WORDS[:0], "vectors": VECTORS[:0]}, "words: must be 1 to"),
        ({"vectors": VECTORS[1:]}, "vectors: must be 5 rows of int8"),
        ({"vectors": VECTORS.astype(np.float32)}, "vectors: must be 5 rows of int8"),
        ({"vectors": VECTORS[:, :0]}, "vectors: must have at least one column"),
        ({"scale": np.float32(np.nan)}, "scale: must be one positive number"),
        ({"scale": np.float32([1, 2])}, "scale: must be one positive number"),
    ],
)
def test_malformed_arrays(tmp_path: Path, changes: dict[str, Any], problem: str) -> None:
    with pytest.raises(DatasetError, match=rf"vectors\.npz, {problem}"):
        read_word_vectors(save(tmp_path, **changes))


def test_malformed_files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(DatasetError, match=r"none\.npz: no such file"):
        read_word_vectors(tmp_path / "none.npz")
    pickled = save(tmp_path, words=np.array(["a", {}, 1, 2, 3], dtype=object))
    with pytest.raises(DatasetError, match=r"vectors\.npz: cannot be read: Object arrays"):
        read_word_vectors(pickled)
    path = save(tmp_path)
    whole = path.read_bytes()
    for broken in (b"", whole[:200], whole[:-30], whole.replace(b"NUMPY", b"NUMPI")):
        path.write_bytes(broken)
        with pytest.raises(DatasetError, match=r"vectors\.npz"):
            read_word_vectors(path)
    monkeypatch.setattr(words, "MAX_BYTES", 64)
    with pytest.raises(DatasetError, match=r"vectors\.npz, words: must be at most 0 MiB"):
        read_word_vectors(save(tmp_path))
