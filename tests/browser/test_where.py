"""The view "Where is it?": rooms of a file or added by hand, places, and places without success."""

import json
import re
import sys
from pathlib import Path
from typing import Any

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Locator, expect

from tests.browser.driving import Board, OpenBoard, body_of, percent, plain
from tests.conftest import run_program

pytestmark = pytest.mark.system

SCENES = {
    "old kitchen": ("kitchen", ["stove", "toilet"], 1),
    "bathroom": ("bathroom", ["toilet", "bathtub", "sink"], 3),
    "kitchen": ("kitchen", ["refrigerator", "stove", "sink"], 4),
    "bedroom": ("bedroom", ["bed", "nightstand", "wardrobe"], 2),
}


@pytest.fixture
def home(board: Board, tmp_path: Path) -> Board:
    """The page with a recording of three rooms. The board shows the bathroom."""
    lines = [
        {
            "scene_id": name,
            "group": "g",
            "room_type": room,
            "objects": [{"id": f"{label}_1", "label": label} for label in labels],
            "stamp": {"sec": second, "nanosec": 0},
        }
        for name, (room, labels, second) in SCENES.items()
    ]
    file = tmp_path / "scenes.jsonl"
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), "utf-8")
    board.open_file(file)
    board.page.locator("#which").fill("2")
    board.click("Put on the board")
    board.tab("Where")
    return board


def ask(board: Board, thing: str) -> None:
    box = board.page.get_by_role("combobox", name="Thing")
    box.fill(thing)
    box.press("Enter")
    board.settle()


def article(board: Board) -> Locator:
    return board.page.locator("#whereabouts")


def rows(board: Board, name: str) -> list[str]:
    return [
        plain(text) for text in article(board).get_by_label(name).locator("li").all_inner_texts()
    ]


def body(board: Board) -> dict[str, Any]:
    return body_of(article(board).locator("pre").first.text_content() or "")


def rooms(board: Board) -> list[str]:
    return [plain(text) for text in board.page.locator("#home li").all_inner_texts()]


def shares(api: httpx.Client, request: dict[str, Any]) -> dict[str, float]:
    found = api.post("/where", json=request).json()["rooms"]
    return {one["room"]: one["probability"] for one in found}


def in_words(place: dict[str, Any]) -> str:
    spoken = {"on-top": "on top of", "under": "under", "inside": "in"}
    if place.get("is_listed"):
        return f"{place['room']}: {place['object']}, seen there"
    where = f"{spoken[place['relation']]} {place['object']}" if "object" in place else "elsewhere"
    return f"{place['room']}: {where}"


def test_the_rooms_of_a_file(home: Board, api: httpx.Client) -> None:
    assert rooms(home) == ["bathroom 3 ✕", "kitchen 3 ✕", "bedroom 3 ✕"]
    ask(home, "toothbrush")
    request = body(home)
    assert [room["id"] for room in request["rooms"]] == ["bathroom", "kitchen", "bedroom"]
    assert [thing["label"] for thing in request["rooms"][1]["objects"]] == SCENES["kitchen"][1]
    answer = api.post("/where", json=request).json()
    shown = rows(home, "Places")
    assert 5 <= len(shown) <= 10
    for row, place in zip(shown, answer["places"], strict=False):
        assert row.startswith(f"{in_words(place)} {percent(place['probability'])}")
    on_board = {"bathroom": "bathroom on the board"}
    assert rows(home, "Rooms") == [
        *(
            f"{on_board.get(one['room'], one['room'])} {percent(one['probability'])}"
            for one in answer["rooms"]
        ),
        f"not here {percent(answer['not_here'])}",
    ]
    (first, *_) = answer["places"]
    assert home.announced == (
        f"toothbrush: most likely {in_words(first)}, {percent(first['probability'])}. "
        f"Not here: {percent(answer['not_here'])}."
    )


def test_a_place_without_success_loses_probability(home: Board, api: httpx.Client) -> None:
    ask(home, "toothbrush")
    again = home.page.get_by_role("button", name="Start again")
    expect(again).to_be_hidden()
    before = shares(api, body(home))
    looked = home.page.get_by_role("button", name="Looked there: bathroom: on top of sink_1")
    looked.focus()
    home.page.keyboard.press("Enter")
    home.settle()
    assert body(home)["searched"] == [{"room": "bathroom", "object": "sink_1"}]
    expect(looked).to_be_focused()
    expect(home.page.locator("#board .object.searched")).to_have_attribute(
        "aria-label", re.compile("^sink_1, .*, searched$")
    )
    expect(article(home)).to_contain_text("Looked at 1 place without finding it.")
    (row,) = [row for row in rows(home, "Places") if "on top of sink_1" in row]
    assert " looked " in row
    during = shares(api, body(home))
    home.page.get_by_role("button", name="Looked in the room: bathroom: elsewhere").click()
    home.settle()
    assert body(home)["searched"][1:] == [{"room": "bathroom"}]
    after = shares(api, body(home))
    assert after["bathroom"] < before["bathroom"]
    # The former probabilities stay visible until another question.
    moved = (percent(each[room]) for room in ("bathroom",) for each in (during, after))
    assert " → ".join(moved) in next(row for row in rows(home, "Rooms") if "bathroom" in row)
    chips = article(home).get_by_label("Searched without finding it").locator("li")
    expect(chips).to_have_text(["bathroom: sink_1✕", "bathroom: the whole room✕"])
    home.page.get_by_role("button", name="Take back the search: bathroom: sink_1").press("Enter")
    home.settle()
    assert body(home)["searched"] == [{"room": "bathroom"}]
    again.click()
    home.settle()
    assert "searched" not in body(home)
    assert not any("→" in row for row in rows(home, "Rooms"))
    expect(home.page.get_by_role("combobox", name="Thing")).to_be_focused()
    # A new thing begins without searches.
    looked.click()
    home.settle()
    ask(home, "soap")
    assert "searched" not in body(home)


def test_the_board_shows_probabilities(home: Board, api: httpx.Client) -> None:
    ask(home, "toothbrush")
    answer = api.post("/where", json=body(home)).json()
    in_room = [place for place in answer["places"] if place["room"] == "bathroom"]
    for label in ("sink", "bathtub"):
        of = [one["probability"] for one in in_room if one.get("object") == f"{label}_1"]
        expect(home.page.locator("#board .names")).to_contain_text(
            f"{label} {percent(sum(of))}".replace(" %", "\u00a0%")
        )
    (rest,) = [one["probability"] for one in in_room if "object" not in one]
    room = next(one["probability"] for one in answer["rooms"] if one["room"] == "bathroom")
    here = home.page.locator("#here")
    assert plain(here.text_content()) == (
        f"toothbrush in this room: {percent(room)}. At no listed object: {percent(rest)}."
    )
    # The menu of an object marks it as searched.
    home.thing("sink_1").press("Enter")
    home.page.get_by_role("menuitem", name="Looked here, no toothbrush").press("Enter")
    home.settle()
    assert body(home)["searched"] == [{"room": "bathroom", "object": "sink_1"}]
    expect(home.page.locator("#legend")).to_contain_text("✓ searched")
    # Another room of the file.
    home.page.get_by_role("button", name="Show kitchen on the board").press("Enter")
    home.settle()
    assert home.things == ["refrigerator_1", "stove_1", "sink_1"]
    expect(home.page.locator("#board .object.searched")).to_have_count(0)
    home.tab("Missing")
    expect(here).to_be_hidden()


def test_places_on_the_board_are_highlighted(home: Board) -> None:
    ask(home, "toothbrush")
    spots = home.page.locator("#board .object.spot")
    expect(home.thing("sink_1")).to_have_class("object spot")
    assert "possible place of toothbrush" in str(spots.first.get_attribute("aria-label"))
    expect(home.page.locator("#legend")).to_contain_text("possible place of the thing")
    home.tab("Wrong")
    expect(spots).to_have_count(0)
    home.tab("Where")
    ask(home, "pillow")
    # A place in another room shows the scene of this room.
    home.page.get_by_role("button", name="bedroom: on top of bed_1", exact=True).click()
    home.settle()
    assert home.things == ["bed_1", "nightstand_1", "wardrobe_1"]
    expect(home.page.locator("#list li.selected")).to_contain_text("bed_1")
    assert "spot" in str(home.thing("bed_1").get_attribute("class"))


def test_a_thing_that_the_robot_has_seen(home: Board) -> None:
    ask(home, "wardrobe")
    assert rows(home, "Places")[0].startswith("bedroom: wardrobe_1, seen there")
    home.page.get_by_role("button", name="Looked there: bedroom: wardrobe_1, seen there").click()
    home.settle()
    assert body(home)["searched"] == [{"room": "bedroom", "object": "wardrobe_1"}]


def test_changes_of_the_board_count(home: Board) -> None:
    home.press("bathtub_1", "Delete")
    ask(home, "toothbrush")
    bathroom = body(home)["rooms"][0]
    assert [thing["label"] for thing in bathroom["objects"]] == ["toilet", "sink"]
    home.page.get_by_role("button", name="Remove the room bathroom").click()
    home.settle()
    assert [room["id"] for room in body(home)["rooms"]] == ["kitchen", "bedroom"]


def test_rooms_are_added_by_hand(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board({"objects": ["toilet", "bathtub"], "room_type": "bathroom"})
    board.tab("Where")
    ask(board, "towel")
    expect(article(board)).to_contain_text("Add a room first.")
    board.click("Add this room")
    assert rooms(board) == ["bathroom 2 ✕"]
    name = board.page.get_by_label("Room", exact=True).last
    name.fill("wet room")
    name.press("Enter")
    board.settle()
    assert rooms(board) == ["bathroom 2 ✕", "wet room 2 ✕"]
    first, second = body(board)["rooms"]
    assert first == {"id": "bathroom", "objects": second["objects"]}
    assert second["room_type"] == "bathroom"
    board.click("Clear")
    expect(board.page.locator("#board .object")).to_have_count(0)
    board.add("stove")
    board.click("Add this room")
    assert len(rooms(board)) == 2  # a room needs a name
    name.fill("wet room")
    board.click("Add this room")
    assert rooms(board) == ["bathroom 2 ✕", "wet room 1 ✕"]
    answer = api.post("/where", json=body(board)).json()
    assert rows(board, "Rooms")[-1] == f"not here {percent(answer['not_here'])}"


def test_errors_are_shown(open_board: OpenBoard) -> None:
    board = open_board({"objects": ["bed"], "room_type": "bedroom"}, allow=("422",))
    board.tab("Where")
    board.click("Add this room")
    ask(board, "qwxzkvj")
    expect(article(board).get_by_role("alert")).to_contain_text("qwxzkvj")
    ask(board, "lamp")
    expect(article(board).get_by_role("alert")).to_be_hidden()


def test_the_request_runs_in_a_program(home: Board) -> None:
    ask(home, "toothbrush")
    article(home).get_by_text("Send this request from a program").click()
    code = article(home).locator("pre").nth(1).text_content() or ""
    answer = json.loads(run_program(sys.executable, "-c", code).stdout)
    assert rows(home, "Rooms")[0].startswith(answer["rooms"][0]["room"])


@pytest.mark.parametrize(("scheme", "width"), [("light", 1300), ("light", 390), ("dark", 1300)])
def test_the_view_is_accessible(open_board: OpenBoard, scheme: str, width: int) -> None:
    board = open_board(
        {"objects": ["toilet", "sink"], "room_type": "bathroom"}, color_scheme=scheme
    )
    board.page.set_viewport_size({"width": width, "height": 900})
    board.tab("Where")
    assert Axe().run(board.page).response["violations"] == []
    board.click("Add this room")
    ask(board, "toothbrush")
    board.page.get_by_role("button", name="Looked there").first.click()
    board.settle()
    assert Axe().run(board.page).response["violations"] == []
    assert board.page.evaluate("document.documentElement.scrollWidth <= innerWidth")
