"""Files on the page: requests and recordings stay in the browser, the service reads the others."""

import json
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard
from tests.client.scene_files import EXAMPLES
from tests.services import wait_until

pytestmark = pytest.mark.system

QUESTIONS = {"missing", "outliers", "relations", "rooms"}


def posted(board: Board) -> list[str]:
    """The list of what the page posts from now on: routes, in order."""
    routes = list[str]()
    board.page.on(
        "request", lambda one: one.method == "POST" and routes.append(urlsplit(one.url).path[1:])
    )
    return routes


REQUEST = {"objects": ["bed", {"label": "lamp", "supported_by": "bed"}], "room_type": "bedroom"}
LINE = {"scene_id": "a", "objects": [{"id": 0, "label": "bed"}], "counts": {"bed": 1}}


@pytest.mark.parametrize(
    ("name", "content", "routes"),
    [
        ("request.json", json.dumps(REQUEST, indent=1), QUESTIONS),
        ("labels.json", '["bed", "lamp"]', QUESTIONS),
        ("scenes.jsonl", json.dumps(LINE) + "\n\n", QUESTIONS),
        ("scenes.jsonl", f"{json.dumps(LINE)}\n" * 2, QUESTIONS | {"outliers/batch"}),
        # A recording whose last line is cut off, and a broken request.
        ("scenes.jsonl", f"{json.dumps(LINE)}\n{json.dumps(LINE)[:-9]}", QUESTIONS),
        ("request.json", json.dumps(REQUEST)[:-1], set()),
    ],
)
def test_requests_stay_in_the_browser(board, tmp_path, name, content, routes):
    sent = posted(board)
    (tmp_path / name).write_text(content)
    board.open_file(tmp_path / name)
    expect(board.page.locator("#travels")).to_be_hidden()
    board.click("Put on the board")
    wait_until(lambda: board.page.wait_for_timeout(10) or set(sent) == routes)
    if routes:
        assert board.things[0].startswith("bed")
    else:
        expect(board.page.locator("#json-error")).to_contain_text("neither JSON nor JSON lines")


@pytest.mark.parametrize(
    "name", ["detections.csv", "labels.txt", "detection3d.json", "moveit.json"]
)
def test_the_service_reads_other_formats(board: Board, tmp_path: Path, name: str) -> None:
    sent = posted(board)
    (tmp_path / name).write_text(EXAMPLES[name].text, "utf-8")
    board.open_file(tmp_path / name)
    expect(board.page.locator("#travels")).to_contain_text("sends the text to it")
    assert sent == []
    board.click("Put on the board")
    assert sent.count("scenes") == 1
    wait_until(lambda: board.page.wait_for_timeout(10) or set(sent) == {"scenes", *QUESTIONS})
    expected = EXAMPLES[name].request["objects"]
    names = [one if isinstance(one, str) else one["id"] for one in expected]
    assert [thing["id"] for thing in board.exported()["objects"]] == names


def test_scenes_and_class_ids_of_a_file(board: Board) -> None:
    page = board.page
    sent = posted(board)
    results = json.loads(EXAMPLES["coco_results.json"].text)
    several = [*results, results[0] | {"image_id": 43}, results[1] | {"category_id": 12}]
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Scene, JSON").fill(json.dumps(several))
    page.get_by_label("Labels of numeric class ids").select_option("COCO, ids 1 to 90")
    board.click("Put on the board")
    expect(page.locator("#share-done")).to_have_text("The file has 2 scenes: choose one.")
    expect(page.locator("#scenes")).to_have_text("of 2: 42")
    board.click("Put on the board")
    assert board.things == ["chair_1", "dining table_1"]
    notes = page.get_by_role("region", name="Notes of the file")
    expect(notes).to_contain_text("The file was read with 1 note.")
    expect(notes).to_contain_text("class '12' has no label")
    assert sent.count("scenes") == 1
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Scene, JSON").fill(json.dumps(several))
    page.get_by_label("Labels of numeric class ids").select_option("own names")
    page.get_by_label("Names, one a line").fill('{"62": "stool"}')
    board.click("Put on the board")
    page.locator("#which").fill("2")
    expect(page.locator("#scenes")).to_have_text("of 2: 43")
    board.click("Put on the board")
    assert board.things == ["stool_1"]


MANY = [
    {"scene": 0, "detection": n, "reason": reason, "detail": f"class '{n}' is not read"}
    for reason, count in (("no-label", 25), ("unread", 2), ("<img src=x>", 1))
    for n in range(count)
]


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_notes_of_a_file(open_board: OpenBoard, tmp_path: Path, scheme: str) -> None:
    board = open_board(color_scheme=scheme)
    page = board.page
    page.set_viewport_size({"width": 390, "height": 844})
    board.alter("scenes", lambda found: found | {"notes": MANY})
    (tmp_path / "labels.txt").write_text("bed\nlamp\n")
    board.open_file(tmp_path / "labels.txt")
    page.get_by_role("button", name="Put on the board").click()
    expect(page.locator("#live")).to_contain_text("The file was read with 28 notes.")
    board.settle()
    notes = page.get_by_role("region", name="Notes of the file")
    kinds = ["Class ids without a label (25)", "Fields that are not read (2)", "<img src=x> (1)"]
    expect(notes.locator("summary")).to_have_text(kinds)
    # A fold opens by keyboard, and has a bounded length.
    notes.locator("summary").first.focus()
    page.keyboard.press("Enter")
    texts = notes.locator("details[open] li").all_inner_texts()
    assert (texts[0], len(texts), texts[-1]) == (
        "detection 0: class '0' is not read",
        21,
        "and 5 more",
    )
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    assert Axe().run(page).response["violations"] == []
    page.get_by_role("button", name="Dismiss the notes").press("Enter")
    expect(notes).to_be_hidden()
    expect(page.get_by_role("button", name="Import, export")).to_be_focused()
    # Another scene has no notes.
    board.open_file(tmp_path / "labels.txt")
    board.click("Put on the board")
    expect(notes).to_be_visible()
    board.put('["desk"]')
    expect(notes).to_be_hidden()


def test_a_large_file_is_read_without_showing_it(board: Board, tmp_path: Path) -> None:
    page = board.page
    path = tmp_path / "large.json"
    path.write_text(json.dumps(["bed", "lamp"]) + " " * 2**21)
    board.open_file(path)
    expect(page.locator("#share-done")).to_contain_text("large.json is open")
    expect(page.get_by_label("Scene, JSON")).to_have_value("")
    with path.open("r+b") as file:
        file.truncate(64 * 2**20 + 1)
    board.click("Put on the board")
    assert board.things == ["bed", "lamp"]
    board.open_file(path)
    expect(page.locator("#json-error")).to_contain_text("more than 64 MiB")
