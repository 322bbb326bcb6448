from collections.abc import Callable
from dataclasses import replace
from itertools import permutations

import numpy as np
import pytest
from numpy.typing import NDArray

from app.model import Possibility
from app.model.possibility import FEATURES, IN, ON, OVER, UNDER, UNKNOWN, features
from app.scene import ObjectClass, Vocabulary
from app.scene.spatial_relations import ABOVE, INSIDE, LEFT, ON_TOP
from tests.training.evaluation.scenes import scene as encoded
from tests.training.scenes import scene, things
from training.datasets import AnnotatedScene, encode
from training.datasets.inventories import Thing, shipped_things
from training.fit.possibility import denied_pairs, describe, fit_possibility, stated_pairs

RESEARCH = "nr3d"
LABELS = ("cup", "table", "bin", "picture", "fridge")
VOCABULARY = Vocabulary([*map(ObjectClass, LABELS), ObjectClass("floor", structure=True)])
CUP, TABLE, BIN, PICTURE, FRIDGE, FLOOR = range(6)
MISFIT = 2  # feature: how much larger a thing is


def twice(*labels: str, source: str = "test", **fields: object) -> list[AnnotatedScene]:
    return [replace(scene(name, *labels, **fields), source=source) for name in ("one", "two")]


@pytest.mark.parametrize(
    ("stated", "pair"),
    [
        ((CUP, "on-top", TABLE), (ON, CUP, TABLE)),
        ((BIN, "under", TABLE), (UNDER, BIN, TABLE)),
        ((PICTURE, "above", TABLE), (OVER, PICTURE, TABLE)),
        ((TABLE, "below", PICTURE), (OVER, PICTURE, TABLE)),
        ((CUP, "inside", FRIDGE), (IN, CUP, FRIDGE)),
        ((FRIDGE, "contains", CUP), (IN, CUP, FRIDGE)),
    ],
)
def test_words_state_a_place_of_a_thing(stated: tuple, pair: tuple):
    scenes = twice(*LABELS, relations=[stated, stated])
    assert stated_pairs(scenes, VOCABULARY) == {pair: 2}
    # A single scene may be an error, and terms of use may exclude a source.
    assert not stated_pairs(scenes[:1], VOCABULARY)
    excluded = [replace(one, source=RESEARCH) for one in scenes]
    assert not stated_pairs(excluded, VOCABULARY)
    assert not stated_pairs([scenes[0], excluded[1]], VOCABULARY)


def test_sides_structure_equal_classes_and_unknown_labels_state_no_place():
    triples = [(0, "left", 1), (0, "right", 1), (0, "front", 1), (0, "behind", 1)]
    triples += [(0, "on-top", 2), (0, "on-top", 3), (4, "on-top", 1)]
    assert not stated_pairs(
        twice("cup", "table", "floor", "cup", "x", relations=triples), VOCABULARY
    )


@pytest.mark.parametrize(("bottom", "place"), [(0.7, ON), (0.66, ON), (0.64, IN), (0.1, IN)])
def test_a_support_link_is_on_or_deep_in_the_support(bottom: float, place: int):
    """The top of the table is at .7 m, and boxes touch down to 5 cm below it."""
    boxes = {
        "position": [(0.0, 0.0, bottom + 0.05), (0.0, 0.0, 0.35)],
        "size": [(0.1, 0.1, 0.1), (1.0, 1.0, 0.7)],
        "supported_by": ["1", None],
    }
    assert stated_pairs(twice("cup", "table", **boxes), VOCABULARY) == {(place, CUP, TABLE): 2}


def test_a_support_link_without_boxes_is_on_its_support():
    scenes = twice("cup", "table", supported_by=["1", "1"])  # the table has itself as its support
    assert stated_pairs(scenes, VOCABULARY) == {(ON, CUP, TABLE): 2}


def test_denied_are_stacked_relations_that_are_observed_not_to_hold():
    shown = encoded([CUP, TABLE], [(ON_TOP, CUP, TABLE), (LEFT, TABLE, CUP)])
    stacks = {(a, i, j) for a in (ON_TOP, ABOVE, INSIDE) for i, j in permutations((CUP, TABLE))}
    denied = dict.fromkeys(stacks - {(ON_TOP, CUP, TABLE)}, 1)
    assert denied_pairs([shown], VOCABULARY) == denied
    others = [
        replace(shown, source=RESEARCH),
        encoded([CUP, TABLE], annotated=False),
        encoded([CUP, CUP]),
    ]
    assert denied_pairs([shown, *others], VOCABULARY) == denied
    assert denied_pairs([shown, shown], VOCABULARY) == dict.fromkeys(denied, 2)
    assert not denied_pairs([], VOCABULARY)


def test_descriptions_come_from_the_label_another_name_or_the_parent():
    lamp, tray = thing("lamp", stands={"surface": 0.5, "wall": 0.5}, large=3.0), thing("tray")
    tray = replace(tray, other_names=("Platter",), container="sometimes", carried="hands")
    words = Vocabulary(
        [
            *(
                ObjectClass("desk lamp", parent="table lamp"),
                ObjectClass("table lamp", parent="lamp"),
            ),
            *(ObjectClass("lamp"), ObjectClass("platter"), ObjectClass("gizmo", ("tray",))),
            *(ObjectClass("thing"), ObjectClass("kind of thing", parent="thing")),
        ]
    )
    prior = describe(words, {"lamp": lamp, "tray": tray}, np.zeros((4, FEATURES)))
    assert prior.is_described.tolist() == [True] * 5 + [False] * 2
    half = [0, 0.5, 0, 0.5, 0]
    expected = [half, half, half, [0, 0, 0, 1, 0], [0, 0, 0, 1, 0], [0.2] * 5, [0.2] * 5]
    np.testing.assert_allclose(prior.stands, expected, rtol=1e-6)
    assert prior.traits[3:6].tolist() == [[1, 0.5, 1], [1, 0.5, 1], [UNKNOWN] * 3]
    # A large thing is larger than 90 % of all. The spread has a lower bound.
    spreads = [np.log(3) / 1.28] * 3 + [max(np.log(1.2) / 1.28, 0.1)] * 2 + [0.25] * 2
    np.testing.assert_allclose(prior.spread, spreads, rtol=1e-6)
    prior.check(A=5, V=len(words), C=0)


# ----------------------------------------------------------------- a world of forty kinds of things

N = 40
WORLD = Vocabulary([ObjectClass(f"kind {k}", size=(0.05 * (k + 1),) * 3) for k in range(N)])


def thing(label: str, **fields: object) -> Thing:
    values = {
        "label": label,
        "size": (0.1, 0.1, 0.1),
        "large": 1.2,
        "stands": {"surface": 1.0},
        "surface": "yes",
        "container": "no",
        "carried": "hand",
        "parent": "",
        "other_names": (),
    }
    return Thing(**(values | fields))


def varied(seed: int) -> dict[str, Thing]:
    """Things of every level of each feature. The size grows with the index."""
    rng, found = np.random.default_rng(seed), {}
    for k, label in enumerate(WORLD.labels):
        share = float(rng.uniform(0.1, 0.9))
        levels = {
            name: str(rng.choice(["no", "sometimes", "yes"])) for name in ("surface", "container")
        }
        found[label] = thing(
            label,
            size=(0.05 * (k + 1),) * 3,
            stands={"surface": share, "floor": 1 - share},
            carried=str(rng.choice(["hand", "hands", "people", "no"])),
            **levels,
        )
    return found


def world(
    described: dict[str, Thing], is_possible: Callable[[NDArray], NDArray], relation: str = "on-top"
) -> list[AnnotatedScene]:
    """Two scenes of all things. `is_possible` chooses the stated pairs by their features."""
    pairs = np.array([*permutations(range(N), 2)])
    prior = describe(WORLD, described, np.zeros((4, FEATURES)))
    rows = (prior.rows(of, WORLD.sizes[of]) for of in pairs.T)
    chosen = pairs[is_possible(features(ON, *rows))].tolist()
    triples = [(i, relation, j) for i, j in chosen if relation == "inside" or [j, i] not in chosen]
    return twice(*WORLD.labels, relations=triples)


def fitted(described: dict[str, Thing], scenes: list[AnnotatedScene]) -> Possibility:
    prior = fit_possibility(scenes, encode(scenes, WORLD), WORLD, described)
    assert prior is not None
    prior.check(A=5, V=N, C=0)
    return prior


def test_the_fit_finds_the_feature_that_decides():
    described = varied(0)
    prior = fitted(described, world(described, lambda phi: phi[:, MISFIT] <= 0))
    assert prior.weights[ON, MISFIT] > 3
    assert (np.delete(prior.weights[ON], MISFIT) < 1).all()
    index = np.arange(N)
    rows = prior.rows(index, WORLD.sizes)
    c = prior.log_p(rows, rows)[ON]
    smaller = index[:, None] < index
    assert np.mean(c[smaller][:, None] > c[smaller.T]) > 0.95


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("feature", range(FEATURES))
def test_no_feature_makes_a_place_more_possible(seed: int, feature: int):
    """Things stand where this feature speaks against it, so it must be left out."""
    described = varied(seed)
    prior = fitted(
        described, world(described, lambda phi: phi[:, feature] > np.median(phi[:, feature]))
    )
    assert prior.weights[ON, feature] == 0
    assert (prior.weights >= 0).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_world_against_all_features_has_no_prior(seed: int):
    described = varied(seed)
    prior = fitted(described, world(described, lambda phi: phi.sum(1) > np.median(phi.sum(1))))
    assert (prior.weights[ON] >= 0).all()
    # No scene shows anything at the other places.
    assert not prior.weights[[UNDER, OVER, IN]].any()


def test_places_without_described_examples_have_no_weights():
    """Three things without a description are inside each other."""
    described = varied(0)
    few = dict([*described.items()][:-3])
    scenes = world(described, lambda phi: phi[:, MISFIT] <= 0)
    inside = ((N - 3, "inside", N - 1), (N - 2, "inside", N - 1))
    last = [t for t in scenes[0].relations if {t[0], t[2]} <= {N - 3, N - 2, N - 1}]
    kept = [t for t in scenes[0].relations if t not in last]
    scenes = [replace(one, relations=(*kept, *inside)) for one in scenes]
    prior = fitted(few, scenes)
    assert prior.weights[ON, MISFIT] > 3
    assert not prior.weights[IN].any()


# ------------------------------------------------------------------------------- few own scenes


def own(*labels: str) -> tuple[Vocabulary, Possibility | None]:
    words = Vocabulary([ObjectClass(label) for label in labels])
    scenes = twice(*labels, relations=[(0, "on-top", 1)])
    return words, fit_possibility(scenes, encode(scenes, words), words, shipped_things())


def test_few_scenes_have_the_sense_of_the_written_places():
    labels = ("cup", "table", "cat", "oven", "pan", "gizmo", "bed", "bin", "nightstand")
    words, prior = own(*labels)
    assert prior is not None
    sizes = np.array([shipped_things()[x].size if x in shipped_things() else [np.nan] * 3 for x in
                      (*labels[:5], "cup", "bed", "garbage bin", "nightstand")])  # fmt: skip
    rows = prior.rows(np.arange(len(labels)), sizes)
    c = prior.log_p(rows, rows)

    def of(place: int, i: str, j: str) -> float:
        return float(c[place, words.index(i), words.index(j)])

    assert of(ON, "cup", "table") > of(ON, "table", "cup") + 3
    assert of(ON, "cup", "nightstand") > of(ON, "nightstand", "bed") + 1
    assert of(IN, "pan", "oven") > of(IN, "cat", "oven") + 1
    assert of(UNDER, "cat", "bed") > of(UNDER, "bed", "cat") + 3
    assert not c[:, words.index("gizmo")].any()
    assert not c[:, :, words.index("gizmo")].any()
    assert (prior.weights >= 0).all()
    assert (prior.weights[:, [0, 3]] > 0).all()


def test_the_written_weights_do_not_depend_on_the_own_classes():
    (_, first), (_, second) = own("cup", "table"), own("fridge", "floor lamp", "gizmo")
    assert first is not None
    assert second is not None
    assert (first.weights == second.weights).all()


def test_classes_without_any_description_have_no_prior():
    assert own("gizmo", "doohickey")[1] is None


def test_enough_scenes_have_weights_of_their_own():
    """200 pairs suffice. With 199, the weights are those of the written places."""
    _, written = own("cup", "table")
    described = varied(0)
    scenes = world(described, lambda phi: phi[:, MISFIT] <= 0)
    for count, is_own in ((200, True), (199, False)):
        some = [replace(one, relations=one.relations[:count]) for one in scenes]
        weights = fitted(described, some).weights
        assert (weights != written.weights).any() == is_own


def test_things_of_lists_alone_are_no_surprise():
    """Without relations and boxes, no pair is possible, and none is impossible."""
    bare = [AnnotatedScene("s", "test", "g", None, things("cup", "table"))]
    assert not stated_pairs(bare, VOCABULARY)
    assert not denied_pairs(encode(bare, VOCABULARY), VOCABULARY)
