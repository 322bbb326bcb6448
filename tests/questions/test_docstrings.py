"""The examples in the docstrings of the questions give the answers that they show."""

from doctest import DocTestFinder, DocTestRunner
from importlib import import_module
from pathlib import Path

import pytest

from app import questions
from app.model import SceneModel
from app.registry import Store
from app.scene import RelationTable, Scene
from app.scene.spatial_relations import ON_TOP

FUNCTIONS = [name for name in questions.__all__ if name.islower()]


@pytest.fixture(scope="module")
def model() -> SceneModel:
    store = Store(Path(__file__).parents[2] / "model_store")
    return store.load(*store.resolve("default")).model


@pytest.mark.parametrize("name", FUNCTIONS)
def test_the_example_of_a_question_runs(name: str, model: SceneModel) -> None:
    function = getattr(questions, name)
    names = vars(import_module(function.__module__)) | {"model": model, "Scene": Scene}
    names |= {"RelationTable": RelationTable, "ON_TOP": ON_TOP}
    (example,) = DocTestFinder(recurse=False).find(function, name, globs=names)
    assert example.examples
    assert not DocTestRunner().run(example).failed
