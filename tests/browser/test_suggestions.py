"""Suggestions stand at free places where their placements say."""

from __future__ import annotations

import math
import re
from typing import Any

import httpx
import numpy as np
import pytest

from app.scene.geometry import overlap_and_gap
from tests.browser.driving import Board, OpenBoard

pytestmark = pytest.mark.system

Box = dict[str, Any]

STANDING = """async (cases) => {
  const { standing } = await import('./static/board/ghosts.js');
  return cases.map(({ missing, boxes, viewer, sizes, at }) =>
    standing(missing, boxes, viewer, new Map(Object.entries(sizes)), at));
}"""


def box(name: str, x: float, y: float, z: float, size: tuple[float, float, float]) -> Box:
    extent = dict(zip("xyz", size, strict=True))
    return {"id": name, "label": name, "x": x, "y": y, "z": z, "yaw": 0.0, "size": extent}


def share(a: Box, b: Box) -> float:
    """Common area of two footprints, divided by the smaller area."""
    parts = [
        part
        for one in (a, b)
        for part in (
            np.array([[one["x"], one["y"]]]),
            np.array([[one["size"]["x"], one["size"]["y"]]]),
            np.array([math.radians(one["yaw"])]),
        )
    ]
    return float(overlap_and_gap(*parts)[0][0])


def top(one: Box) -> float:
    return float(one["z"] + one["size"]["z"])


def ghost_at(
    board: Board, relation: str, anchor: Box, size: tuple[float, float, float], **more: Any
) -> Box:
    """The ghost of one placement, with the fields ``offset``, ``boxes`` and ``at`` of the case."""
    placement = {"relation": relation, "object": anchor["id"], "probability": 0.5}
    if "offset" in more:
        mean = dict(zip("xyz", more["offset"], strict=True))
        placement["offset"] = {"mean": mean, "std": dict.fromkeys("xyz", 0.2), "scenes": 9}
    case = {
        "boxes": [anchor, *more.get("boxes", [])],
        "missing": [{"label": "it", "probability": 0.5, "placements": [placement]}],
        "viewer": {"x": 0.0, "y": 0.0, "yaw": 0.0},
        "sizes": {"it": dict(zip("xyz", size, strict=True))},
        "at": None,
    }
    ((ghost,),) = board.page.evaluate(STANDING, [case])
    return dict(ghost)


def test_a_ghost_stands_where_the_answer_says(open_board: OpenBoard) -> None:
    bed, size, board = box("bed", 3, 0, 0, (2, 1.6, 0.5)), (0.4, 0.4, 0.2), open_board()
    for relation, offset in (
        # The first overhangs the bed a little, the second is close to the anchor.
        ("on-top", (0.85, 0.65, 0.4)),
        ("left", (0.1, 1.01, 0)),
        ("behind", (1.4, -1.3, 0)),
    ):
        ghost = ghost_at(board, relation, bed, size, offset=offset)
        assert (ghost["x"], ghost["y"]) == pytest.approx((3 + offset[0], offset[1]))
        assert not ghost["shifted"]
        taken = box("box", 3 + offset[0], offset[1], 0, (0.3, 0.3, 1))
        moved = ghost_at(board, relation, bed, size, offset=offset, boxes=[taken])
        assert share(moved, taken) == 0
        assert moved["shifted"]
        assert not ghost_at(board, relation, bed, size)["shifted"], "no offset to keep"


def test_a_suggestion_at_another_place_or_none_says_so(open_board: OpenBoard) -> None:
    far = {"mean": {"x": 9.0, "y": 0.0, "z": 0.5}, "std": dict.fromkeys("xyz", 0.2), "scenes": 9}
    place = {"relation": "on-top", "object": "desk", "probability": 0.9, "offset": far}
    board = open_board()
    board.alter(
        "missing",
        lambda answer: (
            answer | {"missing": [answer["missing"][0] | {"label": "cup", "placements": [place]}]}
        ),
    )
    board.add("laptop")
    assert "drawn at the nearest free place" in board.rows("missing")[0]
    ghost = board.page.locator("#board .ghost").first
    assert "drawn at the nearest free place" in str(ghost.get_attribute("aria-label"))
    far["mean"]["x"] = 0.0
    board.add("lamp")
    assert board.ghosts == ["cup"]
    assert "nearest free place" not in board.rows("missing")[0]
    # Below the desk, there is no free place.
    place["relation"] = "below"
    del place["offset"]
    board.add("mug")
    assert board.ghosts == []
    assert "no free place on the board" in board.rows("missing")[0]
    assert board.column("missing").get_by_role("button", name="Put ").count() == 0


LAY_OUT = """async ([boxes, relations]) => {
  const { layOut } = await import('./static/board/layout.js');
  return layOut([], boxes, relations, { x: 0, y: 0, yaw: 0 });
}"""


def test_a_layout_keeps_contents_in_their_container(open_board: OpenBoard) -> None:
    boxes = [
        box("milk", 0, 0, 0, (0.1, 0.1, 0.25)),
        box("juice", 0, 0, 0, (0.3, 0.3, 0.25)),
        box("fridge", 0, 0, 0, (0.7, 0.8, 1.8)),
        box("magnet", 0, 0, 0, (0.1, 0.1, 0.1)),
    ]
    relations = [
        {"subject": "milk", "relation": "inside", "object": "fridge"},
        {"subject": "fridge", "relation": "contains", "object": "juice"},
        {"subject": "magnet", "relation": "on-top", "object": "fridge"},
    ]
    page = open_board().page
    placed = page.evaluate(LAY_OUT, [boxes, relations])
    milk, juice, fridge, magnet = placed
    for one in (milk, juice):
        for axis in "xy":
            room = (fridge["size"][axis] - one["size"][axis]) / 2
            assert abs(one[axis] - fridge[axis]) <= room + 1e-6
        assert one["z"] == fridge["z"]
    assert (milk["x"], milk["y"]) != (juice["x"], juice["y"])
    assert magnet["z"] == top(fridge)


def test_no_suggestion_stands_at_an_outlier(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board({"objects": ["bed", "nightstand", "lamp", "toilet"]})
    (toilet,) = [
        one["object"]
        for one in api.post("/outliers", json=board.scene).json()["outliers"]
        if one["is_outlier"]
    ]
    missing = api.post("/missing", json=board.scene | {"top_k": 5}).json()["missing"]
    places = [place for one in missing for place in one["placements"]]
    assert any(place["object"] == toilet and place["probability"] >= 0.25 for place in places)
    assert not any(re.search(rf"{toilet} \d+ %", row) for row in board.rows("missing"))
