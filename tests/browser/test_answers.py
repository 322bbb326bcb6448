"""What the page shows is what the service answers, for every question and model."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from playwright.sync_api import Route, expect

from tests.browser.driving import Board, percent

pytestmark = pytest.mark.system

OpenBoard = Callable[..., Board]
SPOKEN = {
    "left": "left of",
    "right": "right of",
    "front": "in front of",
    "behind": "behind",
    "on-top": "on top of",
    "under": "under",
    "above": "above",
    "below": "below",
}

OPPOSITE = {
    "left": "right",
    "right": "left",
    "front": "behind",
    "behind": "front",
    "on-top": "under",
    "under": "on-top",
    "above": "below",
    "below": "above",
}


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
    rows = bedroom.rows("missing")
    assert len(rows) == 5
    for row, missing in zip(rows, answer["missing"], strict=True):
        assert row.startswith(f"{missing['label']} {percent(missing['probability'])}")
        for place in missing["placements"]:
            where = f"{SPOKEN[place['relation']]} {place['object']}"
            assert f"{where} {percent(place['probability'])}" in row
    labels = [f"{one['label']} {percent(one['probability'])}" for one in answer["missing"]]
    assert sorted(bedroom.ghosts) == sorted(labels)
    bedroom.slide("Suggestions", 3)
    assert len(bedroom.rows("missing")) == len(bedroom.ghosts) == 3


def test_a_ghost_becomes_an_object_where_it_was_drawn(bedroom: Board) -> None:
    ghost = bedroom.page.locator("#board .ghost").first
    label = (ghost.locator("text").text_content() or "").rsplit(" ", 2)[0]
    drawn = ghost.locator("rect").bounding_box()
    assert drawn is not None
    ghost.press("Enter")
    bedroom.settle()
    assert bedroom.things[-1] == label
    box = bedroom.thing(label).locator(".box").bounding_box()
    focused = bedroom.page.evaluate("document.activeElement.getAttribute('aria-label')")
    assert focused.startswith(f"{label},")
    assert box is not None
    # The view may have grown by what is suggested next; the proportions stay.
    assert box["width"] / box["height"] == pytest.approx(drawn["width"] / drawn["height"], rel=0.05)
    assert all(label != row.split(" ")[0] for row in bedroom.rows("missing"))


def offset_answer(route: Route) -> None:
    """The service's answer with offsets and reasons, as they are where training saw poses."""
    response = route.fetch()
    answer = response.json()
    first = answer["missing"][0]
    first["because"] = [{"object": "bed", "log_odds_change": 1.25}]
    first["placements"][0] |= {
        "object": "bed",
        "relation": "on-top",
        "offset": {
            "mean": {"x": 0.6, "y": -0.3, "z": 0.4},
            "std": {"x": 0.1, "y": 0.25, "z": 0.05},
            "scenes": 40,
        },
    }
    route.fulfill(response=response, json=answer)


def test_offsets_say_where_a_ghost_stands_and_how_far_it_varies(bedroom: Board) -> None:
    bedroom.page.route("**/missing", offset_answer)
    bedroom.slide("Suggestions", 1)
    expect(bedroom.page.locator("#board .ghost")).to_have_count(1)
    (bed,) = [thing for thing in bedroom.scene["objects"] if thing["id"] == "bed"]
    spread = bedroom.page.locator("#board .spreads ellipse")
    across, down = (float(spread.get_attribute(name) or 0) for name in ("rx", "ry"))
    assert across / down == pytest.approx(2.5, rel=0.01)
    assert "because of bed +1.3" in bedroom.rows("missing")[0]
    bedroom.page.locator("#board .ghost").click()
    bedroom.settle()
    found = bedroom.scene["objects"][-1]
    placed = found["position"]
    assert placed["x"] == pytest.approx(bed["position"]["x"] + 0.6, abs=1e-3)
    assert placed["y"] == pytest.approx(bed["position"]["y"] - 0.3, abs=1e-3)
    # Its height is the bed's: another bed was learnt from.
    top = bed["position"]["z"] + bed["size"]["z"] / 2
    assert placed["z"] == pytest.approx(top + found["size"]["z"] / 2, abs=2e-3)


@pytest.mark.slow
def test_what_is_accepted_stands_where_the_page_says(bedroom: Board, api: httpx.Client) -> None:
    board = bedroom
    board.slide("Suggestions", 8)
    ghosts = board.page.locator("#board .ghost").count()
    broken = []
    for number in range(ghosts):
        ghost = board.page.locator("#board .ghost").nth(number)
        words = (ghost.get_attribute("aria-label") or "").removeprefix("Suggested: ")
        label, _, where = words.removesuffix(". Put it there").split(", ")
        (spoken,) = [text for text in SPOKEN.values() if where.startswith(f"{text} ")]
        (relation,) = [key for key, text in SPOKEN.items() if text == spoken]
        ghost.press("Enter")
        board.settle()
        anchor = where.removeprefix(f"{spoken} ")
        said = {"subject": label, "relation": relation, "object": anchor}
        opposite = {"subject": anchor, "relation": OPPOSITE[relation], "object": label}
        seen = ask(api, "relations", board.scene)["observed_relations"]
        if said not in seen and opposite not in seen:
            broken.append(f"{label} {where}")
        board.page.get_by_role("button", name="Undo").click()
        board.settle()
    assert ghosts >= 6
    assert not broken


def test_what_is_missing_at_a_place_is_asked_from_an_objects_menu(
    bedroom: Board, api: httpx.Client
) -> None:
    bedroom.page.get_by_role("button", name="Actions for nightstand").click()
    bedroom.page.get_by_role("menuitem", name="What is missing on top of it?").click()
    bedroom.settle()
    at = {"relation": "on-top", "object": "nightstand"}
    assert bedroom.body("missing")["at"] == at
    answer = ask(api, "missing", bedroom.scene, top_k=5, at=at)
    assert [row.split("%")[0] + "%" for row in bedroom.rows("missing")] == [
        f"{one['label']} {percent(one['probability'])}" for one in answer["missing"]
    ]
    expect(bedroom.page.locator("#at-words")).to_have_text("Missing on top of nightstand")
    names = [
        ghost.get_attribute("aria-label") for ghost in bedroom.page.locator("#board .ghost").all()
    ]
    assert all("on top of nightstand" in str(name) for name in names)
    bedroom.page.get_by_role("button", name="Anywhere").click()
    bedroom.settle()
    assert "at" not in bedroom.body("missing")


def test_outliers_are_marked_with_what_speaks_against_them(
    bedroom: Board, api: httpx.Client
) -> None:
    bedroom.tab("Wrong")
    answer = ask(api, "outliers", bedroom.scene)
    rows = bedroom.rows("outliers")
    heading = rows.index("In the wrong place?")
    for row, one in zip(rows[:heading], answer["outliers"], strict=True):
        assert row.startswith(one["object"])
        assert percent(one["probability"]) in row
        assert ("does not belong" in row) == one["is_outlier"]
        assert all(reason["object"] in row for reason in one["because"])
        reasoned = bool(one["because"])
        assert ("against: " in row) == (reasoned and one["is_outlier"])
        assert (" for: " in row) == (reasoned and not one["is_outlier"])
        assert ("usually with: " in row) == bool(one["usually_with"])
    for row, one in zip(rows[heading + 1 :], answer["misplaced"], strict=True):
        where = f"{one['subject']} {SPOKEN[one['relation']]} {one['object']}"
        assert row == f"{where} {percent(one['probability'])}"
    alarms = [one for one in answer["outliers"] if one["is_outlier"]]
    assert alarms, "the example has nothing wrong in it"
    marked = bedroom.page.locator("#board .object.outlier").all()
    assert [str(one.get_attribute("aria-label")).split(",")[0] for one in marked] == [
        one["object"] for one in alarms
    ]
    against = [why for one in alarms for why in one["because"] if why["log_odds_change"] < 0]
    amiss = [one for one in answer["misplaced"] if one["is_misplaced"]]
    kinds = ["misplaced"] * len(amiss) + ["against"] * len(against)
    assert [kind for kind, _ in bedroom.edges] == kinds
    expect(bedroom.page.locator("#alarms")).to_have_text(str(len(alarms) + len(amiss)))


def test_what_stands_in_the_wrong_place_is_counted_and_said(bedroom: Board) -> None:
    amiss = {"subject": "lamp", "relation": "on-top", "object": "bed"}
    amiss |= {"probability": 0.75, "is_misplaced": True}

    def misplaced(route: Route) -> None:
        response = route.fetch()
        route.fulfill(
            response=response, json=response.json() | {"outliers": [], "misplaced": [amiss]}
        )

    bedroom.page.route("**/outliers", misplaced)
    bedroom.add("mug")
    expect(bedroom.page.locator("#alarms")).to_have_text("1")
    assert "In the wrong place: lamp on top of bed." in bedroom.said
    assert "Nothing looks wrong" not in bedroom.said


def test_the_alarm_can_be_set_elsewhere(bedroom: Board, api: httpx.Client) -> None:
    bedroom.tab("Wrong")
    bedroom.slide("Alarm from", 5)
    answer = ask(api, "outliers", bedroom.scene, threshold=0.05)
    found = bedroom.page.locator("#board .object.outlier")
    expect(found).to_have_count(sum(one["is_outlier"] for one in answer["outliers"]))
    assert found.count() > 1
    bedroom.page.get_by_role("button", name="Use the model’s threshold").click()
    bedroom.settle()
    assert "threshold" not in bedroom.body("outliers")


def test_relations_are_edges_and_those_that_hold_are_told_apart(
    bedroom: Board, api: httpx.Client
) -> None:
    bedroom.tab("Relations")
    bedroom.slide("Minimum probability", 10)
    bedroom.slide("Maximum number", 8)
    answer = ask(api, "relations", bedroom.scene, top_k=8, min_probability=0.1)
    seen = [
        (one["subject"], one["relation"], one["object"]) for one in answer["observed_relations"]
    ]
    # What stands otherwise than expected comes first.
    odd = len(answer["disagreements"])
    rows = bedroom.rows("relations")[odd:]
    assert len(rows) == len(answer["relations"])
    kinds = {"disagrees"} if odd else set()
    for row, one in zip(rows, answer["relations"], strict=True):
        assert row.startswith(f"{one['subject']} {SPOKEN[one['relation']]} {one['object']}")
        assert row.endswith(percent(one["probability"]))
        holds = (one["subject"], one["relation"], one["object"]) in seen
        assert ("observed" in row) == holds
        kinds.add("holds" if holds else "expected")
    assert {kind for kind, _ in bedroom.edges} == kinds >= {"holds", "expected"}
    said = {
        f"{SPOKEN[one['relation']]} {percent(one['probability'])}" for one in answer["relations"]
    }
    # Between a thing and what stands on it there is no room for words.
    words = {text for kind, text in bedroom.edges if text and kind != "disagrees"}
    assert words
    assert words <= said
    bedroom.page.locator("#list .name", has_text="oven").click()
    bedroom.page.get_by_label("only relations of the selected object").check()
    bedroom.settle()
    of_oven = [
        one
        for one in answer["disagreements"] + answer["relations"]
        if "oven" in (one["subject"], one["object"])
    ]
    assert len(bedroom.rows("relations")) == len(of_oven)
    before = len(bedroom.edges)
    bedroom.page.get_by_label("draw all observed relations").check()
    bedroom.settle()
    assert len(bedroom.edges) >= before
    bedroom.page.get_by_label("only relations of the selected object").uncheck()
    # A pair has one edge, and what is expected of it comes first.
    bedroom.slide("Minimum probability", 50)
    bedroom.settle()
    assert "observed" in {kind for kind, _ in bedroom.edges}


def test_words_on_the_board_cover_no_others(bedroom: Board) -> None:
    for tab in ("Missing", "Wrong", "Relations"):
        bedroom.tab(tab)
        boxes = [
            box
            for text in bedroom.page.locator("#board :is(.labels, .ghosts, .edges) text").all()
            if text.text_content() and text.text_content() != "!" and (box := text.bounding_box())
        ]
        assert len(boxes) > 4
        for index, a in enumerate(boxes):
            for b in boxes[:index]:
                # A line's box is higher than its letters: a quarter may meet.
                across = min(a["x"] + a["width"], b["x"] + b["width"]) - max(a["x"], b["x"])
                down = min(a["y"] + a["height"], b["y"] + b["height"]) - max(a["y"], b["y"])
                assert across <= 1 or down <= 0.25 * min(a["height"], b["height"]), (a, b)


def test_disagreements_are_drawn_where_an_answer_has_them(bedroom: Board) -> None:
    def disagreeing(route: Route) -> None:
        response = route.fetch()
        odd = {
            "subject": "nightstand",
            "object": "bed",
            "observed": ["left"],
            "expected": "right",
            "probability": 0.7,
            "observed_probability": 0.1,
        }
        route.fulfill(response=response, json=response.json() | {"disagreements": [odd]})

    bedroom.page.route("**/relations", disagreeing)
    bedroom.tab("Relations")
    bedroom.slide("Maximum number", 10)
    assert ("disagrees", "right of 70 %, but left of") in bedroom.edges
    assert "nightstand left of bed 10 % expected: right of, 70 %" in bedroom.rows("relations")


def test_two_models_answer_side_by_side(bedroom: Board, api: httpx.Client) -> None:
    listed = api.get("/models").json()["models"]
    references = [f"{one['name']}@{v['version']}" for one in listed for v in one["versions"]]
    shown = bedroom.page.locator("#second option")
    assert set(references) <= {option.get_attribute("value") for option in shown.all()}
    (second,) = [name for name in references if name.startswith("indoor-rbm@")]
    bedroom.page.get_by_label("versus").select_option(second)
    bedroom.settle()
    for number, model in enumerate(("default", second)):
        answer = ask(api, "missing", bedroom.scene, top_k=5, model=model)
        rows = bedroom.rows("missing", number)
        assert [row.split(" %")[0] for row in rows] == [
            f"{one['label']} {percent(one['probability'])}".removesuffix(" %")
            for one in answer["missing"]
        ]
        title = f"{answer['model']['name']} {answer['model']['version']}"
        expect(bedroom.column("missing", number).locator("h3")).to_have_text(title)
    bedroom.column("missing", 1).get_by_role("button", name="show on the board").click()
    bedroom.settle()
    answer = ask(api, "missing", bedroom.scene, top_k=5, model=second)
    assert {text.split(" %")[0].rsplit(" ", 1)[0] for text in bedroom.ghosts} <= {
        one["label"] for one in answer["missing"]
    }
    bedroom.page.get_by_label("versus").select_option("")
    bedroom.settle()
    expect(bedroom.column("missing", 1)).to_be_hidden()


def test_a_label_that_a_model_does_not_know_is_told_at_the_object_and_can_be_left_out(
    open_board: OpenBoard,
) -> None:
    scene = {"objects": [{"label": "bed"}, {"label": "bedd"}]}
    board = open_board(scene, allow=("422",))
    expect(board.page.locator("#list li").nth(1).locator(".error")).to_contain_text("bed")
    expect(board.column("missing").get_by_role("alert")).to_contain_text("bedd: ")
    board.page.get_by_label("versus").select_option(index=3)
    second = board.page.get_by_label("versus").input_value()
    told = board.page.locator("#list li").nth(1).locator(".error")
    expect(told).to_contain_text("default: ")
    expect(told).to_contain_text(f"{second}: ")
    board.settle()
    board.page.get_by_label("Objects that a model does not know").select_option("ignore")
    board.settle()
    assert board.rows("missing")
    expect(board.column("missing")).to_contain_text("Ignored: bedd")
    expect(board.page.locator("#list li").nth(1).locator(".error")).to_be_empty()


def test_the_curl_shown_gives_the_answer_shown(
    bedroom: Board, api: httpx.Client, require_system_tool: Callable[[str], Path]
) -> None:
    require_system_tool("curl")
    question = "relations"
    bedroom.tab("Relations")
    command = bedroom.curl(question)
    done = subprocess.run(["sh", "-c", command], capture_output=True, text=True, check=True)
    answer, body = json.loads(done.stdout), bedroom.body(question)
    asked = ask(api, question, body)
    assert {**answer, "request_id": ""} == {**asked, "request_id": ""}
    first = bedroom.rows(question)[0]
    assert percent(answer[question][0]["probability"]) in first


def test_the_python_call_shown_gives_the_same_answer(
    bedroom: Board, api: httpx.Client, repository: Path
) -> None:
    pytest.importorskip("scene_client")
    done = subprocess.run(
        [sys.executable, "-c", bedroom.python("missing")],
        capture_output=True,
        text=True,
        check=True,
        env={**os.environ, "PYTHONPATH": str(repository)},
    )
    answer = ask(api, "missing", bedroom.body("missing"))
    shown = [(one["label"], one["probability"]) for one in json.loads(done.stdout)["missing"]]
    assert shown == [(one["label"], one["probability"]) for one in answer["missing"]]


def test_calls_can_be_copied(open_board: OpenBoard) -> None:
    board = open_board(permissions=["clipboard-read", "clipboard-write"])
    board.column("missing").get_by_text("Send this request from a program").click()
    board.column("missing").get_by_role("button", name="Copy the curl call").click()
    expect(board.column("missing").get_by_text("copied")).to_be_visible()
    assert board.page.evaluate("navigator.clipboard.readText()") == board.curl("missing")
