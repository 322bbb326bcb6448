"""Superseded questions, refusals, keys, restarts, and unknown labels."""

import re
import signal
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Route, expect

from app.registry import AliasTarget, Store
from tests.browser.driving import Board, OpenBoard
from tests.services import LiveService, launch, wait_until

pytestmark = pytest.mark.system

EIGHT_STEPS = """
const press = {key: 'ArrowUp', bubbles: true};
for (let step = 0; step < 8; step += 1)
  document.activeElement.dispatchEvent(new KeyboardEvent('keydown', press));
"""


@pytest.mark.slow
def test_a_superseded_question_is_dropped(board: Board) -> None:
    routes, held = list[str](), list[Route]()

    def hold_first(route: Route) -> None:
        routes.append(route.request.url)
        if held:
            route.continue_()
        else:
            held.append(route)

    board.page.route("**/missing", hold_first)
    board.thing("chair").focus()
    with board.page.expect_request("**/missing"):
        board.page.evaluate(EIGHT_STEPS)
    with board.page.expect_event("requestfailed", lambda one: one.url.endswith("/missing")):
        board.page.keyboard.press("ArrowUp")
    board.settle()
    assert len(routes) == 2
    assert board.scene["objects"][1]["position"]["x"] == pytest.approx(1.9)
    assert board.rows("missing")


@pytest.mark.slow
def test_the_page_retries_after_429(open_board: OpenBoard) -> None:
    board = open_board(allow=("429",))
    routes = list[Route]()

    def refuse_first_and_hold_second(route: Route) -> None:
        routes.append(route)
        if len(routes) > 1:
            return
        problem = {"type": "/problems/queue-full", "title": "Queue full", "status": 429}
        problem |= {"detail": "The queue is full.", "request_id": "r"}
        route.fulfill(status=429, json=problem, headers={"Retry-After": "1"})

    board.page.route("**/missing", refuse_first_and_hold_second)
    box = board.page.get_by_role("combobox", name="Add an object")
    box.fill("laptop")
    box.press("Enter")
    alert = board.column("missing").get_by_role("alert")
    expect(alert).to_contain_text("The queue is full")
    for _ in range(600):
        if len(routes) == 2:
            break
        board.page.wait_for_timeout(100)
    routes[1].continue_()
    expect(alert).to_be_hidden()
    board.settle()
    assert board.rows("missing")


@pytest.mark.slow
def test_the_service_restarts(open_board: OpenBoard, repository: Path, tmp_path: Path) -> None:
    store = repository / "model_store"
    with launch(store, tmp_path / "log") as mortal:
        board = open_board(home=mortal.url, allow=("ERR_", "503"))
        mortal.process.kill()
        mortal.process.wait()
        board.add("laptop")
        expect(board.page.get_by_role("alert").first).to_contain_text("does not answer")
        assert board.things == ["desk", "chair", "laptop"]
    with launch(store, tmp_path / "log2", port=mortal.port):
        expect(board.page.locator("#banner")).to_be_hidden()
        board.settle()
        assert len(board.body("missing")["objects"]) == 3
        assert board.rows("missing")


@pytest.mark.slow
def test_the_page_sends_the_key(open_board: OpenBoard, repository: Path, tmp_path: Path) -> None:
    key = "a-key-of-sixteen-letters"
    with launch(repository / "model_store", tmp_path / "log", SCENE_API_KEY=key) as guarded:
        home = f"http://127.0.0.1:{guarded.port}"
        board = open_board(scene=None, home=home, allow=("401",))
        assert board.things == []
        board.page.get_by_label("API key").first.fill(key)
        board.page.get_by_label("API key").first.press("Enter")
        # The page opens with an example as soon as the service answers.
        expect(board.column("missing").locator("ol > li")).not_to_have_count(0)
        assert board.things
        assert '-H "X-API-Key: $SCENE_API_KEY"' in board.curl("missing")
        assert key not in board.page.content()


def notes(board: Board, place: int) -> str:
    return board.page.locator("#list li").nth(place).locator(".error").text_content() or ""


@pytest.fixture(scope="module")
def own(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LiveService]:
    """A service with a model of all 16 classes with examples, and small models without."""
    from tests.http.stores import publish

    folder = tmp_path_factory.mktemp("own")
    for name, classes in (("basic", 6), ("lab", 16), ("small", 10)):
        publish(folder / "store", name, "1.0.0", classes=classes, alias=f"my-{name}")
    with launch(folder / "store", folder / "log", SCENE_STORE_POLL="0") as service:
        yield service


def promote(service: LiveService, model: str) -> None:
    log = service.log.read_text()
    Store(service.log.parent / "store").set_alias("default", AliasTarget.of(model))
    service.process.send_signal(signal.SIGHUP)
    wait_until(lambda: "the alias default names" in service.log.read_text()[len(log) :])


# The first test of the service, which moves the alias.
@pytest.mark.parametrize("has_default", [False, True])
def test_own_models_are_shown(open_board: OpenBoard, own: LiveService, has_default: bool) -> None:
    if has_default:
        promote(own, "basic")
    words = own.client.get("/models/basic/vocabulary").json()["objects"]
    board = open_board(scene=None, home=own.url, examples=None)
    assert board.things == [one["label"] for one in words[:4]]
    assert board.rows("missing")
    expect(board.page.locator("#note")).to_contain_text("no example scenes")
    expect(board.page.locator("#example")).to_be_hidden()
    expect(board.page.locator(".problem:visible, .error:visible")).to_have_count(0)


def test_unknown_names_are_mapped_or_left_out_visibly(open_board: OpenBoard) -> None:
    scene = {"objects": ["bed", "fridgee", "qwxzkvj", "tractor"], "room_type": "bedrom"}
    board = open_board(scene, allow=("422",))
    assert notes(board, 0) == ""
    assert notes(board, 1) == "fridgee → fridge?"
    assert notes(board, 2) == "qwxzkvj not known, left out"
    assert notes(board, 3).startswith("tractor read by its meaning, like ")
    expect(board.page.locator("#room-error")).to_have_text("bedrom → bedroom?")
    board.tab("Wrong")  # Suggestions take the room of names.
    names = board.page.locator("#board .labels text.name").all_text_contents()
    board.tab("Missing")
    assert {"fridgee → fridge?", "qwxzkvj", "tractor"} < set(names)
    assert [thing["label"] for thing in board.scene["objects"]] == scene["objects"]
    expect(board.thing("qwxzkvj")).to_have_class(re.compile("unknown"))
    expect(board.page.locator("#legend .unknown")).to_have_text("not known to the model, left out")
    assert board.rows("missing")
    expect(board.column("missing")).to_contain_text("fridgee → fridge? qwxzkvj not known")
    board.page.locator("#room").select_option("bedroom")
    board.click("Remove qwxzkvj")
    board.click("Remove tractor")
    board.page.get_by_role("button", name="Rename fridgee to fridge").press("Enter")
    board.settle()
    assert board.things == ["bed", "fridge"]
    assert [thing["label"] for thing in board.scene["objects"]] == ["bed", "fridge"]
    expect(board.page.locator("#list .name").nth(1)).to_be_focused()
    expect(board.page.locator("#list .error:visible, #room-error:visible")).to_have_count(0)
    expect(board.column("missing").locator("header + .problem + p")).to_be_empty()
    board.put('{"objects": ["qwxzkvj"]}')
    assert notes(board, 0) == "qwxzkvj not known, left out"
    expect(board.thing("qwxzkvj")).to_have_class(re.compile("unknown"))
    board.put('{"objects": ["bed"], "room_type": "submarine"}')
    expect(board.page.locator("#room-error")).to_contain_text("submarine not known, left out")
    assert board.rows("missing")
    board.tab("Generate")
    board.click("Generate a scene")
    problem = board.page.locator(".problem:visible")
    expect(problem).to_contain_text("the model does not know this room type")
