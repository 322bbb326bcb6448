from collections import Counter

import numpy as np
import pytest

from app.scene import ObjectClass, Vocabulary, label_key
from tests.training.scenes import scene
from training.datasets import AnnotatedScene, source_vocabulary
from training.datasets.vocabulary import (
    INDOOR_FILE,
    MINIMUM_MENTIONS,
    Names,
    build_vocabulary,
    coverage,
    curated_names,
    read_vocabulary,
    with_room_aliases,
    with_typical_sizes,
)

NAMES = Names(
    base=("chair", "throne"),
    structure=("wall",),
    not_objects=("space",),
    surroundings=("sky",),
    aliases={"sofa": ("couch",), "wall": ("partition wall",)},
    rooms={"bathroom": ("toilet",), "": ("room",)},
)


def scenes(*labels: str, room: str | None = None, times: int = 1) -> list[AnnotatedScene]:
    return [scene(f"s{k}", *labels, room=room) for k in range(times)]


def test_labels_are_pooled_under_their_curated_names() -> None:
    found = build_vocabulary(
        scenes("couch", "Sofas", "tea_pot", "Teapot", "teapot", "lamp"), NAMES, minimum=2
    )
    assert found.labels == ("teapot", "sofa", "chair", "throne")
    assert found.index("COUCH") == found.index("sofa") == 1
    assert found.index("lamp") is None


def test_some_labels_become_no_class() -> None:
    several = scenes("space", "sky", "truck", "wall", "walls", "partition wall")
    found = build_vocabulary(several, NAMES, minimum=1)
    assert found.labels == ("wall", "sky", "truck", "chair", "throne")
    assert found.structure.tolist() == [True, True, False, False, False]


def test_rooms_have_one_spelling() -> None:
    rooms = "bed_room", "Bed Room", "toilet", "bathroom", "attic", *["room"] * 3, *[None] * 3
    several = [scene(str(k), "chair", room=room) for k, room in enumerate(rooms)]
    assert build_vocabulary(several, NAMES, minimum=2).room_types == ("bathroom", "bed room")


def test_a_source_vocabulary_has_the_classes_of_the_source() -> None:
    found = source_vocabulary(scenes("television", "sky", "wall", times=MINIMUM_MENTIONS))
    assert sorted(found.labels) == ["sky", "tv", "wall"]
    assert found.index("TV") is not None
    assert found.structure[found.index("wall")]


def test_kinds_without_a_class_are_aliases_of_the_broader_class() -> None:
    found = source_vocabulary(scenes("bag", "side table", "table", times=MINIMUM_MENTIONS))
    assert found.labels == ("bag", "side table", "table")
    for name in ("purse", "handbag", "backpack"):
        assert found.labels[found.index(name) or 0] == "bag"
    assert found.index("coffee table") == found.index("couch table") == found.index("table")
    assert found.index("side table") != found.index("table")
    assert found.parents.tolist() == [-1, found.index("table"), -1]
    assert found.anywhere.tolist() == [True, False, False]
    # Indoors the kinds are classes, or are not understood.
    indoors = build_vocabulary(scenes("bag"), curated_names(), minimum=1)
    assert indoors.labels[indoors.index("backpack") or 0] == "backpack"


def test_typical_sizes_are_medians_of_square_footprints() -> None:
    vocabulary = build_vocabulary(scenes("chair", "lamp"), Names(), minimum=1)
    boxes = []
    for k in range(1, 6):
        sizes = [(0.2 * k, 0.8 * k, 1.0 * k), (9.0, 9.0, 9.0), None]
        boxes.append(scene(f"s{k}", "Chairs", "throne", "lamp", size=sizes))
    found = with_typical_sizes(vocabulary, boxes)
    assert found.objects[0].size == pytest.approx((1.2, 1.2, 3.0))
    assert found.objects[1].size is None
    assert np.isnan(found.sizes[1]).all()
    # Too few boxes say nothing.
    assert with_typical_sizes(vocabulary, boxes[:4]) == vocabulary


def test_coverage_counts_objects() -> None:
    vocabulary = build_vocabulary(scenes("chair", "wall"), NAMES, minimum=1)
    assert coverage(vocabulary, scenes("chairs", "chair", "wall", "sky")) == 0.75


def test_a_phrase_counts_for_its_head() -> None:
    found = build_vocabulary(scenes("bottle", "book", "jar of jam"), Names(), minimum=1)
    assert found.labels == ("book", "bottle", "jar")


def test_household_classes_need_no_mention() -> None:
    names = Names(household=("hammer", "whisk"), not_objects=("whisk",))
    assert build_vocabulary(scenes("chair"), names, minimum=1).labels == ("chair", "hammer")


@pytest.mark.parametrize("table", ["aliases", "kinds", "rooms"])
def test_each_curated_name_has_one_meaning(table: str) -> None:
    names = curated_names()
    owners = {name: set(others) for name, others in getattr(names, table).items()}
    if table != "kinds":  # a kind can have kinds of its own
        owners = {name: others | {name} for name, others in owners.items()}
    keys = Counter(key for others in owners.values() for key in set(map(label_key, others)))
    assert [key for key, count in keys.items() if key and count > 1] == []


def test_curated_classes_are_no_aliases() -> None:
    names = curated_names()
    kinds = (kind for name, others in names.kinds.items() for kind in (name, *others))
    for name in (*names.base, *names.household, *names.anywhere, *kinds):
        assert names.canonical(name) == name


def test_the_committed_vocabulary_follows_the_curated_names() -> None:
    names, vocabulary = curated_names(), read_vocabulary(INDOOR_FILE)
    assert 700 < len(vocabulary) <= 900
    for label in (*names.base, *names.household):
        index = vocabulary.index(label)
        assert index is not None
        assert vocabulary.labels[index] == label
    for label, aliases in names.aliases.items():
        if (index := vocabulary.index(label)) is not None:
            assert all(vocabulary.index(alias) == index for alias in aliases), label
    structure = {vocabulary.labels[i] for i in np.flatnonzero(vocabulary.structure)}
    assert structure == set(names.structure)
    for entry in vocabulary.objects:
        assert entry.anywhere == (entry.label in names.anywhere)
        assert entry.parent in {names.broader.get(entry.label), None}
    assert set(names.anywhere) <= set(vocabulary.labels)
    assert vocabulary.objects[vocabulary.index("floor lamp")].parent == "lamp"
    for label in names.not_objects:
        assert vocabulary.index(label) is None
    # Ends of relations in photographs, so that they are no structure.
    for label in ("airplane", "van", *names.surroundings):
        assert not vocabulary.structure[vocabulary.index(label)]
    assert all(entry.size is None for entry in vocabulary.objects)
    assert all(names.canonical_room(room) == room for room in vocabulary.room_types)


def test_the_curated_synonyms_of_rooms_are_added() -> None:
    """A synonym that the vocabulary uses as a room type of its own stays a room type."""
    words = Vocabulary([ObjectClass("chair")], ["bathroom", "attic"])
    assert with_room_aliases(words).room_index("toilet") == 0
    both = Vocabulary([ObjectClass("chair")], ["bathroom", "Toilet"])
    assert with_room_aliases(both).room_index("toilet") == 1


@pytest.mark.parametrize(
    ("room", "index"), [("WC", 0), ("Toilet", 1), ("home", None), ("cave", None), (None, None)]
)
def test_room_types_of_scenes_are_read_by_the_vocabulary_first(room, index):
    words = Vocabulary([ObjectClass("chair")], ["bathroom", "toilet"])
    assert curated_names().room_index(room, words) == index
