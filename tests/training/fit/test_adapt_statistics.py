import numpy as np
import pytest

from app import questions
from app.model import SceneModel
from app.registry import Store
from app.scene.spatial_relations import ON_TOP
from tests.training.scenes import request
from training.fit.adapt_statistics import LEAST, Numbers, with_numbers, with_places

ROOM = ("dining table", "chair", "lamp", "picture")


@pytest.fixture(scope="module")
def model(repository) -> SceneModel:
    store = Store(repository / "model_store")
    return store.load(*store.resolve("default")).model


def shown(model: SceneModel, chairs: int, scenes: int) -> list[Numbers]:
    classes = np.array(sorted(model.vocabulary.index(x) for x in ROOM))
    instances = np.where(classes == model.vocabulary.index("chair"), chairs, 1)
    return [Numbers(classes, instances, model.vocabulary.room_index("dining room"))] * scenes


def more_chairs(model: SceneModel, listed: int) -> float:
    """The probability of a further chair in a dining room."""
    scene = request(model, "dining table", *["chair"] * listed, room="dining room")
    more = questions.missing(model, scene)["more"]
    return next((x["probability"] for x in more if x["label"] == "chair"), 0.0)


def test_the_numbers_of_a_home_become_usual(model):
    adapted, labels = with_numbers(model, shown(model, 2, 15))
    assert labels == ["chair"]
    assert more_chairs(adapted, 2) < 0.7 * more_chairs(model, 2)
    many, _ = with_numbers(model, shown(model, 8, 15))
    assert more_chairs(many, 2) > more_chairs(model, 2)
    # A few scenes, or one chair each, which may be a list of labels, teach nothing.
    for scenes in (shown(model, 8, LEAST - 1), shown(model, 1, 15)):
        assert with_numbers(model, scenes)[1] == []


def test_the_share_is_the_posterior_mean(model):
    """Of a Dirichlet prior around the model's own answer, with the weight of five scenes."""
    scenes = [*shown(model, 6, 4), *shown(model, 3, 2)]
    at = scenes[0].classes.tolist().index(model.vocabulary.index("chair"))

    def answer(side: SceneModel) -> np.ndarray:
        asked = scenes[0].classes, np.ones_like(scenes[0].classes), scenes[0].room
        rows, p = side.counts.distribution(len(side.vocabulary), *asked)
        return p[rows.tolist().index(at)]

    p = answer(model)
    counted = np.zeros_like(p)
    counted[[5, 2]] = 4, 2
    adapted, _ = with_numbers(model, scenes)
    assert answer(adapted) == pytest.approx((counted + 5 * p) / 11, rel=0.02)
    # At most 20 scenes count.
    many, _ = with_numbers(model, scenes * 100)
    assert answer(many) == pytest.approx((counted * 20 / 6 + 5 * p) / 25, rel=0.02)


def test_a_repeated_place_becomes_usual(model):
    words = model.vocabulary
    book, fridge = words.index("book"), words.index("fridge")

    def at_fridge(side: SceneModel) -> float:
        return float(side.places.log_ratio(ON_TOP, fridge, outgoing=True)[book])

    triple = (ON_TOP, book, fridge)
    few, many = (with_places(model, (), {triple: n}) for n in (3, 15))
    assert at_fridge(model) < at_fridge(few) < at_fridge(many)
    assert at_fridge(with_places(model, (), {triple: 900})) == pytest.approx(
        at_fridge(with_places(model, {triple}, {}))
    )
    assert many.calibration.misplaced.confirmed == model.calibration.misplaced.confirmed
