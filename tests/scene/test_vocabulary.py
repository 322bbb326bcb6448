from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.scene.labels import label_key, singular
from app.scene.vocabulary import ObjectClass, Vocabulary
from app.scene.words import WordVectors, class_vectors, word_vectors
from training.fit.configuration import DataConfig
from training.runs.pipeline import read_sources, split_and_encode

VOCABULARY = Vocabulary(
    [
        ObjectClass("garbage bin", ("trash can", "dustbin")),
        ObjectClass("tv", ("television",)),
        ObjectClass("glass", ("wine glass",), parent="glasses"),
        ObjectClass("glasses", ("spectacles",)),
        ObjectClass("curtain", size=(0.3, 0.3, 2.0)),
        ObjectClass("wall", structure=True),
        ObjectClass("dog", anywhere=True),
    ],
    ["bedroom", "living room"],
)


@pytest.mark.parametrize(
    ("label", "expected"),
    [
        ("Trash_Cans", "garbage bin"),
        ("garbage_bin", "garbage bin"),
        ("TV", "tv"),
        ("Televisions", "tv"),
        ("curtains", "curtain"),
        ("glasses", "glasses"),
        ("wine glasses", "glass"),
        ("WALLS", "wall"),
    ],
)
def test_labels_are_found_under_any_spelling(label: str, expected: str) -> None:
    assert VOCABULARY.labels[VOCABULARY.index(label)] == expected


@pytest.mark.parametrize("label", ["", "  ", "sofa", "trash", "can", "curtain rod"])
def test_unknown_labels_are_not_found(label: str) -> None:
    assert VOCABULARY.index(label) is None


def test_rooms_have_synonyms() -> None:
    aliases = {"storage room": ["pantry", "storeroom"]}
    words = Vocabulary([ObjectClass("box")], ["bedroom", "storage room"], aliases)
    assert [words.room_index(name) for name in ("Store Room", "pantry", "storage_room")] == [1] * 3
    assert words.nearest("storerom", is_room=True)[0].entry == 1
    with pytest.raises(ValueError, match="unknown room types"):
        Vocabulary([ObjectClass("box")], ["bedroom"], aliases)
    with pytest.raises(ValueError, match="same name"):
        Vocabulary([ObjectClass("box")], ["pantry", "storage room"], aliases)


def test_masks_and_sizes() -> None:
    assert VOCABULARY.structure.tolist() == [False] * 5 + [True, False]
    assert VOCABULARY.anywhere.tolist() == [False] * 6 + [True]
    assert VOCABULARY.parents.tolist() == [-1, -1, 3, -1, -1, -1, -1]
    assert VOCABULARY.sizes[4].tolist() == [0.3, 0.3, 2.0]
    assert np.isnan(VOCABULARY.sizes[[0, 1, 2, 3, 5, 6]]).all()
    with pytest.raises(ValueError, match="read-only"):
        VOCABULARY.structure[0] = True


def test_two_classes_cannot_share_a_name() -> None:
    with pytest.raises(ValueError, match=r"have the name 'Trash-Cans': 'bin' and 'can'"):
        Vocabulary([ObjectClass("bin", ("trash can",)), ObjectClass("can", ("Trash-Cans",))])
    with pytest.raises(ValueError, match="'bed room' and 'bedroom' have the same name"):
        Vocabulary([ObjectClass("bed")], ["bed room", "bedroom"])
    # An alias that is only another spelling of its own class is harmless.
    assert len(Vocabulary([ObjectClass("book", ("books",))])) == 1


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"label": ""}, "empty name"),
        ({"label": "bed", "aliases": ("_",)}, "empty name"),
        ({"label": "bed", "size": (1, 2)}, "size of 'bed'"),
        ({"label": "bed", "size": (1, 2, -1)}, "size of 'bed'"),
        ({"label": "bed", "size": (1, 2, np.nan)}, "size of 'bed'"),
        ({"label": "bed", "parent": "cot"}, "parent 'cot' of 'bed' is not"),
        ({"label": "bed", "parent": "bed"}, "'bed' is its own ancestor"),
    ],
)
def test_malformed_classes_are_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Vocabulary([ObjectClass(**fields)])


def test_malformed_vocabularies_are_refused() -> None:
    with pytest.raises(ValueError, match="'b' is its own ancestor"):
        Vocabulary([ObjectClass(label, parent=parent) for label, parent in ("ab", "bc", "cb")])
    with pytest.raises(ValueError, match="at least one object class"):
        Vocabulary([])
    with pytest.raises(ValueError, match="room type has an empty name"):
        Vocabulary([ObjectClass("bed")], [""])


PLURALS = """
chairs/chair curtains/curtain sofas/sofa photos/photo tvs/tv boxes/box dishes/dish benches/bench
dresses/dress buses/bus batteries/battery shelves/shelf bookshelves/bookshelf knives/knife
gloves/glove vases/vase cases/case potatoes/potato shoes/shoe ties/tie wineglasses/wineglass
stairs/stair people/person women/woman mice/mouse
"""


@pytest.mark.parametrize("pair", PLURALS.split())
def test_plurals(pair: str) -> None:
    plural, single = pair.split("/")
    assert singular(plural) == singular(single) == single


@pytest.mark.parametrize(
    "word",
    [
        *("glass", "glasses", "sunglasses", "clothes", "scissors", "pants", "jeans", "shorts"),
        *("bus", "mattress", "grass", "dress", "cactus", "tennis", "gas", "canvas", "lens"),
        *("thermos", "chess", "as", "s", ""),
    ],
)
def test_words_that_are_not_plural_stay(word: str) -> None:
    assert singular(word) == word


def test_compatibility_characters_fold() -> None:
    assert label_key("TV") == label_key("ＴＶ") == "tv"
    assert label_key("Straße") == label_key("STRASSE")


@given(st.text(max_size=30), st.sampled_from(["_", " ", "-", ".", "  "]))
def test_keys_ignore_case_and_separators(label: str, separator: str) -> None:
    assert label_key(separator + label + separator) == label_key(label)
    assert label_key(label.casefold()) == label_key(label)


SIMILAR = Vocabulary(
    [
        ObjectClass("fridge", ("refrigerator",)),
        ObjectClass("magnet", ("fridge magnet",)),
        ObjectClass("tree"),
        ObjectClass("bridge"),
        ObjectClass("mug"),
        ObjectClass("chair", ("wooden chair",)),
        ObjectClass("computer chair", ("office chair", "desk chair")),
        ObjectClass("toilet paper", ("toilet paper roll",)),
        ObjectClass("nightstand"),
        ObjectClass("door", structure=True),
        ObjectClass("wall", ("moulding",)),
        ObjectClass("flower", ("vase flower",)),
        ObjectClass("floor"),
        ObjectClass("vase"),
        ObjectClass("cell phone", ("cell",)),
        ObjectClass("toy"),
    ],
    ("bedroom", "living room", "bathroom"),
)


@pytest.mark.parametrize(
    ("label", "expected", "rule"),
    [
        ("fridgee", "fridge", "spelling"),
        ("Refridgerator", "fridge", "spelling"),
        ("nigthstand", "nightstand", "spelling"),
        ("fridge magnett", "magnet", "spelling"),
        ("toiled paper", "toilet paper", "spelling"),  # the other word confirms it
        ("walll", "wall", "spelling"),
        ("the refridgerator_3", "fridge", "spelling"),
        ("coffee mugs", "mug", "head"),
        ("swivel chair", "chair", "head"),
        ("red office chair", "computer chair", "head"),
        ("chair on wheels", "chair", "head"),
        ("vase with sand", "vase", "head"),
        ("a photo of a big chair", "chair", "head"),
        ("toy mug", "toy", "head"),
    ],
)
def test_a_name_is_guessed_by_its_spelling_or_its_last_words(label, expected, rule):
    found = SIMILAR.guess(label)
    assert (SIMILAR.labels[found.entry], found.rule) == (expected, rule)
    assert 0.7 < found.similarity <= 1


@pytest.mark.parametrize(
    "label",
    [
        *("droid", "asdf", "x" * 100, "∞", "mug rack", "chair leg", "tres", "tagnet"),
        "floer",  # two classes are near
        "jail cell",  # another meaning
        "wal",  # a short word can be anything
        *("mug and chair", "vase with flowers"),  # two objects
        " ".join(["refrigeratr", "nigthstand", "wodden", "chairr"] * 2),
    ],
)
def test_an_ambiguous_name_has_no_guess(label: str) -> None:
    assert SIMILAR.guess(label) is None


def test_only_plausible_names_are_suggested_best_first() -> None:
    def suggest(label: str) -> list[str]:
        return [SIMILAR.labels[match.entry] for match in SIMILAR.nearest(label)]

    assert suggest("fridgee") == ["fridge"]
    assert suggest("swivel chair")[0] == "chair"
    assert suggest("droid") == []
    similarities = [match.similarity for match in SIMILAR.nearest("desk chairs x")]
    assert similarities == sorted(similarities, reverse=True)
    assert all(0 <= similarity <= 1 for similarity in similarities)


def test_similar_room_types_are_found() -> None:
    assert [match.entry for match in SIMILAR.nearest("bedrom", is_room=True)] == [0]
    assert SIMILAR.nearest("garage", is_room=True) == ()
    assert SIMILAR.guess("bedrom", is_room=True).entry == 0
    assert SIMILAR.guess("garage", is_room=True) is None


VECTORS = np.array([[4, 0], [0, 2], [0, 0], [3, 3], [3, -4]], dtype=np.int8)
FOUND = WordVectors(("coffee", "table", "zero", "the", "sofa"), VECTORS, 0.5)


def test_vectors_of_words() -> None:
    found = FOUND
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


def test_classes_have_the_mean_vector_of_label_and_aliases() -> None:
    classes = (
        ObjectClass("coffee table"),
        ObjectClass("settee", ("davenport", "sofa", "table")),
        ObjectClass("coffee", ("lectern",)),
        ObjectClass("futon", parent="settee"),
        ObjectClass("lamp"),
    )
    names = [(entry.label, *entry.aliases) for entry in classes]
    vectors, found = class_vectors(FOUND, names, Vocabulary(classes).parents.tolist())
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
    words = dict(zip(scenes.vocabulary.labels, scenes.words, strict=True))
    assert words["sofa"] @ words["armchair"] > words["sofa"] @ words["toilet"] + 0.2
    parents = scenes.training_data().parents
    assert parents.tolist() == scenes.vocabulary.parents.tolist()
    assert (parents >= 0).any()


def test_the_shipped_vectors_tell_similar_words() -> None:
    found = word_vectors()
    assert (len(found.words), found.dimensions) == (41_306, 100)
    assert found.vectors.dtype == np.int8
    sofa, couch, whale = (found.of(word) for word in ("sofa", "couch", "whale"))
    assert sofa @ couch > 0.6 > 0.3 > sofa @ whale
    assert found.of("qwrtzx") is None


@pytest.mark.parametrize("label", ["bed", "zxqvwa"])
def test_a_word_has_a_meaning_only_beside_a_known_class_that_is_no_structure(label: str) -> None:
    floor = ObjectClass("floor", structure=True)
    word = Vocabulary([floor, ObjectClass(label)]).meaning("sofa")
    assert (word is None) == (label == "zxqvwa")
