"""Places that the page chooses for objects without a position."""

from collections.abc import Callable
from itertools import combinations
from math import pi, radians
from typing import Any

import httpx
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from app.scene.footprints import measure
from app.scene.spatial_relations import CANONICAL, opposite
from scripts.sense.layouts import contents, triples_of
from tests.browser.driving import Board

pytestmark = pytest.mark.system

Box = dict[str, Any]
Scene = dict[str, Any]
LayOut = Callable[[Scene], list[Box]]
"""Returns the placed boxes, and checks that the fixed ones stay."""

RUN = """async ({ fixed, free, relations, viewer, hanging }) => {
  const { layOut } = await import('/static/board/layout.js');
  return [layOut(fixed, free, relations, viewer, new Set(hanging)), fixed];
}"""
TOUCH = 0.01  # depth in metres of boxes that only touch
AHEAD = {"x": 0, "y": 0, "yaw": 0}


@pytest.fixture
def lay_out(board: Board) -> LayOut:
    def run(scene: Scene) -> list[Box]:
        placed, fixed = board.page.evaluate(RUN, scene)
        assert fixed == scene["fixed"]
        assert [each["id"] for each in placed] == [each["id"] for each in scene["free"]]
        return placed

    return run


def box(name: str, *size: float, **changes: Any) -> Box:
    return {"id": name, "label": name, "size": dict(zip("xyz", size, strict=True)), "yaw": 0} | {
        "z": 0, **changes
    }  # fmt: skip


def scene_of(free: list[Box], *triples: tuple[str, str, str], **changes: Any) -> Scene:
    relations = [dict(zip(("subject", "relation", "object"), one, strict=True)) for one in triples]
    every = {"fixed": [], "free": free, "relations": relations, "viewer": AHEAD, "hanging": []}
    return every | changes


@st.composite
def scenes(draw: st.DrawFn) -> Scene:
    """Boxes of any size, half of the scenes with rotated ones, and relations without any sense."""
    count = draw(st.integers(1, 25))
    rotation = st.integers(-180, 180) if draw(st.booleans()) else st.just(0)
    extent, place = st.floats(0.02, 2), st.floats(-4, 4)
    boxes = [
        box(f"box_{k}", *draw(st.tuples(extent, extent, extent)), yaw=draw(rotation))
        for k in range(count)
    ]
    fixed = draw(st.integers(0, min(4, count - 1)))
    for each in boxes[:fixed]:
        each |= {"x": draw(place), "y": draw(place), "z": draw(st.floats(0, 1))}
    name = st.sampled_from([each["id"] for each in boxes])
    relation = st.sampled_from([*CANONICAL, *map(opposite, CANONICAL)])
    triples = draw(st.lists(st.tuples(name, relation, name), max_size=4 * count))
    viewer = {"x": draw(place), "y": draw(place), "yaw": draw(st.sampled_from([0, 0.7, pi]))}
    hanging = draw(st.lists(name, max_size=5))
    return scene_of(boxes[fixed:], *triples, fixed=boxes[:fixed], viewer=viewer, hanging=hanging)


def reach_into(a: Box, b: Box) -> bool:
    """Return whether two boxes reach into each other by more than `TOUCH` in all directions."""
    top = min(a["z"] + a["size"]["z"], b["z"] + b["size"]["z"])
    if top - max(a["z"], b["z"]) <= TOUCH:
        return False
    footprints = [
        ((one["x"], one["y"]), (one["size"]["x"] - TOUCH, one["size"]["y"] - TOUCH),
         radians(one["yaw"]))
        for one in (a, b)
    ]  # fmt: skip
    overlap, _ = measure(*footprints[0], *footprints[1])
    return overlap > 0


def canonical(relations: list[dict[str, str]]) -> set[tuple[str, str, str]]:
    return {
        (i, a, j) if a in CANONICAL else (j, opposite(a), i) for i, a, j in triples_of(relations)
    }


def test_boxes_overlap_only_with_their_containers(lay_out: LayOut) -> None:
    @given(scenes())
    @settings(max_examples=150, deadline=None)
    def check(scene: Scene) -> None:
        free = lay_out(scene)
        within = contents(canonical(scene["relations"]))
        pairs = [*combinations(free, 2), *((a, b) for a in free for b in scene["fixed"])]
        for a, b in pairs:
            names = a["id"], b["id"]
            if names not in within and names[::-1] not in within:
                assert not reach_into(a, b), names

    check()


def test_the_same_relations_give_the_same_layout(lay_out: LayOut) -> None:
    @given(scenes())
    @settings(max_examples=20, deadline=None)
    def check(scene: Scene) -> None:
        first = lay_out(scene)
        assert first == lay_out(scene)
        for given_box, placed in zip(scene["free"], first, strict=True):
            chosen = {axis: placed[axis] for axis in "xyz"}
            assert placed == given_box | chosen, "only the position changes"

    check()


FURNITURE = [
    box("bed", 2, 1.6, 0.5), box("table", 1.4, 0.9, 0.75), box("cabinet", 0.9, 0.5, 1),
    box("chair", 0.5, 0.5, 0.9), box("basket", 0.4, 0.4, 0.4),
]  # fmt: skip


@pytest.mark.parametrize("yaw", [0, 0.7, pi])
def test_the_service_observes_the_relations(lay_out: LayOut, api: httpx.Client, yaw: float) -> None:
    things = [box(name, 0.2, 0.3, 0.1) for name in ("laptop", "book", "cup", "lamp")]
    light = box("light", 0.3, 0.3, 0.2)
    triples = [
        *((each["id"], "on-top", "table") for each in things),
        ("chair", "left", "table"), ("bed", "right", "table"), ("basket", "behind", "bed"),
        ("cabinet", "front", "bed"), ("table", "below", "light"),
    ]  # fmt: skip
    viewer = {"x": 3, "y": -1, "yaw": yaw}
    free = [*FURNITURE, *things, light]
    placed = lay_out(scene_of(free, *triples, viewer=viewer, hanging=["light"]))
    body = {"objects": [detection(each) for each in placed], "frame_id": "map", "viewpoint": viewer}
    answer = api.post("/relations", json=body).raise_for_status().json()
    stated = scene_of([], *triples)["relations"]
    assert canonical(stated) <= triples_of(answer["observed_relations"])


def detection(each: Box) -> dict[str, Any]:
    position = [each["x"], each["y"], each["z"] + each["size"]["z"] / 2]
    size = [each["size"][axis] for axis in "xyz"]
    return {"id": each["id"], "label": each["label"], "position": position, "size": size}


def test_contents_lie_in_their_container(lay_out: LayOut) -> None:
    plates = [box(f"plate_{k}", 0.3, 0.3, 0.1) for k in range(20)]
    triples = [(plate["id"], "inside", "cabinet") for plate in plates]
    placed = lay_out(scene_of([*FURNITURE, *plates], *triples))
    cabinet = placed[2]
    for plate in placed[len(FURNITURE) :]:
        assert 0 <= plate["z"] <= cabinet["size"]["z"] - plate["size"]["z"]
        for axis in "xy":
            room = (cabinet["size"][axis] - plate["size"][axis]) / 2
            assert abs(plate[axis] - cabinet[axis]) <= room + 0.001


def test_things_without_room_on_their_support_stand_on_the_floor(lay_out: LayOut) -> None:
    boxes = [box(f"box_{k}", 0.3, 0.3, 0.2) for k in range(20)]
    triples = [(each["id"], "on-top", "basket") for each in boxes]
    # The sofa is larger than its support.
    free = [*FURNITURE, *boxes, box("sofa", 2, 1, 0.8)]
    *placed, sofa = lay_out(scene_of(free, *triples, ("sofa", "on-top", "chair")))
    heights = [each["z"] for each in placed[len(FURNITURE) :]]
    assert set(heights) == {0, 0.4}
    assert sofa["z"] == 0


def test_a_mattress_carries_the_things_on_the_bed(lay_out: LayOut) -> None:
    covers = [box("pillow", 0.6, 0.4, 0.15), box("mattress", 2, 1.5, 0.2)]
    triples = [(each["id"], "on-top", "bed") for each in covers]
    *_, pillow, mattress = lay_out(scene_of([*FURNITURE, *covers], *triples))
    assert (mattress["z"], pillow["z"]) == (0.5, 0.7)


def test_pictures_hang_beside_the_furniture(lay_out: LayOut) -> None:
    names = ["picture", "clock", "window"]
    pictures = [box(name, 0.6, 0.05, 0.8) for name in names]
    placed = lay_out(scene_of([*pictures, *FURNITURE], hanging=names))
    for picture in placed[:3]:
        assert picture["z"] == pytest.approx(1.1)
        for other in placed[3:]:
            assert not reach_into(picture | {"z": 0}, other | {"z": 0})
