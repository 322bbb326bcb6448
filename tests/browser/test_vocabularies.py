"""The page opens with any model, and shows the treatment of unknown names."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from playwright.sync_api import expect

from tests.browser.driving import Board, OpenBoard
from tests.services import ADMIN_KEY, LiveService, launch

pytestmark = pytest.mark.system


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
    headers, body = {"X-Admin-Key": ADMIN_KEY}, {"model": model}
    response = service.client.put("/models/aliases/default", json=body, headers=headers)
    assert response.is_success


# The first test of the service, because an alias cannot be removed over HTTP.
@pytest.mark.parametrize("has_default", [False, True])
def test_a_model_of_one_s_own_opens_without_errors(
    open_board: OpenBoard, own: LiveService, has_default: bool
) -> None:
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
    scene = {"objects": ["bed", "fridgee", "flux capacitor"], "room_type": "bedrom"}
    board = open_board(scene, allow=("422",))
    assert notes(board, 0) == ""
    assert notes(board, 1) == "fridgee → fridge?"
    assert notes(board, 2).startswith("flux capacitor not known, left out")
    expect(board.page.locator("#room-error")).to_have_text("bedrom → bedroom?")
    names = board.page.locator("#board .labels text.name").all_text_contents()
    assert {"fridgee → fridge?", "flux capacitor"} < set(names)
    expect(board.thing("flux capacitor")).to_have_class(re.compile("unknown"))
    expect(board.page.locator("#legend .unknown")).to_have_text("not known to the model, left out")
    assert [thing["label"] for thing in board.scene["objects"]] == ["bed", "fridgee"]
    assert board.rows("missing")
    expect(board.column("missing")).to_contain_text("fridgee → fridge? flux capacitor not known")
    board.page.locator("#room").select_option("bedroom")
    board.click("Remove flux capacitor")
    board.page.get_by_role("button", name="Rename fridgee to fridge").press("Enter")
    board.settle()
    assert board.things == ["bed", "fridge"]
    assert [thing["label"] for thing in board.scene["objects"]] == ["bed", "fridge"]
    expect(board.page.locator("#list .name").nth(1)).to_be_focused()
    expect(board.page.locator("#list .error:visible, #room-error:visible")).to_have_count(0)
    expect(board.column("missing").locator("header + .problem + p")).to_be_empty()
    board.put('{"objects": ["bed"], "room_type": "submarine"}')
    expect(board.page.locator("#room-error")).to_contain_text("submarine not known, left out")
    assert "room_type" not in board.scene
    assert board.rows("missing")
