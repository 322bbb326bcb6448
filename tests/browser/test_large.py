"""Scenes of many objects, scenes without alarms, and hostile names."""

import json
from pathlib import Path
from typing import Any

import httpx
import pytest
from axe_playwright_python.sync_playwright import Axe  # type: ignore[import-untyped]
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard, percent, plain

pytestmark = pytest.mark.system

# fmt: off
LABELS = [
    "plate", "bowl", "mug", "spoon", "fork", "knife", "pan", "pot", "spatula", "sponge", "apple",
    "banana", "bread", "egg", "lettuce", "tomato", "potato", "bottle", "jar", "napkin", "kettle",
    "toaster", "blender", "microwave", "lamp", "clock", "vase", "book", "basket", "towel",
]
# fmt: on
TABLE = {"id": "table", "label": "table", "position": [2, 0, 0.4], "size": [1, 2, 0.8]}
CROWDED = {
    "objects": [
        TABLE,
        *(
            {
                "id": f"track_{n}",
                "label": LABELS[n % len(LABELS)],
                "position": [1.6 + 0.11 * (n % 8), -0.6 + 0.17 * (n // 8), 0.85],
                "size": [0.1, 0.1, 0.1],
            }
            for n in range(59)
        ),
    ],
    "room_type": "kitchen",
}

NAMES = """() => {
  const rects = [...document.querySelectorAll('#board .names text')].map((text) => {
    const { left, right, top, bottom } = text.getBoundingClientRect();
    return { left, right, top, bottom, words: text.textContent };
  });
  const isLeft = (a, b) => a.right <= b.left;
  const isOver = (a, b) => a.bottom <= b.top;
  const apart = (a, b) => isLeft(a, b) || isLeft(b, a) || isOver(a, b) || isOver(b, a);
  const pairs = rects.flatMap((one, index) => rects.slice(index + 1)
    .filter((other) => !apart(one, other)).map((other) => [one.words, other.words]));
  const lines = document.querySelectorAll('#board .lines line').length;
  return [rects.map(({ words }) => words), pairs, lines];
}"""


@pytest.mark.parametrize("width", [1300, 390])
def test_names_of_a_crowded_board(open_board: OpenBoard, width: int) -> None:
    board = open_board(CROWDED)
    page = board.page
    page.set_viewport_size({"width": width, "height": 900})
    board.tab("Wrong")  # suggestions take room
    names, overlapping, lines = page.evaluate(NAMES)
    assert overlapping == []
    assert lines > 0
    hidden = len(CROWDED["objects"]) - len(names)
    expect(page.locator("#unnamed")).to_contain_text(f"{hidden} names have no room")
    # A hidden name appears under the pointer, and with the focus.
    tips = page.locator("#board .tips text")
    expect(tips).to_have_count(0)
    boxes = page.locator("#board .object")
    spoken = [str(one.get_attribute("aria-label")).split(",")[0] for one in boxes.all()]
    short = [words.partition(" (")[0] for words in spoken]
    unnamed = next(
        name
        for name, word in zip(spoken, short, strict=True)
        if name not in names and word not in names
    )
    board.thing(unnamed).dispatch_event("pointerenter")
    expect(tips).to_have_text(unnamed)
    board.thing(unnamed).dispatch_event("pointerleave")
    expect(tips).to_have_count(0)
    board.thing(unnamed).focus()
    expect(tips).to_have_text(unnamed)


def test_alarms_of_a_large_scene_are_grouped(open_board: OpenBoard, api: httpx.Client) -> None:
    mugs = [{"id": f"mug_{n}", "label": "mug"} for n in range(1, 9)]
    board = open_board({"objects": ["bed", "nightstand", "lamp", "oven", *mugs]})
    place = {"relation": "on-top", "object": "floor", "log_odds": 2.0, "is_misplaced": True}
    misplaced = [
        place | {"subject": f"mug_{n}", "probability": 0.9 - n / 100, "reason": "on-floor"}
        for n in range(1, 9)
    ]
    stated = place | {"subject": "bed", "object": "lamp", "probability": 0.95}
    board.alter("outliers", lambda found: found | {"misplaced": [*misplaced, stated]})
    board.add("wardrobe")
    board.tab("Wrong")
    answer = api.post("/outliers", json=board.scene).json()["outliers"]
    wrong = [one["object"] for one in answer if one["is_outlier"]]
    assert wrong
    groups = board.groups
    headings = [
        f"Does not belong here ({len(wrong)})",
        "Stated relation is probably wrong (1)",
        "Stands on the floor, but belongs elsewhere (8)",
        f"No alarm ({13 - len(wrong)})",
    ]
    assert [*groups] == headings
    assert [row.split(" ")[0] for row in groups[headings[0]]] == wrong
    # Eight alarms are one habit, and objects without alarm are a fold.
    assert groups[headings[2]] == groups[headings[3]] == []
    habit = board.column("outliers").get_by_text("8 × mug on top of floor, up to 89 %")
    habit.focus()
    board.page.keyboard.press("Enter")
    rows = board.groups[headings[2]]
    assert rows[0] == "mug_1 on top of floor 89 % Stands right"
    assert len(rows) == 8
    # The fold stays open after the next answer, and the focus stays there.
    board.page.get_by_label("Sensitivity").select_option("high")
    board.settle()
    assert len(board.groups[headings[2]]) == 8
    assert Axe().run(board.page).response["violations"] == []
    board.put('["bed", "lamp"]')
    board.put(json.dumps({"objects": ["bed", *mugs]}))
    assert board.groups[headings[2]] == []


def test_reasons_without_alarms(open_board: OpenBoard, api: httpx.Client) -> None:
    objects = ["bed", "pillow", "nightstand", "lamp", "wardrobe", "mug", "rug", "curtain"]
    board = open_board({"objects": objects, "room_type": "bedroom"})
    board.tab("Wrong")
    answer = api.post("/outliers", json=board.scene).json()["outliers"]
    assert not any(one["is_outlier"] for one in answer)
    (heading, rows), *others = board.groups.items()
    assert (heading, others) == ("Nothing looks wrong. Nearest to an alarm:", [])
    for row, one in zip(rows, answer[:3], strict=True):
        assert row.startswith(f"{one['object']} {percent(one['probability'])}")
        assert f"{', '.join(reason['object'] for reason in one['because'])} speak" in row
    expect(board.column("outliers").get_by_text("5 more")).to_be_visible()
    alone = [one | {"because": []} for one in answer]
    board.alter("outliers", lambda found: found | {"outliers": alone})

    def without_reasons(found: Any) -> Any:
        return found | {"missing": [one | {"because": []} for one in found["missing"]]}

    board.alter("missing", without_reasons)
    board.add("window")
    assert "no other object speaks for it" in board.rows("outliers")[0]
    board.tab("Missing")
    note = "No single object decides these: the room type and all objects together do."
    expect(board.column("missing")).to_contain_text(note)


def test_the_first_screen_names_the_model_and_its_terms(board: Board, api: httpx.Client) -> None:
    about = board.page.locator("#about")
    version = api.get("/models/places-triway").json()["versions"][0]["version"]
    terms = api.get(f"/models/places-triway/versions/{version}").json()["terms"]
    default = f"Model places-triway {version}: commercial use allowed. Terms: {terms}"
    expect(about).to_have_text(f"{default} A request is about one room.")
    board.page.get_by_label("compare with").select_option(f"research-triway@{version}")
    expect(about).to_contain_text(
        f"{default} Model research-triway {version}: research only, no commercial use. Terms: "
    )


HOSTILE = {
    "html": "<img src=x onerror=alert(1)>",
    "long": "w" * 5000,
    "line\nbreak": "lamp\n\n\nlamp",
    "turned": "mug \u202egnorw \u2066x",
    "hebrew": "\u05e9\u05d5\u05dc\u05d7\u05df",
}


def test_hostile_names_are_bounded_text(open_board: OpenBoard) -> None:
    objects = [{"id": name, "label": label} for name, label in HOSTILE.items()]
    # The service refuses unprintable names, so the page has no answers.
    board = open_board({"objects": [*objects, "bed"]}, allow=("422",))
    page = board.page
    page.set_viewport_size({"width": 390, "height": 844})
    board.tab("Wrong")
    shown = board.things
    assert shown[0] == "<img src=x onerror=alert(1)> (html)"
    assert len(shown[1]) < 60
    assert shown[2] == "lamp\ufffd\ufffd\ufffdlamp (line\ufffdbreak)"
    assert shown[3] == "mug \ufffdgnorw \ufffdx (turned)"
    assert shown[4] == f"\u2068{HOSTILE['hebrew']}\u2069 (hebrew)"
    text = page.locator("body").inner_text()
    assert not {"\u202e", "\u2066"} & {*text}
    assert "w" * 60 not in text
    assert page.locator("img[src=x]").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    # Printable hostile names reach all answers.
    objects = [{"id": f"{name}_1", "label": "lamp"} for name in ("<b>bold</b>", "x" * 120)]
    board.put(json.dumps({"objects": [*objects, "bed", "oven"], "room_type": "<i>room</i>"}))
    for tab in ("Missing", "Wrong", "Relations", "Where"):
        board.tab(tab)
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth"), tab
    page.get_by_label("Room", exact=True).last.fill("<u>" + "r" * 97)
    board.click("Add this room")
    box = page.get_by_role("combobox", name="Thing")
    box.fill("mug")
    box.press("Enter")
    board.settle()
    page.get_by_role("button", name="Looked there").first.click()
    board.settle()
    words = plain(page.locator("#whereabouts").inner_text())
    assert "<u>rrr" in words
    assert "r" * 60 not in words
    assert page.locator("main :is(i, u), main b > b").count() == 0
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_hostile_recording_is_bounded_text(open_board: OpenBoard, tmp_path: Path) -> None:
    board = open_board(allow=("422",))
    page = board.page
    page.set_viewport_size({"width": 390, "height": 844})
    lines = [
        {"scene_id": name, "group": name, "room_type": name, "objects": [{"label": name}, "bed"]}
        for name in (*HOSTILE.values(), 5)
    ]
    lines[-1]["objects"] = ["bed", "oven"]
    file = tmp_path / f"{'f' * 100}.jsonl"
    file.write_text("".join(f"{json.dumps(line)}\n" for line in lines), "utf-8")
    for number in range(1, len(HOSTILE) + 1):
        board.open_file(file)
        page.locator("#which").fill(str(number))
        board.click("Put on the board")
        board.tab("Where")
        box = page.get_by_role("combobox", name="Thing")
        box.fill("mug")
        box.press("Enter")
        board.settle()
        text = page.locator("body").text_content() or ""
        shown = page.evaluate("document.body.innerText")
        assert not {"\u202e", "\u2066"} & {*shown}
        assert "w" * 60 not in shown
        assert "<img src=x" in text
        assert page.locator("img[src=x]").count() == 0
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
