"""Files of detectors, tools and simulators on the page: the scenes that the client reads too."""

from __future__ import annotations

import json
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import expect

from scene_client import from_file
from scene_client.ros_fields import MessageError
from tests.browser.driving import OpenBoard
from tests.client.scene_files import EXAMPLES, REFUSED
from tests.client.test_files import corrupted

_READ = """async (files) => {
  const { scenesIn } = await import('/static/board/importing.js');
  const { labelsOf } = await import('/static/board/class_ids.js');
  const { SceneError } = await import('/static/board/scene.js');
  const read = ([text, map, name]) => {
    const scenes = scenesIn(text);
    if (name === null && scenes.names.length > 1) throw new SceneError('several');
    return scenes.read(name === null ? 0 : scenes.names.indexOf(name), labelsOf(map, ''));
  };
  return files.map((file) => {
    try {
      const { scene, notes = [] } = read(file);
      return JSON.parse(JSON.stringify([scene, notes.map(([index, reason]) => [index, reason])]));
    } catch (error) {
      if (!(error instanceof SceneError)) throw error;
      return null;
    }
  });
}"""


def read_by_client(path: Path, labels: str | None, scene: str | None) -> Any:
    """The scene and the notes of a file, or None if it is refused."""
    with suppress(MessageError):
        fields = from_file(path, labels, scene=scene)
        notes = [[note.detection, note.reason] for note in fields.notes]
        return json.loads(json.dumps([fields, notes]))
    return None


def rounded(value: Any) -> Any:
    if isinstance(value, dict):
        return {name: rounded(part) for name, part in value.items()}
    if isinstance(value, list):
        return [rounded(part) for part in value]
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return round(float(value), 9) + 0.0 if is_number else value


def test_the_page_and_the_client_read_the_same(open_board: OpenBoard, tmp_path: Path) -> None:
    page = open_board().page
    examples = [[one.text, one.labels or "", one.scene] for one in EXAMPLES.values()]
    seen = dict(zip(EXAMPLES, page.evaluate(_READ, examples), strict=True))
    for name, example in EXAMPLES.items():
        path = tmp_path / name
        path.write_text(example.text, "utf-8")
        expected = read_by_client(path, example.labels, example.scene)
        assert expected is not None
        assert rounded(seen[name]) == rounded(expected), name
    refused = [[text, "", None] for text, _, _ in REFUSED.values()]
    assert page.evaluate(_READ, refused) == [None] * len(REFUSED)


@pytest.mark.slow
def test_the_page_and_the_client_read_wrong_values_alike(
    open_board: OpenBoard, tmp_path: Path
) -> None:
    """If both read a file, they read the same. No file raises any other error on the page."""
    files = corrupted((b"null", b"-1", b'""'))
    cases = [[text, EXAMPLES[name].labels or "", EXAMPLES[name].scene] for name, text in files]
    seen = open_board().page.evaluate(_READ, cases)
    both = 0
    for (name, text), found in zip(files, seen, strict=True):
        path = tmp_path / name
        path.write_text(text, "utf-8")
        expected = read_by_client(path, EXAMPLES[name].labels, EXAMPLES[name].scene)
        if found is not None and expected is not None:
            both += 1
            assert rounded(found) == rounded(expected), text
    assert both > len(files) // 2


def test_a_refused_file_says_why_in_one_line(open_board: OpenBoard) -> None:
    board = open_board()
    page = board.page
    page.get_by_role("button", name="Import, export").click()
    for text, _, words in REFUSED.values():
        page.get_by_label("Scene, JSON").fill(text)
        if words.startswith(("Scene 1", "of 2")):  # the page offers the choice
            expect(page.locator("label", has=page.locator("#which"))).to_contain_text(
                words.removeprefix("Scene 1 ")
            )
            continue
        page.get_by_role("button", name="Put on the board").click()
        expect(page.locator("#json-error")).to_contain_text(words)
        assert "\n" not in (page.locator("#json-error").text_content() or "")


def test_a_scene_of_a_file_and_the_labels_of_its_class_ids_are_chosen(
    open_board: OpenBoard,
) -> None:
    board = open_board()
    page = board.page
    results = json.loads(EXAMPLES["coco_results.json"].text)
    several = [*results, results[0] | {"image_id": 43}, results[1] | {"category_id": 12}]
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Scene, JSON").fill(json.dumps(several))
    page.get_by_label("Labels of numeric class ids").select_option("COCO, ids 1 to 90")
    board.click("Put on the board")
    assert board.things == ["chair_1", "dining table_1"]
    expect(page.locator("#note")).to_contain_text("class '12' has no label")
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Scene, JSON").fill(json.dumps(several))
    page.locator("#which").fill("2")
    expect(page.locator("#scenes")).to_have_text("of 2: 43")
    page.get_by_label("Labels of numeric class ids").select_option("own names")
    page.get_by_label("Names, one a line").fill('{"62": "stool"}')
    board.click("Put on the board")
    assert board.things == ["stool_1"]


def test_a_large_file_is_read_without_showing_it(open_board: OpenBoard, tmp_path: Path) -> None:
    page = (board := open_board()).page
    path = tmp_path / "large.json"
    path.write_text(json.dumps(["bed", "lamp"]) + " " * 2**21)
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Open a file").set_input_files(path)
    expect(page.locator("#share-done")).to_contain_text("large.json is open")
    expect(page.get_by_label("Scene, JSON")).to_have_value("")
    with path.open("r+b") as file:
        file.truncate(64 * 2**20 + 1)
    board.click("Put on the board")
    assert board.things == ["bed", "lamp"]
    page.get_by_role("button", name="Import, export").click()
    page.get_by_label("Open a file").set_input_files(path)
    expect(page.locator("#json-error")).to_contain_text("more than 64 MiB")


def test_a_table_stands_on_the_board_where_the_file_says(
    open_board: OpenBoard, tmp_path: Path
) -> None:
    board = open_board()
    path = tmp_path / "detections.csv"
    path.write_text(EXAMPLES["detections.csv"].text)
    board.page.get_by_role("button", name="Import, export").click()
    board.page.get_by_label("Open a file").set_input_files(path)
    board.click("Put on the board")
    first, second = board.scene["objects"]
    assert first["position"] == {"x": 2, "y": 0, "z": 0.37}
    assert first["size"] == {"x": 0.8, "y": 1.6, "z": 0.74}
    assert second["position"]["x"] == 2.2
