"""The page for keyboards, screen readers, small screens, light and dark."""

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard

pytestmark = pytest.mark.system


def focus(board: Board) -> str:
    name = "document.activeElement.getAttribute('aria-label') ?? document.activeElement.innerText"
    return board.page.evaluate(name)


def complaints(board: Board) -> list[str]:
    found = Axe().run(board.page).response["violations"]
    return [f"{one['id']}: {node['html'][:120]}" for one in found for node in one["nodes"]]


@pytest.mark.parametrize("scheme", ["light", pytest.param("dark", marks=pytest.mark.slow)])
def test_axe_finds_nothing_in_any_state(open_board: OpenBoard, scheme: str) -> None:
    board = open_board(scene=None, color_scheme=scheme, allow=("422",))
    page = board.page
    found = {"example": complaints(board)}
    # Another model that knows all of the example's labels.
    references = [str(one.get_attribute("value")) for one in page.locator("#second option").all()]
    (second,) = [name for name in references if name.startswith("places-rbm@")]
    page.get_by_label("compare with").select_option(second)
    page.locator("#list .name").first.click()
    board.use_positions()
    board.column("missing").get_by_text("Send this request from a program").click()
    found["two models, form, calls"] = complaints(board)
    page.get_by_role("button", name="Actions for bed").click()
    found["menu"] = complaints(board)
    page.keyboard.press("Escape")
    for tab in ("Wrong", "Relations", "Where", "Generate"):
        board.tab(tab)
        found[tab] = complaints(board)
    board.click("Generate a scene")
    found["drawn"] = complaints(board)
    page.get_by_role("button", name="Discard").click()
    page.get_by_role("combobox", name="Add an object").fill("la")
    found["search"] = complaints(board)
    page.get_by_role("combobox", name="Add an object").press("Escape")
    page.get_by_role("button", name="Import, export").click()
    found["dialog"] = complaints(board)
    page.get_by_role("button", name="Close").click()
    board.tab("Missing")
    board.put('{"objects": ["bed", "fridgee", "qwxzkvj"], "room_type": "submarine"}')
    found["unknown"] = complaints(board)
    page.get_by_role("button", name="Clear").click()
    found["empty"] = complaints(board)
    assert {state: found[state] for state in found if found[state]} == {}


@pytest.mark.slow
def test_everything_can_be_done_by_keyboard(board: Board) -> None:
    page = board.page
    press = page.keyboard.press
    page.evaluate("document.activeElement.blur()")
    press("Tab")
    assert focus(board) == "Skip to the answers"
    search = page.get_by_role("combobox", name="Add an object")
    for _ in range(12):
        if search.evaluate("(node) => node === document.activeElement"):
            break
        press("Tab")
    page.keyboard.type("lapt")
    press("ArrowDown")
    press("Enter")
    board.settle()
    assert board.things == ["desk", "chair", "laptop"]
    # On the board: to the object, move it, turn it, ask from its menu.
    board.thing("laptop").focus()
    press("ArrowUp")
    board.settle()
    before = board.scene["objects"][-1]["position"]
    for key in ("ArrowUp", "ArrowLeft", "Shift+ArrowLeft", "Alt+ArrowDown", "r"):
        press(key)
    board.settle()
    laptop = board.scene["objects"][-1]
    assert laptop["position"]["x"] == pytest.approx(before["x"] + 0.09, abs=1e-6)
    assert laptop["position"]["y"] == pytest.approx(before["y"] + 0.6, abs=1e-6)
    assert laptop["orientation"]["z"] > 0
    assert focus(board).startswith("laptop, ")
    press("Enter")
    assert focus(board) == "What is missing on top of it?"
    for _ in range(3):
        press("ArrowDown")
    assert focus(board) == "What is missing left of it?"
    press("Enter")
    board.settle()
    assert board.body("missing")["at"] == {"relation": "left", "object": "laptop"}
    assert focus(board).startswith("laptop, ")
    press("Delete")
    board.settle()
    assert board.things == ["desk", "chair"]
    assert focus(board).startswith(("desk, ", "chair, "))
    press("Control+z")
    board.settle()
    assert board.things == ["desk", "chair", "laptop"]
    # Questions are tabs; suggestions are accepted by Enter.
    page.get_by_role("tab", name="Missing").focus()
    press("ArrowRight")
    expect(page.get_by_role("tab", name="Wrong")).to_have_attribute("aria-selected", "true")
    press("End")
    expect(page.get_by_role("tab", name="Generate")).to_have_attribute("aria-selected", "true")
    press("Home")
    board.settle()
    count = len(board.things)
    page.locator("[data-question=missing] .icon").first.focus()
    press("Enter")
    board.settle()
    assert len(board.things) == count + 1
    assert focus(board) != ""


def test_answers_and_movements_are_announced(board: Board, api: httpx.Client) -> None:
    best = api.post("/missing", json=board.scene).json()["missing"][0]["label"]
    assert f"Most likely missing: {best}" in board.announced
    board.thing("chair").focus()
    board.page.keyboard.press("ArrowUp")
    expect(board.page.locator("#live")).to_contain_text("chair: x 1.10, y 0.00")
    board.page.keyboard.press("r")
    expect(board.page.locator("#live")).to_contain_text("rotated to 15 degrees")
