"""Models with the predicted weights of words."""

from dataclasses import replace

import numpy as np
import pytest

from app.inference.objects import ObjectScorer
from app.inference.weights import layout
from app.model.word_weights import RowMap
from app.scene import ObjectClass, Vocabulary
from app.scene.vocabulary import Word
from tests.questions.artifacts import LARGER, larger_artifact

LABELS = ("bed", "lamp", "desk", "chair", "sofa", "vase", "shelf", "rug", "wall")
CLASSES = Vocabulary([ObjectClass(label, structure=label == "wall") for label in LABELS])
SHAPES = ("b", "kappa", "Y")


def words(*names: str) -> list[Word]:
    found = [CLASSES.meaning(name) for name in names]
    assert None not in found
    return found


def by_class(weights, name: str) -> np.ndarray:
    return weights[name] if name == "W" else weights[name].T


@pytest.fixture(params=LARGER)
def weights(request):
    return larger_artifact(request.param).weights


def test_rows_are_those_of_kernel_ridge_regression(weights) -> None:
    """The formula of the module, written out with loops over the classes."""
    row_map = RowMap.fit(weights, CLASSES, [LABELS.index("vase")])
    used = [k for k, label in enumerate(LABELS) if label not in ("vase", "wall")]
    vectors = CLASSES.vectors[0].astype(np.float64)
    centre = vectors[used].mean(0)
    x = [(vectors[k] - centre) / np.linalg.norm(vectors[k] - centre) for k in used]
    kernel = np.array([[np.exp(p @ q - 1) + 0.1 * (p is q) for q in x] for p in x])
    word = words("ottoman")[0]
    z = (word.vector - centre) / np.linalg.norm(word.vector - centre)
    share = np.linalg.solve(kernel, np.array([np.exp(z @ p - 1) for p in x]))
    rows = row_map.rows(weights, word.vector[None])
    for name in {"W", *SHAPES} & set(weights.arrays):
        known = by_class(weights, name)[used].astype(np.float64)
        mean = known.mean(0)
        stretch = 1.7 if name == "W" else 1.0
        expected = mean + stretch * np.tensordot(share, known - mean, 1)
        assert rows[name][0] == pytest.approx(expected, abs=2e-4), name


def test_a_left_out_row_has_no_effect(weights) -> None:
    left_out = LABELS.index("sofa")
    changed = {name: array.copy() for name, array in weights.arrays.items()}
    for name in {"W", *SHAPES} & set(changed):
        (changed[name] if name == "W" else changed[name].T)[left_out] += 3
    vector = words("couch")[0].vector[None]
    other = replace(weights, arrays=changed)
    rows, same = (RowMap.fit(w, CLASSES, [left_out]).rows(w, vector) for w in (weights, other))
    assert all(np.array_equal(rows[name], same[name]) for name in rows)
    seen = RowMap.fit(other, CLASSES).rows(other, vector)
    assert np.abs(seen["W"] - rows["W"]).max() > 0.5


def test_known_classes_keep_their_weights(weights) -> None:
    larger = RowMap.fit(weights, CLASSES).with_words(weights, words("ottoman", "mug"))
    V = weights.spec.V
    assert larger.spec == replace(weights.spec, V=V + 2)
    for name, (_, shape) in layout(weights.spec).items():
        assert np.array_equal(larger[name][tuple(map(slice, shape))], weights[name]), name
    if weights.spec.coupled:
        assert not larger["L"][V:].any()
        assert not larger["L"][:, V:].any()
    # A word is evidence, and known classes keep their log-odds without one.
    nothing = np.zeros(0, np.int64), np.zeros(0, np.float32)
    scorers = ObjectScorer(weights), ObjectScorer(larger)
    of_known, of_all = (one.absent(weights["c1"], *nothing, None, 0.5) for one in scorers)
    assert of_all[:V] == pytest.approx(of_known, abs=1e-5)


def test_stored_scenes_show_no_word() -> None:
    """Also where the words fill the last 32 bits, and begin the next."""
    weights = larger_artifact("triway").weights
    spec = replace(weights.spec, N=2)
    packed = np.array([[0b1011], [0b100000001]], np.int32)
    arrays = dict(weights.arrays) | {"fantasies": packed, "fantasy_rooms": np.array([0, -1], "i4")}
    stored = replace(weights, spec=spec, arrays=arrays)
    for V in (9 + 23, 9 + 24):
        larger = stored.enlarged(V, spec.C)
        assert larger.chain_samples.shape == (2, V)
        assert np.array_equal(larger.chain_samples[:, :9], stored.chain_samples)
        assert not larger.chain_samples[:, 9:].any()


def test_a_model_without_word_vectors_has_no_map() -> None:
    weights = larger_artifact("triway").weights
    strange = Vocabulary([ObjectClass(f"zxqv{k}") for k in range(9)])
    assert strange.meaning("mug") is None
    with pytest.raises(ValueError, match="no class of the model has a word vector"):
        RowMap.fit(weights, strange)


def test_a_model_keeps_few_models_with_words(monkeypatch: pytest.MonkeyPatch) -> None:
    artifact = replace(larger_artifact("triway"), vocabulary=CLASSES)
    assert artifact.with_words([]) is artifact
    one = artifact.with_words(words("ottoman"))
    assert artifact.with_words(words("ottoman")) is one
    assert one.vocabulary.labels == (*LABELS, "ottoman")
    for name in ("mug", "spoon", "tractor", "ladder"):
        artifact.with_words(words(name))
    assert artifact.with_words(words("ottoman")) is not one
    assert len(artifact._with_words) <= 4
