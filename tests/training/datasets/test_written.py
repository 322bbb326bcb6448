from collections import Counter

import pytest

from app.scene import label_key
from training.datasets.files import KNOWLEDGE
from training.datasets.inventories import read_inventory, shipped_things
from training.datasets.vocabulary import INDOOR_FILE, read_vocabulary
from training.datasets.written import LEAST_PLACES, written_vocabulary


@pytest.fixture(scope="module")
def vocabulary():
    return written_vocabulary()


def named(vocabulary, word):
    index = vocabulary.index(word)
    return None if index is None else vocabulary.labels[index]


def room_type(vocabulary, name):
    """The room type that a request with `nearest-or-ignore` reads."""
    found = vocabulary.read(name, is_room=True) or vocabulary.guess(name, is_room=True)
    return None if found is None else vocabulary.room_types[found.entry]


def test_common_things_and_indoor_classes_are_classes(vocabulary):
    assert 1_400 < len(vocabulary) < 1_700
    assert {label_key(x) for x in read_vocabulary(INDOOR_FILE).labels} <= set(
        map(label_key, vocabulary.labels)
    )
    expected = Counter()
    for place in read_inventory(KNOWLEDGE / "inventories.csv").places:
        for group, item in place.items:
            expected[item.label] += group.share * item.share
    indoor = set(read_vocabulary(INDOOR_FILE).labels)
    things = [label for label in shipped_things() if label not in indoor][::40]
    assert len(things) > 20
    for label in things:
        assert (label in vocabulary.labels) == (expected[label] >= LEAST_PLACES), label


@pytest.mark.parametrize(
    ("word", "label", "parent"),
    [
        ("hedge shears", "tool", None),  # rare, so a name of the broader class
        ("zimmer frame", "walker", None),
        ("couch", "sofa", "furniture"),
        ("treadmill", "exercise equipment", "equipment"),
        ("floor lamp", "floor lamp", "lamp"),
        ("kayak", "boat", None),
    ],
)
def test_words_are_read_as_the_nearest_class(vocabulary, word, label, parent):
    assert named(vocabulary, word) == label
    assert vocabulary.objects[vocabulary.index(label)].parent == parent


def test_a_word_with_a_class_of_its_own_is_never_folded(vocabulary):
    for label in vocabulary.labels:
        assert named(vocabulary, label) == label
    assert named(vocabulary, "key board") == "keyboard"  # things.csv: another name of a key holder


def test_no_word_of_the_indoor_vocabulary_is_lost(vocabulary):
    """A name moves to another class only where that class is written to have it."""
    other = {
        label_key(name): thing
        for thing in shipped_things().values()
        for name in (thing.label, *thing.other_names)
    }
    moved = 0
    for entry in read_vocabulary(INDOOR_FILE).objects:
        for name in entry.aliases:
            if (found := named(vocabulary, name)) != entry.label:
                moved += 1
                assert found is not None
                assert label_key(name) in other, name
    assert moved <= 50


def test_every_class_has_a_size_and_rooms_have_types(vocabulary):
    assert all(entry.size for entry in vocabulary.objects)
    x, y, z = vocabulary.objects[vocabulary.index("bed")].size
    assert x == y
    assert 1 < x < 2.5
    assert 0.3 < z < 1.2
    assert vocabulary.structure[vocabulary.index("wall")]
    assert vocabulary.anywhere[vocabulary.index("person")]
    assert {"workshop", "warehouse", "nursery", "operating room"} <= set(vocabulary.room_types)


def test_few_room_types_of_written_places_are_folded(vocabulary):
    """A folded type has the things of the other one."""
    names = {place.room_type for place in read_inventory(KNOWLEDGE / "inventories.csv").places}
    folded = {name: room_type(vocabulary, name) for name in names - {*vocabulary.room_types}}
    assert folded == {"lounge": "living room", "lobby": "reception"}


ROOM_NAMES = {
    "bedroom": "Primary Bedroom, Secondary Bedroom, kids_bedroom, Kid's Bedroom, childs_room_0"
    ", Guest Room",
    "nursery": "Nursery",
    "hotel room": "hotel_room",
    "bathroom": "Upstairs Bathroom, Downstairs toilet, En-suite, WC",
    "closet": "Cloakroom",
    "entrance hall": "Entryway, entryway/foyer/lobby, Entrance",
    "corridor": "Hall",
    "stairs": "Landing",
    "dining room": "Dining Hall",
    "kitchen": "Kitchen/Dining",
    "living room": "Lounge",
    "recreation room": "Recreation Area",
    "gym": "workout/gym/exercise, Fitness Area",
    "laundry room": "Laundry",
    "utility room": "Utility Room",
    "pantry": "pantry_room_0",
    "porch": "porch/terrace/deck",
    "garden": "Front Yard",
    "hospital room": "Ward 5",
    "museum room": "museum",
    "waiting room": "rest_space",
    "library": "study_space",
    None: "Room1, Room 17, Anna's room, Open plan, Salon, Town Hall, empty_room, hospital, airport",
}


@pytest.mark.parametrize(
    ("name", "expected"),
    [(name, room) for room, names in ROOM_NAMES.items() for name in names.split(", ")],
)
def test_room_types_are_read_as_people_say_them(vocabulary, name, expected):
    assert room_type(vocabulary, name) == expected
