"""Objects on the board: additions, moves, imports, and links to scenes."""

import base64
import json
import zlib
from typing import Any

import httpx
import pytest
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard
from tests.client.scene_files import REFUSED

pytestmark = pytest.mark.system


def place(board: Board, name: str, question: str = "missing") -> tuple[float, float, float]:
    (found,) = [thing for thing in board.body(question)["objects"] if thing["id"] == name]
    return tuple(found["position"][axis] for axis in "xyz")


def test_an_object_is_found_by_any_of_its_names(board: Board) -> None:
    box = board.page.get_by_role("combobox", name="Add an object")
    box.fill("trash can")
    options = board.page.locator("#found [role=option]")
    expect(options.first).to_contain_text("garbage bin trash can")
    assert box.get_attribute("aria-expanded") == "true"
    box.press("ArrowDown")
    assert box.get_attribute("aria-activedescendant") == options.first.get_attribute("id")
    box.press("Enter")
    board.settle()
    assert board.things == ["desk", "chair", "garbage bin"]
    assert board.body("missing")["objects"][-1]["label"] == "garbage bin"
    assert box.get_attribute("aria-expanded") == "false"
    board.add("chair")
    assert board.things[-1] == "chair_2", "a second object of a class has a name of its own"


def test_an_object_can_be_dropped_where_it_stands(board: Board, api: httpx.Client) -> None:
    board.page.get_by_role("combobox", name="Add an object").fill("lamp")
    option = board.page.get_by_role("option", name="lamp", exact=True)
    desk = board.thing("desk").locator(".box").bounding_box()
    svg = board.page.locator("#board").bounding_box()
    at = {"x": desk["x"] - svg["x"] + 20, "y": desk["y"] - svg["y"] + desk["height"] / 2}
    option.drag_to(board.page.locator("#board"), target_position=at)
    board.settle()
    x, y, z = place(board, "lamp")
    assert x == pytest.approx(2, abs=0.1)
    assert 0.5 < y < 0.8
    assert z > 0.74
    answer = api.post("/outliers", json=board.scene).json()
    seen = answer["observed_relations"]
    assert {"subject": "lamp", "relation": "on-top", "object": "desk"} in seen


def test_objects_on_a_support_move_with_it(board: Board) -> None:
    lamp = {"id": "lamp", "label": "lamp", "position": {"x": 2, "y": 0.5, "z": 0.94}}
    board.put(json.dumps({"objects": [*board.exported()["objects"], lamp]}))
    before, desk = place(board, "lamp"), place(board, "desk")
    board.press("desk", "Shift+ArrowRight")
    assert place(board, "desk")[1] == pytest.approx(desk[1] - 0.5)
    assert place(board, "lamp") == pytest.approx((before[0], before[1] - 0.5, before[2]))


def test_numbers_can_be_typed(board: Board) -> None:
    board.page.get_by_role("button", name="chair", exact=False).first.click()
    form = board.page.locator("#properties")
    form.get_by_label("ahead (x)").fill("1.25")
    form.get_by_label("height").fill("1.1")
    form.get_by_label("Rotation (°)").fill("90")
    form.get_by_label("Confidence").fill("0.8")
    form.get_by_label("Confidence").press("Enter")
    board.settle()
    (_, chair) = board.body("missing")["objects"]
    assert chair["position"]["x"] == 1.25
    assert chair["position"]["z"] == pytest.approx(0.55)
    assert chair["size"]["z"] == 1.1
    assert chair["confidence"] == 0.8
    assert chair["orientation"]["z"] == pytest.approx(0.7071, abs=1e-3)
    # An invalid number is refused beside the field.
    field = form.get_by_label("height")
    field.fill("-1")
    field.press("Enter")
    expect(board.page.locator("#properties-error")).not_to_be_empty()
    assert field.get_attribute("aria-invalid") == "true"
    board.settle()
    assert board.body("missing")["objects"][1]["size"]["z"] == 1.1


NO_SCENES: list[tuple[Any, str]] = [
    ("{", "neither JSON nor JSON lines"),
    ('{"objects": ["bed"]\n{"objects": ', "neither JSON nor JSON lines"),
    ({"detections": [None]}, "no known format"),
    ({"detections": [{"results": []}]}, "no hypothesis with a score"),
    ({"objects": [{"label": "bed", "size": [-1, 1, 1]}]}, "numbers x, y, z from 0"),
    ({"objects": [{"id": "a", "label": "bed"}] * 2}, "another object"),
    ({"objects": [{"label": "bed", "position": [1e9, 0, 0]}]}, "100 000 km"),
    ({"objects": [{"label": "bed", "size": [2e7, 1, 1]}]}, "10 000 km"),
    ({"objects": ["bed"], "relations": [None]}, "Relation 1 must have a subject"),
    ({"objects": ["bed"], "relations": [["bed", "constructor", "bed"]]}, "one of left, right"),
    ({"objects": ["bed"], "relations": [["rug", "under", "bed"]]}, "outside the scene: rug"),
    ({"objects": [], "viewpoint": {"x": 0, "y": 0, "yaw": 2e3}}, "±1000"),
    *(REFUSED[name] for name in ("yolo.txt", "captions.json", "bomb.xml", "words.csv")),
]


@pytest.mark.slow
def test_invalid_scenes_are_refused_with_a_reason(open_board: OpenBoard) -> None:
    board = open_board(allow=("422",))
    page = board.page
    for scene, words in NO_SCENES:
        text = scene if isinstance(scene, str) else json.dumps(scene)
        page.get_by_role("button", name="Import, export").click()
        page.get_by_label("Scene, JSON").fill(text)
        page.get_by_role("button", name="Put on the board").click()
        expect(page.locator("#json-error")).to_contain_text(words)
        assert "\n" not in (page.locator("#json-error").text_content() or "")
        page.get_by_role("button", name="Close").click()
        assert board.things == ["desk", "chair"]


@pytest.mark.slow
def test_a_link_holds_the_scene(open_board: OpenBoard) -> None:
    board = open_board(permissions=["clipboard-read", "clipboard-write"])
    scene = board.exported()
    board.click("Import, export")
    board.click("Copy a link")
    expect(board.page.locator("#share-done")).to_contain_text("copied")
    link = board.page.evaluate("navigator.clipboard.readText()")
    assert "#scene=" in link
    assert open_board(scene=None, url=link).exported() == scene


@pytest.mark.parametrize("is_bomb", [False, True])
def test_unreadable_links(open_board: OpenBoard, api: httpx.Client, is_bomb: bool) -> None:
    """300 MB of blanks in a link of 400 kB: the page neither hangs nor fills the memory."""
    link, words = "nonsense", "cannot be read"
    if is_bomb:
        packer, words = zlib.compressobj(9, wbits=-15), "at most 512 KiB"
        packed = b"".join([packer.compress(b" " * 2**20) for _ in range(300)]) + packer.flush()
        link = base64.urlsafe_b64encode(packed).decode().rstrip("=")
    board = open_board(scene=None, url=f"{api.base_url}/#scene={link}")
    expect(board.page.get_by_role("alert").first).to_contain_text(words)
    assert board.things


def placed(board: Board) -> list[str]:
    return [thing["id"] for thing in board.scene["objects"] if "position" in thing]


def test_positions_count_only_when_switched_on(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board(scene=None)
    says = board.page.locator("#evidence")
    expect(says).to_contain_text("The answers use labels only.")
    assert placed(board) == []
    labels = {"objects": [thing["label"] for thing in board.scene["objects"]]}
    alone = api.post("/missing", json=labels | {"room_type": "bedroom", "top_k": 5}).json()
    rows = [row for row in board.rows("missing") if not row.startswith("another ")]
    assert len(rows) == len(alone["missing"])
    for row, one in zip(rows, alone["missing"], strict=True):
        assert row.startswith(one["label"])
    board.use_positions()
    assert placed(board) == board.things
    expect(says).to_contain_text("positions of 5 of 5 objects")
    assert api.post("/relations", json=board.scene).json()["observed_relations"]


def test_positions_that_the_page_chose_do_not_count(board: Board) -> None:
    assert board.page.get_by_label("Positions count as evidence").is_checked()
    board.add("monitor")
    board.page.locator("#board .ghost").first.press("Enter")
    board.settle()
    expect(board.page.locator("#board .object.loose")).to_have_count(2)
    assert placed(board) == ["desk", "chair"]
    board.page.locator("#list .name", has_text="monitor").click()
    expect(board.page.locator("#properties")).to_contain_text("Centre, metres (not given)")
    expect(board.page.locator("#evidence")).to_contain_text("positions of 2 of 4 objects")
    expect(board.page.locator("#list li").nth(2)).to_contain_text("position not given")
    board.press("monitor", "ArrowUp")
    assert placed(board) == ["desk", "chair", "monitor"]


def test_labels_and_supports_are_read(board: Board) -> None:
    for text in ("bed, lamp, mug", "bed\nlamp\nmug\n"):
        board.put(text)
        assert board.things == ["bed", "lamp", "mug"]
    board.put('["bed", "lamp", "lamp"]')
    assert board.things == ["bed", "lamp_1", "lamp_2"]
    board.put('{"objects": ["desk", "lamp"], "relations": [["lamp", "on-top", "desk"]]}')
    assert board.scene["relations"] == [{"subject": "lamp", "relation": "on-top", "object": "desk"}]
    # Supports are relations.
    objects = [{"id": 0, "label": "table"}, {"id": 1, "label": "mug", "supported_by": 0}]
    for relations in ([], [[1, "on-top", 0]]):
        board.put(json.dumps({"scene_id": "one", "objects": objects, "relations": relations}))
        stated = {"subject": "1", "relation": "on-top", "object": "0"}
        assert board.scene["relations"] == [stated]


def test_boxes_in_other_conventions_are_left_out(board: Board) -> None:
    desk = {"label": "desk", "position": [2, 0, 0.4], "size": [0.7, 1.4, 0.8]}
    objects = [desk, {**desk, "id": "desk_2"}]
    board.put(json.dumps({"objects": objects, "units": "m"}))
    assert placed(board) == ["desk", "desk_2"]
    board.put(json.dumps({"objects": objects, "units": "cm"}))
    expect(board.page.locator("#note")).to_contain_text("declared conventions")
    assert placed(board) == []
