"""What the shipped store promises: which models, how large, how quickly loaded, which words."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from app.registry import Artifact, Store, load_model_set
from training.runs.config_files import load_config

STORE = Store(Path(__file__).resolve().parents[2] / "model_store")
SHIPPED = [
    "indoor-gbm",
    "indoor-rbm",
    "indoor-triway",
    "indoor-triway-deep",
    "open-triway",
]


@pytest.fixture(scope="module")
def models():
    return load_model_set(STORE)


@pytest.fixture(params=SHIPPED)
def artifact(request, models) -> Artifact:
    found = models.resolve(request.param)
    assert isinstance(found, Artifact)
    return found


def test_every_shipped_model_verifies(models):
    assert not models.failures
    assert sorted({name for name, _ in models.entries}) == SHIPPED


def test_the_terms_of_each_model_are_those_of_its_data(artifact):
    text = (STORE.root / "TERMS.md").read_text()
    rows = dict(re.findall(r"^\| `([\w-]+)` \| ([^|]+) \|", text, re.MULTILINE))
    assert sorted(rows) == SHIPPED
    restricted = any(source.research_only for source in artifact.manifest.data)
    assert (rows[artifact.manifest.name].strip() == "research only") == restricted


def test_an_artifact_is_small(artifact):
    size = sum(path.stat().st_size for path in artifact.path.iterdir())
    assert size <= 12_000_000


def test_structure_has_no_object_weights(artifact):
    """So listing it changes no answer about other classes."""
    structure = artifact.vocabulary.structure
    assert structure.any()
    assert not artifact.weights["W"][structure].any()
    if artifact.spec.coupled:
        assert not artifact.weights["L"][structure].any()


def test_the_indoor_vocabulary_is_large_enough(artifact):
    if not artifact.manifest.name.startswith("indoor"):
        return
    assert len(artifact.vocabulary) >= 417
    for words in ("TV", "garbage_bin", "trash cans", "night stand", "refrigerator"):
        assert artifact.vocabulary.index(words) is not None


def test_the_examples_of_its_configuration_fit_its_vocabulary(artifact):
    from training.runs.example_scenes import known_examples, read_examples

    examples = read_examples(load_config(artifact.manifest.name).examples, Path())
    assert examples
    assert known_examples(examples, artifact.vocabulary) == (examples, [])
