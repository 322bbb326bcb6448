"""A person confirms recorded scenes, and the corrected file goes back to the robot."""

import json
import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import Route, expect

from scene_client import Client
from tests.browser.conftest import DESK
from tests.browser.driving import Board, OpenBoard
from training.datasets.jsonl import read_jsonl

pytestmark = pytest.mark.system

KITCHEN = ["oven", "refrigerator", "microwave", "kitchen cabinet", "sink", "toilet"]


@pytest.fixture
def recorded(api: httpx.Client, tmp_path: Path) -> Path:
    """A file that a robot has recorded: scene 2 has a toilet and a microwave on the floor."""
    file = tmp_path / "scenes.jsonl"
    with Client(str(api.base_url), record=file) as scene:
        scene.missing(["bed", "nightstand", "lamp"], room_type="bedroom")
        scene.outliers(
            [
                {
                    "id": f"track_{n}",
                    "label": label,
                    "position": {"x": 1.5 + n % 2, "y": 0.9 * n - 2.2, "z": 0.4567},
                    "size": {"x": 0.61, "y": 0.6, "z": 0.9},
                    "orientation": {"x": 0.0, "y": 0.0, "z": 0.6, "w": 0.8},
                }
                for n, label in enumerate(KITCHEN)
            ],
            frame_id="map",
            viewpoint={"x": 0.1, "y": 0.2, "yaw": 0.3},
            stamp={"sec": 1_790_000_000, "nanosec": 7},
        )
        scene.outliers(["bathtub", "towel", {"label": "soap", "supported_by": "bathtub"}])
    return file


def choose(board: Board, file: Path, line: int) -> None:
    board.open_file(file)
    board.page.locator("#which").fill(str(line))
    board.click("Put on the board")


def downloaded(board: Board, tmp_path: Path, confirmed: int, name: str = "scenes.jsonl") -> Path:
    board.click("Import, export")
    button = board.page.get_by_role("button", name=f"Download {name} ({confirmed} confirmed)")
    with board.page.expect_download() as download:
        button.click()
    assert download.value.suggested_filename == name
    file = tmp_path / "downloaded" / name
    download.value.save_as(file)
    board.click("Close")
    return file


def lines(file: Path) -> list[Any]:
    return [json.loads(line) for line in file.read_text("utf-8").splitlines()]


def misplace(board: Board, subject: str, relation: str, other: str) -> None:
    wrong = {"subject": subject, "relation": relation, "object": other, "log_odds": -3.0}
    wrong |= {"probability": 0.9, "is_misplaced": True, "moved": None, "expected": None}
    board.alter("outliers", lambda found: found | {"misplaced": [wrong]})


def test_a_confirmed_scene_is_marked(board: Board, recorded: Path, tmp_path: Path) -> None:
    choose(board, recorded, 2)
    board.tab("Wrong")
    confirmed = board.page.get_by_text("Confirmed scene.")
    confirm = board.page.get_by_role("button", name="Belongs here: toilet")
    confirm.focus()
    board.page.keyboard.press("Enter")
    board.settle()
    assert board.announced.startswith("toilet (track_5) confirmed.")
    expect(confirm).to_have_count(0)
    assert any("confirmed" in row for row in board.rows("outliers") if "toilet" in row)
    expect(board.page.locator("#board .object.outlier")).to_have_count(0)
    spoken = board.thing("toilet (track_5)").get_attribute("aria-label")
    assert "does not belong here" not in (spoken or "")
    expect(confirmed).to_be_hidden()
    board.click("Stands right: microwave (track_2) on top of floor")
    assert "adapt learns" in next(row for row in board.rows("outliers") if "on top of floor" in row)
    expect(confirmed).to_be_visible()
    file = downloaded(board, tmp_path, 1)
    before, after = lines(recorded), lines(file)
    assert after == [before[0], before[1] | {"confirmed": True}, before[2]]
    scenes = read_jsonl(recorded)
    assert read_jsonl(file) == [scenes[0], replace(scenes[1], confirmed=True), scenes[2]]
    # The corrected file opens with the correction.
    choose(board, file, 2)
    assert downloaded(board, tmp_path, 1).read_text("utf-8") == file.read_text("utf-8")


def test_an_intruder_is_removed(board: Board, recorded: Path, tmp_path: Path) -> None:
    choose(board, recorded, 2)
    board.press("toilet (track_5)", "Delete")
    board.click("This scene is right")
    expect(board.page.get_by_text("Confirmed scene.")).to_be_visible()
    board.click("Next scene (3 of 3)")
    expect(board.page.get_by_text("Confirmed scene.")).to_be_hidden()
    assert "bathtub" in " ".join(board.things)
    expect(board.page.get_by_role("button", name="Next scene")).to_be_hidden()
    before, after = lines(recorded), lines(downloaded(board, tmp_path, 1))
    kept = before[1] | {"objects": before[1]["objects"][:-1], "confirmed": True}
    assert after == [before[0], kept, before[2]]


def test_missing_objects_are_added(board: Board, recorded: Path, tmp_path: Path) -> None:
    choose(board, recorded, 1)
    label = board.page.get_by_role("button", name="Is there: ").first.get_attribute("aria-label")
    added = (label or "").removeprefix("Is there: ")
    board.page.get_by_role("button", name=f"Is there: {added}", exact=True).click()
    board.settle()
    assert board.things[-1] == added
    board.press("lamp", "Delete")
    (first, *others) = lines(downloaded(board, tmp_path, 1))
    before = lines(recorded)
    assert others == before[1:]
    assert first["objects"] == [*before[0]["objects"][:2], {"id": added, "label": added}]
    board.click("Undo")
    board.click("Undo")
    assert board.things == ["bed", "nightstand", "lamp"]
    board.click("Import, export")
    expect(board.page.get_by_role("button", name="Download scenes.jsonl")).to_be_hidden()


def test_scenes_of_the_page_stay_in_the_browser(open_board: OpenBoard, tmp_path: Path) -> None:
    lamp = {"label": "lamp", "position": [2, 0.5, 0.94], "size": [0.2, 0.2, 0.4]}
    scene = {"objects": [DESK["objects"][0], lamp], "frame_id": "map", "room_type": "office"}
    board = open_board(scene | {"viewpoint": {"x": 1, "y": 0, "yaw": 0}})
    misplace(board, "lamp", "on-top", "desk")
    board.add("cup")
    board.tab("Wrong")
    assert ("misplaced", "on top of?") in board.edges
    board.click("Stands right: lamp on top of desk")
    assert board.edges == []
    assert any("lamp on top of desk confirmed" in row for row in board.rows("outliers"))
    board.page.reload()
    board.settle()
    file = downloaded(board, tmp_path, 1)
    (scene,) = lines(file)
    assert scene["confirmed"] is scene["viewer_frame"] is True
    assert scene["room_type"] == "office"
    assert scene["objects"] == [
        {"id": "desk", "label": "desk", "position": [1, 0, 0.37], "size": [0.8, 1.6, 0.74]},
        {"id": "lamp", "label": "lamp", "position": [1, 0.5, 0.94], "size": [0.2, 0.2, 0.4]},
        {"id": "cup", "label": "cup"},
    ]
    assert scene["scene_id"].startswith(scene["group"])
    assert read_jsonl(file)[0].viewer_frame
    board.click("Import, export")
    board.click("Remove 1 confirmed from this browser")
    expect(board.page.get_by_role("button", name="Download scenes.jsonl")).to_be_hidden()
    board.page.reload()
    board.settle()
    assert board.page.evaluate("Object.keys(localStorage)") == []


def test_alarms_need_a_confirmation(board: Board, recorded: Path, tmp_path: Path) -> None:
    misplace(board, "track_0", "left", "track_1")
    choose(board, recorded, 2)
    board.tab("Wrong")
    board.click("Stands right: oven (track_0) left of refrigerator (track_1)")
    expect(board.page.locator("#confirmed")).to_have_text(
        "The scene is not confirmed yet. 1 more alarm is open: confirm or remove. "
        "Then choose “This scene is right”."
    )
    assert board.page.evaluate("Object.keys(localStorage)") == []
    board.press("toilet (track_5)", "Delete")
    board.click("This scene is right")
    after = lines(downloaded(board, tmp_path, 1))
    assert [line.get("confirmed", False) for line in after] == [False, True, False]
    assert "toilet" not in [thing["label"] for thing in after[1]["objects"]]


def test_the_list_of_scenes_marks_alarms(board: Board, recorded: Path) -> None:
    choose(board, recorded, 1)
    scenes, status = board.page.locator("#scenes-of-file"), board.page.locator("#file-status")
    first, second, _ = (line["scene_id"] for line in lines(recorded))
    open_one = "0 of 2 habits confirmed. 1 of 3 scenes with an open alarm."
    expect(status).to_have_text(f"{open_one} On the board: {first}.")
    marked = f"2 · ⚠ toilet, place of microwave · {second}"  # `adapt` names scenes by their id
    expect(scenes.locator("option").nth(1)).to_have_text(marked)
    board.click("Next alarm (scene 2)")
    board.click("Belongs here: toilet")
    board.click("Stands right: microwave")
    expect(scenes.locator("option:checked")).to_have_text(f"2 · ✓ confirmed · {second}")
    open_none = "2 of 2 habits confirmed. 0 of 3 scenes with an open alarm."
    expect(status).to_have_text(f"{open_none} On the board: {second}.")
    expect(board.page.locator("#enough")).to_contain_text("Enough is confirmed")
    expect(board.page.get_by_role("button", name="Next alarm")).to_be_hidden()
    scenes.select_option("0")
    board.settle()
    assert board.things == ["bed", "nightstand", "lamp"]
    scenes.select_option("1")
    board.tab("Wrong")
    assert any("confirmed" in row for row in board.rows("outliers") if "toilet" in row)


@pytest.fixture
def visits(tmp_path: Path) -> Path:
    """A file with several visits of two rooms: a toilet and a bathtub are in the kitchen."""
    kitchen, bedroom = ["refrigerator", "stove", "sink"], ["bed", "nightstand", "wardrobe"]
    scenes = [
        ("kitchen", [*kitchen, "toilet"]),
        ("bedroom", [*bedroom, "lamp"]),
        ("kitchen", [*kitchen, "microwave", "toilet"]),
        ("kitchen", [*kitchen, "oven", "toilet", "bathtub"]),
        ("bedroom", [*bedroom, "toilet"]),
    ]
    file = tmp_path / "visits.jsonl"
    lines = [
        {"scene_id": f"visit {n}", "group": "g", "room_type": room, "objects": labels}
        for n, (room, labels) in enumerate(scenes, 1)
    ]
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), "utf-8")
    return file


def marks(board: Board) -> list[str]:
    """What the list says about each scene, without number, room type and name."""
    options = board.page.locator("#scenes-of-file option").all_inner_texts()
    return [" · ".join(words.split(" · ")[2:-1]) for words in options]


def test_one_confirmation_covers_a_habit(board: Board, visits: Path, tmp_path: Path) -> None:
    page, enough = board.page, board.page.locator("#enough")
    status = page.locator("#file-status")
    choose(board, visits, 1)
    board.tab("Wrong")
    expect(status).to_contain_text("0 of 3 habits confirmed. 4 of 5 scenes with an open alarm.")
    assert marks(board) == ["⚠ toilet", "", "⚠ toilet", "⚠ toilet, bathtub", "⚠ toilet"]
    expect(enough).to_be_hidden()
    board.click("Belongs here: toilet")
    expect(status).to_contain_text("1 of 3 habits confirmed. 2 of 5 scenes with an open alarm.")
    # The toilet of the bedroom is another habit.
    assert marks(board) == ["✓ confirmed", "", "✓ covered by scene 1", "⚠ bathtub", "⚠ toilet"]
    page.locator("#scenes-of-file").select_option("2")
    board.settle()
    (row,) = [row for row in board.rows("outliers") if row.startswith("toilet")]
    assert "✓ covered by scene 1" in row
    expect(page.get_by_role("button", name="Belongs here: toilet")).to_have_count(0)
    expect(page.locator("#board .object.outlier")).to_have_count(0)
    expect(page.locator("#alarms")).to_be_hidden()
    # A covered alarm does not keep a scene open.
    board.click("Next alarm (scene 4)")
    board.click("Belongs here: bathtub")
    expect(page.get_by_text("Confirmed scene.")).to_be_visible()
    # A removed object is no habit.
    board.click("Next alarm (scene 5)")
    board.press("toilet", "Delete")
    board.click("This scene is right")
    expect(status).to_contain_text("2 of 2 habits confirmed. 0 of 5 scenes with an open alarm.")
    expect(enough).to_have_text("Enough is confirmed: adapt the model now (docs/own-home.md).")
    assert Axe().run(page).response["violations"] == []
    saved = lines(downloaded(board, tmp_path, 3, "visits.jsonl"))
    assert [line.get("confirmed", False) for line in saved] == [True, False, False, True, True]
    # Undo opens the alarm again.
    board.click("Undo")
    expect(enough).to_be_hidden()
    assert marks(board)[-1] == "⚠ toilet"


def test_a_habit_is_confirmed_once_in_a_scene(open_board: OpenBoard) -> None:
    toilets = [{"id": f"toilet_{n}", "label": "toilet"} for n in (1, 2)]
    board = open_board({"objects": ["stove", "refrigerator", "sink", *toilets]})
    board.alter("outliers", with_alarms("toilet_1", "toilet_2", "stove"))
    board.tab("Wrong")
    board.page.get_by_label("Sensitivity").select_option("low")
    board.settle()
    board.click("Belongs here: toilet_2")
    rows = [row for row in board.rows("outliers") if row.startswith("toilet")]
    assert ["✓ covered by toilet_2" in row for row in sorted(rows)] == [True, False]
    expect(board.page.locator("#confirmed")).to_contain_text("1 more alarm is open")
    board.click("Belongs here: stove")
    expect(board.page.get_by_text("Confirmed scene.")).to_be_visible()


def with_alarms(*names: str) -> Callable[[Any], Any]:
    """Return a change of an answer that raises an alarm at these objects only."""
    return lambda found: (
        found
        | {
            "outliers": [one | {"is_outlier": one["object"] in names} for one in found["outliers"]],
            "misplaced": [],
        }
    )


def record_on_service(board: Board, *, status: int = 200) -> list[dict[str, Any]]:
    """Give the service the route of confirmed scenes, and return the list of their bodies."""
    sent = list[dict[str, Any]]()

    def with_route(route: Route) -> None:
        response = route.fetch()
        document = response.json()
        document["paths"] |= {"/confirm": {}}
        route.fulfill(response=response, json=document)

    def confirm(route: Route) -> None:
        sent.append(json.loads(route.request.post_data or ""))
        problem = {"title": "Not recorded", "status": status, "detail": "The disk is full."}
        answer = {"request_id": "r", "scene_id": f"recorded-{len(sent)}"}
        route.fulfill(status=status, json=answer if status == 200 else problem)

    board.page.route("**/openapi.json", with_route)
    board.page.route("**/confirm", confirm)
    return sent


def test_the_service_records_confirmed_scenes(board: Board, recorded: Path) -> None:
    sent = record_on_service(board)
    choose(board, recorded, 3)
    board.click("This scene is right")
    confirmed = board.page.locator("#confirmed")
    expect(confirmed).to_have_text("Confirmed scene. The service has recorded it.")
    (body,) = sent
    line = lines(recorded)[2]
    assert body["confirmed"] is True
    assert body["objects"] == line["objects"]
    assert body["unknown_labels"] == "by-meaning"
    board.click("Undo")
    expect(confirmed).to_contain_text("still has this scene as confirmed (recorded-1)")
    # The last change counts. A scene that leaves the board is sent at once.
    choose(board, recorded, 2)
    board.click("This scene is right")
    board.press("toilet (track_5)", "Delete")
    with board.page.expect_request("**/confirm"):
        board.click("Next scene (3 of 3)")
    assert len(sent) == 2
    assert [thing["label"] for thing in sent[1]["objects"]] == KITCHEN[:-1]
    assert sent[1]["viewer_frame"] is True


def test_a_scene_that_the_service_refuses(open_board: OpenBoard) -> None:
    board = open_board(allow=("503",))
    record_on_service(board, status=503)
    board.page.get_by_role("button", name="Is there: ").first.click()
    expect(board.page.locator("#confirmed")).to_have_text(
        "Confirmed scene. The service refuses it: The disk is full."
    )


def test_other_services_get_no_confirmed_scene(board: Board) -> None:
    routes = list[str]()
    board.page.on("request", lambda one: routes.append(one.url))
    with board.page.expect_request("**/openapi.json"):
        board.page.get_by_role("button", name="Is there: ").first.click()
    board.settle()
    board.click("Clear")
    expect(board.page.locator("#confirmed")).to_be_hidden()
    assert not any(url.endswith("/confirm") for url in routes)


def test_additions_are_confirmed(board: Board, recorded: Path, tmp_path: Path) -> None:
    choose(board, recorded, 1)
    board.add("oven")
    board.tab("Wrong")
    assert any("oven" in row and "Belongs here" in row for row in board.rows("outliers"))
    board.press("oven", "Delete")
    board.click("This scene is right")
    board.add("oven")
    rows = [row for row in board.rows("outliers") if "Places are not judged" not in row]
    assert len(rows) == 4
    assert all("confirmed" in row for row in rows)
    expect(board.page.locator("#alarms")).to_be_hidden()
    expect(board.page.locator("#board .object.outlier")).to_have_count(0)
    saved, *_ = lines(downloaded(board, tmp_path, 1))
    assert [thing.get("label") for thing in saved["objects"][3:]] == ["oven"]
    choose(board, recorded, 1)
    assert sum("confirmed" in row for row in board.rows("outliers")) == 4


def test_a_download_has_one_file(board: Board, recorded: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "flat.jsonl", tmp_path / "office.jsonl"
    first.write_text(recorded.read_text("utf-8"), "utf-8")
    scenes = [{"scene_id": name, "objects": ["desk", "lamp"]} for name in "ab"]
    second.write_text("".join(f"{json.dumps(scene)}\n" for scene in scenes), "utf-8")
    choose(board, first, 1)
    board.click("This scene is right")
    choose(board, second, 2)
    board.click("This scene is right")
    saved = lines(downloaded(board, tmp_path, 1, "office.jsonl"))
    confirmed = [(line["scene_id"], "confirmed" in line) for line in saved]
    assert confirmed == [("a", False), ("b", True)]
    # A scene that is drawn by hand goes with the opened file.
    board.click("Clear")
    board.add("sofa")
    board.page.get_by_role("button", name="Is there: ").first.click()
    board.settle()
    board.click("Import, export")
    expect(board.page.locator("#share-done")).to_contain_text("Confirmed scenes of other files: 1.")
    board.click("Close")
    saved = lines(downloaded(board, tmp_path, 2, "office.jsonl"))
    assert [len(line["objects"]) for line in saved] == [2, 2, 2]
    choose(board, first, 2)
    saved = lines(downloaded(board, tmp_path, 1, "flat.jsonl"))
    assert [line.get("confirmed", False) for line in saved] == [True, False, False]


def test_the_selected_object_is_visible_in_a_long_list(open_board: OpenBoard) -> None:
    board = open_board({"objects": [f"book {n}" for n in range(1, 41)] + ["toilet"]})
    board.tab("Wrong")
    page, row = board.page, board.page.locator("#list li").last
    inside = """row => {
      const [own, list] = [row, row.parentElement].map((node) => node.getBoundingClientRect());
      return own.top >= list.top - 1 && own.bottom <= list.bottom + 1;
    }"""
    assert not row.evaluate(inside)
    page.evaluate("scrollTo(0, 0)")
    page.locator("[data-key='of-toilet']").evaluate("node => node.click()")
    board.settle()
    expect(row).to_have_class(re.compile("selected"))
    assert row.evaluate(inside)
    assert page.evaluate("scrollY") == 0


@pytest.mark.parametrize("width", [1300, 390])
def test_the_buttons_are_accessible(board: Board, recorded: Path, width: int) -> None:
    board.page.set_viewport_size({"width": width, "height": 900})
    choose(board, recorded, 2)
    for tab, button in (("Wrong", "Belongs here: toilet"), ("Missing", "Is there: ")):
        board.tab(tab)
        shown = board.page.get_by_role("button", name=button).first
        shown.evaluate("node => node.scrollIntoView({ block: 'center' })")
        expect(shown).to_be_in_viewport(ratio=1)
        assert Axe().run(board.page).response["violations"] == []
    board.page.get_by_role("button", name="Is there: ").first.click()
    board.click("Import, export")
    assert Axe().run(board.page).response["violations"] == []


@pytest.mark.parametrize("dismissed", [True, False])
def test_an_open_page_notices_a_new_model(board: Board, dismissed: bool) -> None:
    """The page lists the models again when its window gets the focus."""
    choice = board.page.locator("#model option", has_text="home 1.0.0")
    expect(choice).to_have_count(0)

    def with_home(route: Route) -> None:
        response = route.fetch()
        found = response.json()
        home = found["models"][0] | {"name": "home"}
        home["versions"] = [home["versions"][0] | {"version": "1.0.0"}]
        route.fulfill(response=response, json=found | {"models": [*found["models"], home]})

    board.page.route("**/models", with_home)
    board.page.evaluate("dispatchEvent(new Event('focus'))")
    news = board.page.locator("#news")
    expect(news).to_contain_text("The service has new models: home 1.0.0.")
    expect(choice).to_have_count(1)
    assert board.things == ["desk", "chair"]
    if dismissed:
        board.click("Dismiss")
        expect(board.page.locator("#model")).to_be_focused()
    else:
        board.page.locator("#second").select_option(index=2)
    expect(news).to_be_hidden()


def test_an_answer_of_another_version_reloads_the_models(board: Board) -> None:

    def promoted(route: Route) -> None:
        response = route.fetch()
        found = response.json()
        found["aliases"]["default"] = "places-rbm@" + next(
            model["versions"][0]["version"]
            for model in found["models"]
            if model["name"] == "places-rbm"
        )
        route.fulfill(response=response, json=found)

    board.page.route("**/models", promoted)
    other = {"name": "places-rbm"}
    board.alter("missing", lambda found: found | {"model": found["model"] | other})
    board.add("cup")
    expect(board.page.locator("#news")).to_contain_text("default is now places-rbm")
