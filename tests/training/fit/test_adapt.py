from dataclasses import replace

import numpy as np
import pytest
import torch

from app import questions
from app.inference import MachineSpec, Weights
from app.model import Possibility, SceneModel
from app.model.possibility import UNKNOWN
from app.registry import Store
from app.scene import ObjectClass
from tests.questions.artifacts import larger_artifact
from tests.training.scenes import request
from training.fit.adapt import HomeScenes, TrainedOn, adapt, extended
from training.machines import build, machine_of, weights_of

V, C = 12, 3


def small(variant: str = "triway", **sizes: int) -> Weights:
    """A small machine with random weights and stored samples."""
    sizes = {"K": 2 if variant == "triway" else 0, "coupled": variant == "triway"} | sizes
    spec = MachineSpec(variant, V=V, A=5, units=3, states=3, C=C, N=40, profiles=2, **sizes)
    generator = torch.Generator().manual_seed(0)
    machine = build(spec).initialise(generator, 0.5)
    with torch.no_grad():
        machine.b.fill_(-1.0)
        machine.fantasies.copy_(torch.randint(1, 2**V, (40, 1), generator=generator).int())
    return weights_of(machine)


def scenes_of(*classes: list[int], rooms: list[int] | None = None, size: int = V) -> HomeScenes:
    v = torch.zeros(len(classes), size)
    for row, present in zip(v, classes, strict=True):
        row[present] = 1
    observed = torch.ones(len(classes), size, dtype=torch.bool)
    rooms_of = torch.tensor(rooms or [-1] * len(classes))
    return HomeScenes(v, observed, rooms_of, torch.ones(len(classes)))


def probabilities(weights: Weights, *listed: int) -> torch.Tensor:
    """(V,), of each class beside the listed ones."""
    v = torch.zeros(1, V)
    v[0, list(listed)] = 1
    return machine_of(weights).object_log_odds(v).sigmoid()[0]


HOME = [[0, 1, 2], [0, 1, 3], [0, 1, 2, 3], [0, 1]] * 6


@pytest.mark.parametrize("variant", ["rbm", "gbm", "triway"])
def test_the_home_becomes_likelier_and_other_classes_keep_their_weights(variant):
    parent, home = small(variant), scenes_of(*HOME)
    weights = adapt(parent, home)
    rest = np.setdiff1d(np.arange(V), [0, 1, 2, 3])
    np.testing.assert_array_equal(weights["W"][rest], parent["W"][rest])
    changed = [name for name in parent.arrays if not np.array_equal(weights[name], parent[name])]
    assert sorted(changed) == ["W", "b"]
    before, after = (probabilities(side, 0) for side in (parent, weights))
    assert after[1] > before[1] + 0.2
    assert (after[rest] < before[rest] + 0.02).all()


def test_the_same_seed_gives_the_same_weights():
    parent, home = small(), scenes_of(*HOME)
    first, again, other = (adapt(parent, home, seed=seed) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first["W"], again["W"])
    assert not np.array_equal(first["W"], other["W"])


def test_a_class_that_is_left_out_keeps_its_log_odds():
    """Class 5 is neither present nor absent in the scenes, so its bias has no reason to fall."""
    parent, home = small(), scenes_of(*HOME)
    observed = home.observed.clone()
    observed[:, 5] = False
    shift = [
        float(adapt(parent, replace(home, observed=mask))["b"][5] - parent["b"][5])
        for mask in (home.observed, observed)
    ]
    assert shift[0] < -0.1
    assert abs(shift[1]) < 0.5 * abs(shift[0])


def test_more_scenes_without_a_class_make_it_less_likely():
    """The target is the answer of the parent over 1 + the expected number of its scenes."""
    parent = small()
    sides = parent, *(adapt(parent, scenes_of(*HOME[:n])) for n in (2, 24))
    before, few, many = (float(probabilities(side, 0)[5]) for side in sides)
    assert few > 0.9 * before
    assert many < 0.8 * before


def test_a_class_that_the_parent_hardly_knows_is_learnt_from_few_scenes():
    """Class 3 is in half of the scenes. A strong prior would keep it improbable."""
    weights = small().arrays
    weights["b"] = weights["b"].copy()
    weights["b"][3] = -10
    parent, home = Weights(small().spec, weights), scenes_of(*HOME)
    trained_on = TrainedOn(torch.arange(V) != 3, C)
    rare, common = (
        float(probabilities(adapt(parent, home, trained_on=x), 0, 1)[3]) for x in (trained_on, None)
    )
    assert common < 0.2
    assert 0.3 < rare < 0.7


def test_unrecorded_classes_change_by_their_bias_alone():
    """Otherwise the home would raise alarms about harmless things that it has not seen yet."""
    parent = small()
    home = adapt(parent, scenes_of(*HOME))
    rest, listed = np.setdiff1d(np.arange(V), [0, 1, 2, 3]), torch.eye(V)[[0, 1]].sum(0, True)
    before, after = (machine_of(side).object_log_odds(listed)[0] for side in (parent, home))
    bias = torch.from_numpy(home["b"] - parent["b"])[rest]
    assert bias.min() < -0.3
    assert (after - before)[rest] == pytest.approx(bias.numpy(), abs=0.4)


def test_a_habit_of_a_room_type_is_learnt_there():
    """The home has class 4 in most rooms of type 0, and the parent expects it in few rooms."""
    weights = small().arrays
    weights["b"] = weights["b"].copy()
    weights["b"][4] = -6
    weights["fantasy_rooms"] = (np.arange(40) % C).astype(np.int32)
    parent = Weights(small().spec, weights)
    home = [[0, 1, 4], [0, 2, 4], [0, 1, 2], [1, 2], [2, 3], [1, 3]] * 4
    adapted = adapt(parent, scenes_of(*home, rooms=[0, 0, 0, 1, 1, 1] * 4))
    listed, rooms = torch.eye(V)[[0, 0]], torch.tensor([0, 1])
    p = machine_of(adapted).object_log_odds(listed, room=rooms)[:, 4].sigmoid()
    assert p[0] > 0.25
    assert p[1] < 0.5 * p[0]
    names = [name for name in parent.arrays if not np.array_equal(adapted[name], parent[name])]
    assert sorted(names) == ["W", "Y", "b"]


def test_a_home_without_pairs_or_a_model_without_samples_is_refused():
    with pytest.raises(ValueError, match="two known objects"):
        adapt(small(), scenes_of([0], [1]))
    spec = replace(small().spec, N=0)
    arrays = {k: x for k, x in small().arrays.items() if not k.startswith("fantas")}
    with pytest.raises(ValueError, match="no samples"):
        adapt(Weights(spec, arrays), scenes_of([0, 1]))


@pytest.fixture(scope="module", params=["places-rbm", "places-triway"])
def model(request, repository) -> SceneModel:
    store = Store(repository / "model_store")
    return store.load(*store.resolve(request.param)).model


NEW = [ObjectClass("stairlift"), ObjectClass("oxygen concentrator")]


def test_known_objects_get_the_same_answers_beside_new_classes(model):
    larger = extended(model, NEW, ["darkroom"])
    labels = ["bed", "nightstand", "lamp", "pillow", "oven"]
    for room in (None, "bedroom"):
        asked = [(side, request(side, *labels, room=room)) for side in (model, larger)]
        for question, options, key in (
            (questions.relations, {"top_k": 50}, "relations"),
            (questions.outliers, {}, "outliers"),
            (questions.missing, {"top_k": 20}, "missing"),
        ):
            before, after = (question(*each, **options)[key] for each in asked)
            assert [_close(x) for x in before] == [_close(x) for x in after]
    before, after = (questions.rooms(s, request(s, *labels), top_k=3) for s in (model, larger))
    assert [x["room_type"] for x in before["room_types"]] == [
        x["room_type"] for x in after["room_types"]
    ]


def with_prior() -> SceneModel:
    """A model with random weights and a prior of strong weights. The vase has no description."""
    model = larger_artifact("triway-states")
    generator = np.random.default_rng(0)
    traits = np.column_stack([generator.choice([0, 0.5, 1], (9, 2)), generator.choice(4, 9)])
    traits[model.vocabulary.index("vase")] = UNKNOWN
    prior = Possibility(
        stands=generator.dirichlet(np.ones(5), 9).astype(np.float32),
        traits=traits.astype(np.float32),
        spread=generator.uniform(0.1, 0.5, 9).astype(np.float32),
        weights=generator.uniform(1, 3, (4, 4)).astype(np.float32),
    )
    objects = [replace(entry, size=(0.2 * (k + 1),) * 3) for k, entry in
               enumerate(model.vocabulary.objects)]  # fmt: skip
    vocabulary = replace(model.vocabulary, objects=tuple(objects))
    return replace(model, vocabulary=vocabulary, possibility=prior)


def test_new_classes_keep_the_prior_of_the_others():
    model = with_prior()
    larger = extended(model, NEW, ["darkroom"])
    assert larger.possibility is not None
    larger.possibility.check(A=5, V=11, C=3)
    index = np.arange(11)
    rows = larger.descriptions
    c, old = larger.possibility.log_p(rows, rows), model.descriptions
    np.testing.assert_array_equal(c[:, :9, :9], model.possibility.log_p(old, old))
    assert not larger.possibility.is_described[9:].any()
    assert not c[:, 9:].any()
    assert not c[:, :, 9:].any()
    assert larger.spread[index[9:]] == pytest.approx(np.median(model.spread))
    labels = ["bed", "lamp", "vase", "desk"]
    before, after = (
        questions.relations(side, request(side, *labels), top_k=100)["relations"]
        for side in (model, larger)
    )
    assert [_close(x) for x in before] == [_close(x) for x in after]
    # Without the prior, the answers differ.
    bare = extended(replace(model, possibility=None), NEW, ["darkroom"])
    without = questions.relations(bare, request(bare, *labels), top_k=100)["relations"]
    assert [_close(x) for x in without] != [_close(x) for x in after]


def test_relations_of_a_new_class_have_no_prior():
    """The logits of a pair with a new class are those of a model without the prior."""
    model = with_prior()
    sides = [extended(side, NEW, []) for side in (model, replace(model, possibility=None))]
    p = [
        {
            (x["subject"], x["relation"], x["object"]): x["probability"]
            for x in questions.relations(side, request(side, "stairlift", "lamp"), top_k=100)[
                "relations"
            ]
        }
        for side in sides
    ]
    assert p[0] == pytest.approx(p[1])


def _close(value: object) -> object:
    if isinstance(value, float):
        return round(value, 3)
    if isinstance(value, dict):
        return {key: _close(entry) for key, entry in value.items()}
    return [_close(entry) for entry in value] if isinstance(value, list) else value


def test_a_new_class_is_rare_and_has_relations(model):
    larger = extended(model, NEW, ["darkroom"])
    seen = request(larger, "stairlift", "lamp", room="darkroom")
    found = questions.relations(larger, seen, top_k=10)["relations"]
    assert {entry["subject"] for entry in found} == {"stairlift", "lamp"}
    ranked = questions.missing(larger, request(larger, "bed"), top_k=len(larger.vocabulary))
    p = {entry["label"]: entry["probability"] for entry in ranked["missing"]}
    assert p["stairlift"] < 0.01


def test_a_new_room_is_recognised_by_its_objects(repository):
    store = Store(repository / "model_store")
    model = store.load(*store.resolve("default")).model
    larger = extended(model, (), ["darkroom"])
    words = larger.vocabulary
    room = words.room_index("darkroom")
    lists = [["deck chair", "flower pot", "watering can"], ["deck chair", "clothespin", "plant"]]
    classes = [[words.index(label) for label in labels] for labels in lists * 10]
    home = scenes_of(*classes, rooms=[room] * 20, size=len(words))
    trained_on = TrainedOn(
        torch.ones(len(words), dtype=torch.bool), len(model.vocabulary.room_types)
    )
    adapted = replace(larger, weights=adapt(larger.weights, home, trained_on=trained_on))
    answer = questions.rooms(adapted, request(adapted, "deck chair", "flower pot"), top_k=1)
    assert answer["room_types"][0]["room_type"] == "darkroom"
    answer = questions.rooms(adapted, request(adapted, "bed", "nightstand"), top_k=1)
    assert answer["room_types"][0]["room_type"] == "bedroom"
