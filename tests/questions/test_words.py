"""Words that the model has no class for: their predicted weights, and answers about them."""

from dataclasses import replace

import numpy as np
import pytest

from app.inference.weights import layout
from app.model.word_weights import RowMap
from app.questions.missing import missing
from app.questions.outliers import outliers
from app.questions.posterior import Posterior
from app.questions.relations import relations
from app.questions.rooms import rooms
from app.scene import ObjectClass, RelationTable, Scene, SceneObject, Vocabulary
from app.scene.vocabulary import Word
from tests.questions.artifacts import DOUBTING, LABELS, LARGER, larger_artifact, lines

ALARM = lines(-1e3, -1e3, -1e3)
CLASSES = larger_artifact("triway").vocabulary


def open_artifact(name: str, *words: str, **changes):
    artifact = larger_artifact(name, **changes)
    return artifact.with_words([artifact.vocabulary.meaning(word) for word in words])


def objects(artifact, *labels: str) -> tuple[SceneObject, ...]:
    names = artifact.vocabulary.labels
    return tuple(SceneObject(f"{x}_{k}", x, names.index(x)) for k, x in enumerate(labels))


@pytest.fixture(params=LARGER)
def variant(request):
    return request.param


def test_a_word_that_is_listed_is_evidence(variant) -> None:
    """The log-odds of the others change as the gain of its row says."""
    artifact = open_artifact(variant, "ottoman")
    scene = Scene(objects(artifact, "bed", "ottoman"))
    posterior, weights = Posterior(artifact, scene), artifact.weights
    x = weights["c1"] + weights["W"][[0, 9]].sum(0)
    assert posterior.context.x == pytest.approx(x, abs=1e-5)
    without = Posterior(artifact, Scene(objects(artifact, "bed")))
    absent = np.array([1, 2])
    change = posterior.absent_log_odds(absent, 0.5) - without.absent_log_odds(absent, 0.5)
    reason = artifact.objects.reasons_for_absent(posterior.context, None, absent)[:, 1]
    assert change == pytest.approx(reason, abs=1e-4)
    assert np.abs(change).min() > 1e-4


def test_a_candidate_word_has_the_probability_of_its_row(variant) -> None:
    artifact = open_artifact(variant, "ottoman")
    scene = Scene(objects(artifact, "bed", "rug"))
    entry = missing(artifact, scene, candidates=[9, 1], listed_as={9: "Ottomans"}, coverage=0.5)
    named = {one["label"]: one for one in entry["missing"]}
    assert named["ottoman"]["listed_as"] == "Ottomans"
    z = Posterior(artifact, scene).absent_log_odds(np.array([9]), 0.5)[0]
    assert named["ottoman"]["log_odds"] == pytest.approx(float(z), rel=1e-4)
    assert named["ottoman"]["probability"] == pytest.approx(1 / (1 + np.exp(-float(z))), rel=1e-4)
    assert {"placements", "because"} <= named["ottoman"].keys()
    # The known classes answer as without the word.
    plain = larger_artifact(variant)
    expected = missing(plain, scene, candidates=[1], coverage=0.5)["missing"][0]
    assert named["lamp"] == expected


def test_relations_and_places_are_those_of_the_nearest_class(variant) -> None:
    artifact = open_artifact(variant, "couch")
    word, sofa = 9, 4
    assert artifact.vocabulary.stand_in[word] == sofa
    for others in (("lamp", "rug"), ("desk", "vase")):
        scene = Scene(objects(artifact, *others))
        anchors = np.array([0, 1])
        posterior = Posterior(artifact, scene)
        units, W = artifact.relation_units, artifact.weights["W"].copy()
        # With the same effect on the hidden units, the word has the relations of a sofa.
        W[sofa] = W[word]
        units._W = W
        both = [
            units.placement_log_odds(posterior.context, np.array([k]), anchors)
            for k in (word, sofa)
        ]
        for a, b in zip(*both, strict=True):
            assert a == pytest.approx(b, abs=1e-4)
    scene = Scene(objects(artifact, "couch", "rug"), RelationTable.stated([(3, 0, 1)]))
    answer = relations(artifact, scene, top_k=50)
    assert {one["subject"] for one in answer["relations"]} >= {"couch_0"}


def test_a_word_never_is_an_outlier(variant) -> None:
    """Not even where every known object is, or where the request states a threshold."""
    artifact = open_artifact(variant, "ottoman", outlier=DOUBTING, outlier_lines=ALARM)
    scene = Scene(objects(artifact, "bed", "ottoman", "lamp"))
    for options in ({}, {"threshold": 0.0}, {"sensitivity": "high"}):
        answer = outliers(artifact, scene, **options)
        flags = {one["label"]: one["is_outlier"] for one in answer["outliers"]}
        assert flags == {"bed": True, "lamp": True, "ottoman": False}
        (warning,) = answer["warnings"]
        assert (warning.code, warning.objects) == ("not-judged", ["ottoman_1"])


def test_a_word_tells_the_room_type() -> None:
    artifact = open_artifact("triway", "ottoman")
    scene = Scene(objects(artifact, "bed", "ottoman"))
    p = {one["room_type"]: one["probability"] for one in rooms(artifact, scene)["room_types"]}
    assert sum(p.values()) == pytest.approx(1, abs=1e-5)
    without = rooms(artifact, Scene(objects(artifact, "bed")))["room_types"]
    assert p != {one["room_type"]: one["probability"] for one in without}


SHAPES = ("b", "kappa", "Y")


def words(*names: str) -> list[Word]:
    found = [CLASSES.meaning(name) for name in names]
    assert None not in found
    return found


def by_class(weights, name: str) -> np.ndarray:
    return weights[name] if name == "W" else weights[name].T


@pytest.fixture
def weights(variant):
    return larger_artifact(variant).weights


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


def test_a_model_keeps_few_models_with_words() -> None:
    artifact = larger_artifact("triway")
    assert artifact.with_words([]) is artifact
    one = artifact.with_words(words("ottoman"))
    assert artifact.with_words(words("ottoman")) is one
    assert one.vocabulary.labels == (*LABELS, "ottoman")
    for name in ("mug", "spoon", "tractor", "ladder"):
        artifact.with_words(words(name))
    assert artifact.with_words(words("ottoman")) is not one
    assert len(artifact._with_words) <= 4
