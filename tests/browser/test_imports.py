"""The page reads what the command `scene` and the training read."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from scene_client.vision_msgs import from_message
from tests.browser.driving import OpenBoard

pytestmark = pytest.mark.system


def rounded(value: Any) -> Any:
    """A scene with numbers rounded to centimetres."""
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    return round(value, 2) if isinstance(value, float) else value


def test_detections_are_read_as_the_client_reads_them(
    open_board: OpenBoard, repository: Path
) -> None:
    file = repository / "clients" / "ros2" / "detections.json"
    fields = from_message(json.loads(file.read_text("utf-8")))
    board = open_board()
    page = board.page
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Open a file").set_input_files(file)
    expect(page.get_by_label("Scene, JSON")).to_have_value(file.read_text("utf-8"))
    board.click("Put on the board")
    shown = {thing["id"]: thing for thing in board.scene["objects"]}
    assert list(shown) == [thing["id"] for thing in fields["objects"]]
    for thing in fields["objects"]:
        for name in ("label", "confidence", "position"):
            assert rounded(shown[thing["id"]].get(name)) == rounded(thing.get(name))
        if "size" in thing:
            assert rounded(shown[thing["id"]]["size"]) == rounded(thing["size"])
    assert page.get_by_label("Positions count as evidence").is_checked()


def test_labels_supports_and_flat_detections_are_read(open_board: OpenBoard) -> None:
    board = open_board()
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
        stated = {"subject": "mug", "relation": "on-top", "object": "table"}
        assert board.scene["relations"] == [stated]
    seen = {"results": [{"hypothesis": {"class_id": "mug", "score": 0.5}}], "bbox": {"size_x": 9}}
    board.put(json.dumps({"detections": [seen, seen]}))
    assert board.scene["objects"] == [
        {"id": f"mug_{number}", "label": "mug", "confidence": 0.5} for number in (1, 2)
    ]
