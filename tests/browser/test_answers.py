"""The page shows the answers of the service, for every question and model."""

import json
import re
import sys
from typing import Any

import httpx
import pytest
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard, body_of, percent
from tests.conftest import run_program

pytestmark = pytest.mark.system

SPOKEN = {
    "left": "left of",
    "right": "right of",
    "front": "in front of",
    "behind": "behind",
    "on-top": "on top of",
    "under": "under",
    "above": "above",
    "below": "below",
    "inside": "in",
    "contains": "containing",
}


def reasons(because: list[dict[str, Any]], raised: int = 1) -> str:
    """Reasons as the page writes them. `raised` is -1 for an outlier."""
    sides = []
    for side, sign in (("for", raised), ("against", -raised)):
        names = [one["object"] for one in because if sign * one["log_odds_change"] > 0]
        if names:
            sides.append(f"{', '.join(names)} speak{'s' * (len(names) == 1)} {side} it")
    return "; ".join(sides)


def ask(api: httpx.Client, question: str, scene: dict[str, Any], **fields: Any) -> Any:
    response = api.post(f"/{question}", json=scene | fields)
    assert response.status_code == 200, response.text
    return response.json()


@pytest.fixture
def bedroom(open_board: OpenBoard) -> Board:
    """The first example: something is missing there, and something is wrong."""
    return open_board(scene=None)


def test_missing_objects_are_listed_with_their_places(bedroom: Board, api: httpx.Client) -> None:
    answer = ask(api, "missing", bedroom.scene, top_k=5)
    every = bedroom.rows("missing")
    rows = [row for row in every if not row.startswith("another ")]
    assert len(every) == 5 + len(answer["more"])
    for row, missing in zip(rows, answer["missing"], strict=True):
        assert row.startswith(f"{missing['label']} {percent(missing['probability'])}")
        best = next(iter(missing["placements"]), None)
        likely = best is not None and best["probability"] >= 0.25
        assert ("no likely place" in row) == (not likely)
        if best is not None:
            where = f"{SPOKEN[best['relation']]} {best['object']} {percent(best['probability'])}"
            assert (where in row) == likely
        placed = missing["label"] in bedroom.ghosts
        assert (likely and not placed) == ("no free place on the board" in row)
        assert reasons(missing["because"]) in row
    assert set(bedroom.ghosts) <= {one["label"] for one in answer["missing"]}


def test_a_ghost_becomes_an_object_where_it_was_drawn(bedroom: Board) -> None:
    ghost = bedroom.page.locator("#board .ghost").first
    label = ghost.locator("text").text_content() or ""
    drawn = ghost.locator("rect").bounding_box()
    ghost.press("Enter")
    bedroom.settle()
    assert bedroom.things[-1] == label
    box = bedroom.thing(label).locator(".box").bounding_box()
    focused = bedroom.page.evaluate("document.activeElement.getAttribute('aria-label')")
    assert focused.startswith(f"{label},")
    # The view may have grown by what is suggested next; the proportions stay.
    assert box["width"] / box["height"] == pytest.approx(drawn["width"] / drawn["height"], rel=0.05)
    assert all(label != row.split(" ")[0] for row in bedroom.rows("missing"))


def test_the_menu_of_an_object(bedroom: Board, api: httpx.Client) -> None:
    bedroom.click("Actions for nightstand")
    bedroom.page.get_by_role("menuitem", name="What is missing on top of it?").click()
    bedroom.settle()
    at = {"relation": "on-top", "object": "nightstand"}
    assert bedroom.body("missing")["at"] == at
    answer = ask(api, "missing", bedroom.scene, top_k=5, at=at)
    assert [row.split("%")[0] + "%" for row in bedroom.rows("missing")] == [
        f"{one['label']} {percent(one['probability'])}" for one in answer["missing"]
    ]
    expect(bedroom.page.locator("#at-words")).to_have_text("Missing on top of nightstand")
    names = [one.get_attribute("aria-label") for one in bedroom.page.locator("#board .ghost").all()]
    assert all("on top of nightstand" in str(name) for name in names)
    bedroom.click("Anywhere")
    assert "at" not in bedroom.body("missing")
    answer["missing"] = [one | {"placements": []} for one in answer["missing"]]
    bedroom.alter("missing", lambda _: answer)
    bedroom.click("Actions for nightstand")
    bedroom.page.get_by_role("menuitem", name="What is missing in it?").click()
    bedroom.settle()
    assert bedroom.body("missing")["at"] == {"relation": "inside", "object": "nightstand"}
    expect(bedroom.page.locator("#at-words")).to_have_text("Missing in nightstand")
    assert all("no likely place" in row for row in bedroom.rows("missing"))


def test_a_model_of_labels_alone(open_board: OpenBoard) -> None:
    objects = ["bed", "lamp", "desk"]
    board = open_board(scene=None, examples=[{"name": "A room", "scene": {"objects": objects}}])
    board.settle()
    places = [tuple((board.thing(name).bounding_box() or {}).values()) for name in objects]
    assert len(set(places)) == 3
    note = {"code": "not-judged", "message": "the model does not judge it", "objects": []}

    def of_labels(answer: Any) -> Any:
        """The answer of a model whose few training scenes have no relations."""
        lists = {key: [] for key in answer.keys() & {"relations", "outliers", "misplaced"}}
        missing = [one | {"placements": []} for one in answer.get("missing", [])]
        kept = {name: value for name, value in answer.items() if name != "threshold"}
        return kept | lists | ({"missing": missing} if missing else {"warnings": [note]})

    for question in ("missing", "outliers", "relations"):
        board.alter(question, of_labels)
    board.add("chair")
    rows = board.rows("missing")
    assert rows
    assert not any("place" in row for row in rows)
    for tab in ("Wrong", "Relations"):
        board.tab(tab)
        words = board.page.get_by_role("tabpanel", name=tab).inner_text()
        assert "Note: the model does not judge it." in words
        assert "NaN" not in words
        assert "is likely" not in words


def test_outliers_are_marked_with_reasons_in_words(bedroom: Board, api: httpx.Client) -> None:
    bedroom.tab("Wrong")
    answer = ask(api, "outliers", bedroom.scene)
    rows = bedroom.rows("outliers")
    assert "Places are not judged" in rows.pop()
    for row, one in zip(rows, answer["outliers"], strict=True):
        assert row.startswith(one["object"])
        assert percent(one["probability"]) in row
        assert ("Belongs here" in row) == one["is_outlier"]
        assert reasons(one["because"], -1) in row
        usual = "usually seen with " + ", ".join(one["usually_with"])
        assert usual in row or not one["is_outlier"]
        assert not re.search(r"[+−-]\d", row)
    alarms = [one for one in answer["outliers"] if one["is_outlier"]]
    assert alarms, "the example has nothing wrong in it"
    alone, others = bedroom.groups
    assert (alone, others) == (
        f"Does not belong here ({len(alarms)})",
        f"No alarm ({len(answer['outliers']) - len(alarms)})",
    )
    marked = bedroom.page.locator("#board .object.outlier").all()
    names = [str(one.get_attribute("aria-label")).split(",")[0] for one in marked]
    assert names == [one["object"] for one in alarms]
    assert bedroom.edges == []
    expect(bedroom.page.locator("#alarms")).to_have_text(str(len(alarms)))
    bedroom.page.get_by_label("Sensitivity").select_option("high")
    bedroom.settle()
    assert bedroom.body("outliers")["sensitivity"] == "high"
    answer = ask(api, "outliers", bedroom.scene, sensitivity="high")
    outliers = bedroom.page.locator("#board .object.outlier")
    expect(outliers).to_have_count(sum(one["is_outlier"] for one in answer["outliers"]))


def test_words_are_shown_with_their_classes(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board({"objects": ["counter", "air fryer", "Plates"]})
    answer = ask(api, "outliers", board.scene)
    classes = {one["object"]: one["label"] for one in answer["outliers"]}
    assert classes == {"counter": "counter", "air fryer": "deep fryer", "Plates": "plate"}
    another = {"label": "plate", "listed_as": "Plates", "listed_count": 1, "expected_count": 4}
    more = [another | {"low": 2, "high": 6, "probability": 0.9}]
    board.alter("missing", lambda answer: answer | {"more": more})
    board.add("fork")
    (row,) = (row for row in board.rows("missing") if row.startswith("another"))
    assert row.startswith("another Plates")
    assert "class: plate" in row
    board.tab("Wrong")
    for row in [row for row in board.rows("outliers") if "Places are not judged" not in row]:
        word = next(name for name in (*classes, "fork") if row.startswith(name))
        listed = classes.get(word, word)
        assert (f"class: {listed}" in row) == (listed != word)


def test_relations_are_edges(bedroom: Board, api: httpx.Client) -> None:
    bedroom.page.get_by_label("Positions count as evidence").check()
    bedroom.add("lamp")  # its position does not count
    bedroom.tab("Relations")
    answer = ask(api, "relations", bedroom.body("relations"))
    # Relations that differ from expectation come first.
    odd = len(answer["disagreements"])
    rows = bedroom.rows("relations")[odd:]
    assert len(rows) == len(answer["relations"])
    kinds = {"disagrees"} if odd else set()
    for row, one in zip(rows, answer["relations"], strict=True):
        assert row.startswith(f"{one['subject']} {SPOKEN[one['relation']]} {one['object']}")
        expected = f" if not observed: {percent(one['expected'])}" if one.get("expected") else ""
        assert row.endswith(percent(one["probability"]) + expected)
        assert ("observed" in row) == one["observed"]
        kinds.add("holds" if one["observed"] else "expected")
    assert {kind for kind, _ in bedroom.edges} == kinds >= {"holds", "expected"}
    texts = {f"{SPOKEN[e['relation']]} {percent(e['probability'])}" for e in answer["relations"]}
    # Between an object and another one on top of it there is no room for words.
    words = {text for kind, text in bedroom.edges if text and kind != "disagrees"}
    assert words
    assert words <= texts


def test_room_types_are_listed_by_their_probability(bedroom: Board, api: httpx.Client) -> None:
    page, routes = bedroom.page, list[str]()
    page.on("request", lambda request: routes.append(request.url.rsplit("/", 1)[-1]))
    options, likeliest = page.locator("#room option"), page.locator("#room-likely")

    def check() -> None:
        answer = ask(api, "rooms", bedroom.scene, top_k=4096, detail="scores")["room_types"]
        words = [f"{one['room_type']} {percent(one['probability'])}" for one in answer]
        expect(options).to_have_text(["unknown", *words])
        expect(likeliest).to_have_text(f"Likeliest: {words[0]}")

    check()
    page.locator("#room").select_option("kitchen")
    bedroom.settle()
    assert bedroom.body("missing")["room_type"] == "kitchen"
    assert "missing" in routes
    # The probabilities ignore the room type that a person chooses.
    assert "rooms" not in routes
    check()
    expect(page.locator("#room")).to_have_value("kitchen")
    bedroom.add("toilet")
    assert "rooms" in routes
    check()
    bedroom.click("Clear")
    expect(likeliest).to_have_text("")
    names = api.get("/models/default/vocabulary").json()["room_types"]
    expect(options).to_have_text(["unknown", *names])


def test_aliases_of_room_types(open_board: OpenBoard, api: httpx.Client) -> None:
    board = open_board({"objects": ["desk", "chair"], "room_type": "hall"})
    (answer,) = ask(api, "rooms", board.scene, candidates=["hall", "office"], top_k=4096)["mapped"]
    assert (answer["label"], answer["class"]) == ("hall", "corridor")
    every = ask(api, "rooms", board.scene, top_k=4096)["room_types"]
    p = next(one["probability"] for one in every if one["room_type"] == "corridor")
    expect(board.page.locator("#room option:checked")).to_have_text(f"hall {percent(p)}")
    expect(board.page.locator("#room-error.certain")).to_have_text("hall → corridor")
    board.put('{"objects": ["desk"], "room_type": "Living Room"}')
    expect(board.page.locator("#room option:checked")).to_have_text(re.compile(r"Living Room \d"))


def test_the_shown_calls_give_the_shown_answer(open_board, api, find_tool):
    find_tool("curl")
    board = open_board(permissions=["clipboard-read", "clipboard-write"])
    programs = ("sh", board.curl("missing")), (sys.executable, board.python("missing"))
    curl, python = (json.loads(run_program(name, "-c", text).stdout) for name, text in programs)
    expected = ask(api, "missing", board.body("missing"))
    assert curl | {"request_id": ""} == expected | {"request_id": ""}
    one, other = (
        [(entry["label"], entry["probability"]) for entry in answer["missing"]]
        for answer in (python, expected)
    )
    assert one == other
    assert percent(expected["missing"][0]["probability"]) in board.rows("missing")[0]
    board.column("missing").get_by_text("Send this request from a program").click()
    board.column("missing").get_by_role("button", name="Copy the curl call").click()
    expect(board.column("missing").get_by_text("copied")).to_be_visible()
    assert board.page.evaluate("navigator.clipboard.readText()") == board.curl("missing")


def draw(board: Board) -> None:
    board.click("Generate a scene")
    expect(board.page.locator("#draft")).to_be_visible()
    board.settle()


def request(board: Board) -> dict[str, Any]:
    return body_of(board.page.locator("#drawn pre").first.text_content() or "")


@pytest.mark.slow
def test_a_drawn_scene_can_be_kept(board: Board, api: httpx.Client) -> None:
    board.page.locator("#room").select_option("kitchen")
    board.tab("Generate")
    seen = []
    for seed in (1, 2):
        draw(board)
        body = request(board)
        assert (body["seed"], body["room_type"], body["objects"]) == (seed, "kitchen", [])
        (scene,) = api.post("/generate", json=body).json()["scenes"]
        assert board.page.locator("#drawn .chips li").all_text_contents() == scene["objects"]
        shown = board.page.locator("#board .object").all()
        names = {str(one.get_attribute("aria-label")).split(",")[0] for one in shown}
        assert names == set(scene["objects"]) == set(board.things)
        seen.append(board.page.locator("#drawn .chips li").all_text_contents())
    assert seen[0] != seen[1]
    board.click("Keep")
    assert board.things == seen[1]
    assert board.scene["room_type"] == "kitchen"
    # The page placed these objects, so their positions do not count.
    assert not any("position" in thing for thing in board.scene["objects"])
    board.click("Undo")
    assert board.things == ["desk", "chair"]


def test_a_drawn_scene_shows_the_words_of_the_board(open_board: OpenBoard) -> None:
    board = open_board({"objects": ["counter", "air fryer"]})
    board.tab("Generate")
    board.page.get_by_label("with the objects on the board").check()
    draw(board)
    chips = board.page.locator("#drawn .chips li").all_text_contents()
    assert {"counter", "air fryer (deep fryer)"} <= {*chips}
    assert board.things[:2] == ["counter", "air fryer"]
    assert len(board.things) == len(chips)


def suggest(board: Board, relation: str, anchor: str, *labels: str) -> dict[str, Any]:
    """Let the page receive these missing objects at one place, which the caller may change."""
    place: dict[str, Any] = {"relation": relation, "object": anchor, "probability": 0.9}

    def suggested(answer: Any) -> Any:
        first = answer["missing"][0]
        missing = [first | {"label": label, "placements": [place]} for label in labels]
        return answer | {"more": [], "missing": missing}

    board.alter("missing", suggested)
    return place


def test_a_suggestion_at_another_place_or_none_says_so(board: Board) -> None:
    far = {"mean": {"x": 9.0, "y": 0.0, "z": 0.5}, "std": dict.fromkeys("xyz", 0.2), "scenes": 9}
    place = suggest(board, "on-top", "desk", "cup")
    place["offset"] = far
    board.add("laptop")
    assert "drawn at the nearest free place" in board.rows("missing")[0]
    ghost = board.page.locator("#board .ghost").first
    assert "drawn at the nearest free place" in str(ghost.get_attribute("aria-label"))
    far["mean"]["x"] = 0.0
    board.add("lamp")
    assert board.ghosts == ["cup"]
    assert "nearest free place" not in board.rows("missing")[0]
    # The place below the desk is taken.
    place["relation"] = "below"
    del place["offset"]
    board.add("mug")
    assert board.ghosts == []
    assert "no free place on the board" in board.rows("missing")[0]
    assert board.column("missing").get_by_role("button", name="Put ").count() == 0


def test_other_suggestions_lie_on_a_sheet(open_board: OpenBoard) -> None:
    board = open_board({"objects": ["bed", "nightstand"]})
    suggest(board, "on-top", "bed", "sheet", "pillow")
    board.add("wardrobe")
    assert board.ghosts == ["sheet", "pillow"]


def test_no_suggestion_stands_at_an_outlier(open_board: OpenBoard) -> None:
    board = open_board({"objects": ["bed", "nightstand", "lamp", "toilet"]})
    (toilet,) = [thing["id"] for thing in board.scene["objects"] if thing["label"] == "toilet"]
    suggest(board, "above", toilet, "plunger")
    board.add("wardrobe")
    assert board.ghosts == []
    assert not any(re.search(rf"{toilet} \d+ %", row) for row in board.rows("missing"))


def test_wrong_detections_are_no_outliers(open_board: OpenBoard, api: httpx.Client) -> None:
    weak = {"label": "toilet", "confidence": 0.1}
    board = open_board({"objects": ["bed", "nightstand", "pillow", weak]})
    board.tab("Wrong")
    answer = ask(api, "outliers", board.scene)
    (toilet,) = [one for one in answer["outliers"] if one["object"] == "toilet"]
    assert toilet["reason"] == "misdetection"
    row = board.rows("outliers")[0]
    assert row == f"toilet {percent(toilet['real'])} real"
    assert [*board.groups] == ["Probably a wrong detection (1)", "No alarm (3)"]
    page = board.page
    expect(page.get_by_role("button", name="Belongs here")).to_have_count(0)
    expect(page.locator("#alarms")).to_be_hidden()
    expect(page.locator("#board .outlier")).to_have_count(0)
    expect(page.locator("#board .object.doubtful")).to_have_count(1)
    spoken = board.thing("toilet").get_attribute("aria-label") or ""
    assert spoken.endswith("probably a wrong detection")
    expect(page.locator("#list li", has_text="toilet")).to_contain_text("wrong detection")
    page.locator("#list .name").last.click()
    page.get_by_label("Confidence").fill("1")
    page.get_by_label("Confidence").press("Enter")
    board.settle()
    expect(page.locator("#board .object.doubtful")).to_have_count(0)


def test_objects_of_several_rooms_are_split(open_board: OpenBoard, api: httpx.Client) -> None:
    bedroom = ["bed", "nightstand", "wardrobe", "pillow"]
    kitchen = ["oven", "refrigerator", "microwave", "stove"]
    objects = [*bedroom, *kitchen, "toilet", "bathtub", "toilet paper"]
    board = open_board({"objects": objects, "relations": [["oven", "left", "stove"]]})
    (warning,) = ask(api, "outliers", board.scene)["warnings"]
    assert warning["code"] == "several-rooms"
    assert "several" not in board.rows("missing")[0]
    note = board.column("missing").get_by_text(warning["message"])
    expect(note).to_have_count(1)
    board.tab("Wrong")
    split = board.rows("outliers")[0]
    assert split.startswith(f"The objects are probably from {len(warning['rooms'])} rooms")
    expect(board.column("outliers").get_by_text(warning["message"])).to_have_count(0)
    for part in warning["rooms"]:
        assert f"{part['room_type']} ({len(part['objects'])}) Only these" in split
        assert ", ".join(part["objects"]) in split
    (part,) = [one for one in warning["rooms"] if "oven" in one["objects"]]
    button = board.page.get_by_role("button", name=f"Only these: {part['room_type']}")
    button.focus()
    board.page.keyboard.press("Enter")
    board.settle()
    assert board.things == part["objects"]
    assert board.scene["room_type"] == part["room_type"]
    assert ("relations" in board.scene) == ({"oven", "stove"} <= {*part["objects"]})
    board.click("Undo")
    assert board.things == objects


def test_labels_of_an_object_with_alternatives(open_board: OpenBoard, api: httpx.Client) -> None:
    guess = {
        "label": "bowl",
        "confidence": 0.4,
        "alternatives": [{"label": "toothbrush", "confidence": 0.4}],
    }
    board = open_board({"objects": ["sink", "toilet", "bathtub", guess]})
    assert board.exported()["objects"][3] == {"id": "bowl", **guess}
    (resolved,) = ask(api, "outliers", board.scene)["resolved"]
    (first, second) = resolved["labels"]
    assert first["label"] == "toothbrush"
    words = (
        f"labels: toothbrush {percent(first['probability'])}, bowl {percent(second['probability'])}"
    )
    row = board.page.locator("#list li").last
    expect(row).to_contain_text(words)
    board.tab("Wrong")
    (shown,) = [row for row in board.rows("outliers") if row.startswith("bowl")]
    assert words in shown
    # The button makes the likeliest label the only one.
    board.click("Rename bowl to toothbrush")
    assert board.things[-1] == "toothbrush"
    assert board.scene["objects"][-1] == {
        "id": "toothbrush", "label": "toothbrush", "confidence": 0.4
    }  # fmt: skip
    expect(row).not_to_contain_text("labels:")
