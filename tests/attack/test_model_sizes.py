"""A small file of a large machine: the arrays that the service derives from it are bounded."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.inference import MachineSpec, Weights
from app.inference.chains import MOST_DRAWN, Conditions
from app.inference.relation_units import SharedUnits
from app.inference.weights import layout
from app.model import Calibration, SceneModel, derived_bytes
from app.questions.missing import missing
from app.questions.relations import relations
from app.questions.rooms import rooms
from app.registry import Store, VocabularyEntry, load_model_set
from app.registry.artifact import MAX_DERIVED_BYTES, write_artifact
from app.scene.scene import Scene
from app.scene.vocabulary import ObjectClass, Vocabulary, Word
from app.scene.words import word_vectors
from app.serving.models import warm_up
from tests.attack.test_store import at_most
from tests.registry.small_artifacts import description, publish_as, state

SMALL = {"variant": "triway", "V": 4, "A": 5, "units": 2, "C": 2, "K": 1}


def machine(**sizes: Any) -> Weights:
    """A machine with random weights, so about half of its classes are in a drawn scene."""
    spec, rng = MachineSpec.from_dict(SMALL | sizes), np.random.default_rng(0)
    arrays = {
        name: rng.normal(size=shape).astype(np.float32) if kind is float
        else np.zeros(shape, np.int32)
        for name, (kind, shape) in layout(spec).items()
    }  # fmt: skip
    return Weights(spec, arrays)


def letters(number: int) -> str:
    return "x" + "".join("abcdefghij"[int(digit)] for digit in f"{number:05}")


def vocabulary(spec: MachineSpec, *, deep: bool = False) -> Vocabulary:
    """Classes with word vectors. If deep, each class is broader than the next one."""
    known = [word for word in word_vectors().words if len(word) > 3 and word.isalpha()]
    names = [f"{word} {letters(k)}" for k, word in enumerate(known[: spec.V])]
    parents = [None, *names] if deep else [None] * spec.V
    entries = [ObjectClass(name, parent=parents[k]) for k, name in enumerate(names)]
    return Vocabulary(entries, [letters(k) for k in range(spec.C)])


def refused(root: Path, weights: Weights) -> str:
    """Write a version past the checks of publishing. Return why the service refuses it."""
    store, spec = Store(root), weights.spec
    publish_as(store, "default", description("healthy"), state())
    folder = root / "hostile" / "2.0.0"
    folder.parent.mkdir()
    entry = VocabularyEntry.of(vocabulary(spec))
    described = description("hostile", "2.0.0", spec=spec.to_dict(), vocabulary=entry)
    write_artifact(folder, described, weights.arrays, storage_dtype="float16")
    assert sum(file.stat().st_size for file in folder.iterdir()) < 2 * 2**20
    with at_most(64):
        models = load_model_set(store, check=warm_up)
    models.resolve("default")
    (failure,) = models.failures.values()
    assert failure.reason.isprintable()
    return f"{failure.code}: {failure.reason}"


@pytest.mark.parametrize("sizes", [{"V": 4_000}, {"units": 5000}, {"N": 250_000}, {"K": 4000}])
def test_large_machines_are_refused(tmp_path: Path, sizes: dict[str, int]) -> None:
    weights = machine(**sizes)
    reason = refused(tmp_path / "store", weights)
    assert reason.startswith("too_large: ")
    assert f"{derived_bytes(weights.spec)} bytes" in reason
    assert f"{MAX_DERIVED_BYTES} bytes" in reason


def test_crowded_scenes_are_refused(tmp_path: Path) -> None:
    reason = refused(tmp_path / "store", machine(V=4 * MOST_DRAWN))
    assert reason.startswith("warm_up_failed: the model draws ")
    assert f"maximum of {MOST_DRAWN}" in reason


def test_broader_classes_are_bounded() -> None:
    with pytest.raises(ValueError, match="more than 16 broader classes"):
        vocabulary(MachineSpec.from_dict(SMALL | {"V": 18}), deep=True)
    vocabulary(MachineSpec.from_dict(SMALL | {"V": 17}), deep=True)


def derive(model: SceneModel) -> None:
    """Compute all arrays whose size is a product of two sizes of a machine."""
    spec, words = model.spec, model.vocabulary
    assert words.related.shape == (spec.V, spec.V)
    for index in range(spec.V):
        model.objects.increases(index)
    # At most half of the classes are listed. The others are candidates.
    listed = np.arange(min(spec.V // 2, 256))
    scene = Scene(words.bare_objects([words.labels[k] for k in listed]) or ())
    missing(model, scene, top_k=spec.V)
    relations(model, scene)
    rooms(model, scene)
    if spec.N:
        model.scene_chains.sample_weights(Conditions(listed, None))
    vector = word_vectors().of("lamp")
    assert vector is not None
    for k in range(6):
        larger = model.with_words([Word(letters(k), vector, 0, 0.5)])
        assert larger.vocabulary.related.shape == (spec.V + 1, spec.V + 1)


def model_of(**sizes: Any) -> SceneModel:
    weights = machine(**sizes)
    return SceneModel(weights, vocabulary(weights.spec), Calibration.neutral(5))


PRODUCTS = [
    {"V": 1000},
    {"V": 800, "coupled": True},
    {"V": 400, "C": 3000},
    {"V": 600, "N": 8000},
    {"units": 100, "N": 20_000},
    {"V": 520, "N": 8000},
    {"units": 1200},
    {"V": 40, "units": 40, "states": 8, "K": 80},
    {"V": 520, "K": 64},
    {"V": 520, "C": 100, "profiles": 100},
]


@pytest.mark.parametrize("sizes", PRODUCTS, ids=str)
def test_the_bound_holds(sizes: dict[str, int]) -> None:
    derive(model_of(**{name: size for name, size in sizes.items() if name == "coupled"}))
    model = model_of(**sizes)
    word_vectors().of("lamp")
    of_weights = sum(array.nbytes for array in model.weights.arrays.values())
    with at_most((derived_bytes(model.spec) + 8 * of_weights) // 2**20 + 4):
        derive(model)


def test_placements_are_computed_in_blocks(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes, moments = list[tuple[int, int]](), SharedUnits.moments

    def counted(self: SharedUnits, means: Any, pairs: Any, *rest: Any, **named: Any) -> Any:
        sizes.append((len(means), pairs.i.shape[1]))
        return moments(self, means, pairs, *rest, **named)

    model = model_of(V=600)
    scene = Scene(model.vocabulary.bare_objects(model.vocabulary.labels[:256]) or ())
    monkeypatch.setattr(SharedUnits, "moments", counted)
    answer = missing(model, scene, top_k=600)
    assert len(answer["missing"]) == 344 == sum(means for means, _ in sizes)
    assert all(means * pairs <= 256**2 for means, pairs in sizes)
