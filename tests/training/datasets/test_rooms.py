from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from app.scene import CANONICAL
from app.scene.footprints import overlap_and_gap
from training.datasets import AnnotatedScene, encode, generate_rooms, rooms_vocabulary
from training.datasets.rooms import DOMAINS, ROOMS, Piece


@pytest.fixture(scope="module")
def rooms() -> list[AnnotatedScene]:
    return generate_rooms(300, seed=5)


def test_equal_seeds_give_equal_rooms(rooms: list[AnnotatedScene]) -> None:
    assert len(rooms) == 300
    # A larger number only adds scenes.
    assert generate_rooms(20, seed=5) == rooms[:20]
    assert generate_rooms(20, seed=6) != rooms[:20]
    assert generate_rooms(0, seed=5) == []
    with pytest.raises(ValueError, match="count must not be negative"):
        generate_rooms(-1, seed=0)


def test_views_of_a_room_share_its_group(rooms: list[AnnotatedScene]) -> None:
    views = Counter(scene.group for scene in rooms)
    assert set(views.values()) == {1, 2, 3}
    assert len({(scene.group, scene.room_type) for scene in rooms}) == len(views)
    # Views omit small objects.
    assert len({(scene.group, len(scene.objects)) for scene in rooms}) > len(views)


def test_boxes_do_not_overlap(rooms: list[AnnotatedScene]) -> None:
    for scene in rooms[:60]:
        i, j = np.triu_indices(len(scene.objects), 1)
        names = ("position", "size", "yaw")
        boxes = ([getattr(thing, name) for thing in scene.objects] for name in names)
        centres, sizes, yaws = map(np.array, boxes)
        share, _ = overlap_and_gap(
            centres[i, :2], sizes[i, :2], yaws[i], centres[j, :2], sizes[j, :2], yaws[j]
        )
        reach = (sizes[i, 2] + sizes[j, 2]) / 2
        together = np.abs(centres[i, 2] - centres[j, 2]) < reach - 1e-6
        assert not (together & (share > 1e-9)).any()
        assert (centres[:, 2] - sizes[:, 2] / 2 >= -1e-9).all()


def test_support_links_agree_with_the_boxes(rooms: list[AnnotatedScene]) -> None:
    vocabulary = rooms_vocabulary()
    on_top = CANONICAL.index("on-top")
    bare = [
        replace(s, objects=tuple(replace(o, supported_by=None) for o in s.objects))
        for s in rooms[:60]
    ]
    links = 0
    for scene, encoded in zip(rooms, encode(bare, vocabulary), strict=False):
        index_of = {thing.id: i for i, thing in enumerate(scene.objects)}
        for thing in scene.objects:
            if thing.supported_by is not None:
                links += 1
                ends = index_of[thing.id], index_of[thing.supported_by]
                assert encoded.instance_holds[on_top, *ends]
    assert links > 100


def test_the_vocabulary_covers_the_generator(rooms: list[AnnotatedScene]) -> None:
    vocabulary = rooms_vocabulary()
    assert set(vocabulary.room_types) == set(ROOMS)
    encoded = encode(rooms, vocabulary)
    assert all(not scene.unknown and scene.room_type >= 0 for scene in encoded)


def test_other_tables_make_another_domain() -> None:
    found = generate_rooms(60, 0, DOMAINS["workplaces"])
    assert {scene.room_type for scene in found} == set(DOMAINS["workplaces"])
    homes = {thing.label for scene in generate_rooms(60, 0) for thing in scene.objects}
    assert not homes & {thing.label for scene in found for thing in scene.objects}


@pytest.mark.parametrize(
    ("side", "axis", "sign"), [("left", 0, -1), ("right", 0, 1), ("front", 1, 1), ("back", 1, -1)]
)
def test_an_adjacent_piece_is_close_to_the_named_side(side, axis, sign) -> None:
    """In the axes of the main piece, whose front is +y; from every viewpoint of a room."""
    chair = Piece("chair", (0.3, 0.3, 0.8))
    table = Piece("table", (0.6, 0.5, 0.7), where="centre", beside=((chair, side),))
    for scene in generate_rooms(40, 0, {"kitchen": (table,)}):
        (main,) = (thing for thing in scene.objects if thing.label == "table")
        (other,) = (thing for thing in scene.objects if thing.label == "chair")
        cos, sin = np.cos(main.yaw), np.sin(main.yaw)
        away = np.subtract(other.position, main.position)[:2] @ [[cos, -sin], [sin, cos]]
        gap = sign * away[axis] - (main.size[axis] + other.size[axis]) / 2
        assert 0 < gap < 0.2


def test_a_piece_is_in_a_room_once_unless_its_table_says_otherwise() -> None:
    def most(piece: Piece) -> int:
        scenes = generate_rooms(40, 0, {"hall": (piece,)})
        return max(len(scene.objects) for scene in scenes)

    size = (0.5, 0.3, 1.0)
    assert most(Piece("shelf", size)) == 1
    assert most(Piece("shelf", size, most=3)) == 3
