"""Every reader, on small files of the official layout written here.

A reader is tested by being listed: `LAYOUTS` has a file of every reader in `READERS`.
"""

from __future__ import annotations

import gzip
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.training.scenes import scene
from training.datasets import (
    AnnotatedObject,
    AnnotatedScene,
    DatasetError,
    generate_rooms,
    jsonl,
    read_scenes,
    readers,
)
from training.datasets.priors import (
    COLUMNS,
    MAX_LINE,
    SOURCE,
    read_prior_scenes,
)
from training.fit.configuration import ConfigError, DataConfig
from training.runs.pipeline import read_sources


def check_malformed(path: Path, message: str, where: str | None = None) -> None:
    with pytest.raises(DatasetError, match=message) as caught:
        read_scenes(path)
    assert caught.value.path == path
    assert where is None or caught.value.where == where


def write_json(path: Path, content: Any) -> Path:
    path.write_text(json.dumps(content))
    return path


# ------------------------------------------------------------------------------- JSON lines

DESK_SCENE: dict[str, Any] = {
    "scene_id": "a",
    "source": "robot",
    "group": "lab",
    "room_type": "office",
    "objects": [
        {"id": 0, "label": "desk", "position": [2, 0, 0.4], "size": [0.8, 1.6, 0.8], "yaw": 0.0},
        {"id": 1, "label": "monitor", "position": [2, 0, 1], "supported_by": 0},
        {"id": "x", "label": "cup", "box2d": [1, 2, 3, 4]},
    ],
    "relations": [[1, "on-top", 0], ["x", "right", 1], ["x", "right", 1]],
    "false_relations": [[0, "behind", "x"]],
    "counts": {"cup": 3},
    "viewer_frame": True,
}
BARE_SCENE: dict[str, Any] = {"scene_id": "b", "objects": [{"id": 0, "label": "bed"}]}


def write_jsonl(folder: Path) -> Path:
    path = folder / "scenes.jsonl"
    path.write_text(f"{json.dumps(DESK_SCENE)}\n\n{json.dumps(BARE_SCENE)}\n")
    return path


def test_jsonl(tmp_path: Path) -> None:
    desk = AnnotatedObject("0", "desk", (2.0, 0.0, 0.4), (0.8, 1.6, 0.8))
    monitor = AnnotatedObject("1", "monitor", (2.0, 0.0, 1.0), supported_by="0")
    cup = AnnotatedObject("x", "cup", box2d=(1.0, 2.0, 3.0, 4.0), count=3)
    relations, denied = ((1, "on-top", 0), (2, "right", 1)), ((0, "behind", 2),)
    bed = (AnnotatedObject("0", "bed"),)
    assert read_scenes(write_jsonl(tmp_path)) == [
        AnnotatedScene(
            "a", "robot", "lab", "office", (desk, monitor, cup), relations, True, denied
        ),
        AnnotatedScene("b", "jsonl", "b", None, bed),
    ]  # fmt: skip


def test_jsonl_accepts_the_form_of_a_request(tmp_path: Path) -> None:
    stated = {"subject": "cup_2", "relation": "on-top", "object": "desk"}
    desk = {"label": "desk", "position": {"x": 2, "y": 0, "z": 0.4}}
    desk["size"] = {"x": 1, "y": 2, "z": 1}
    request = {"objects": ["cup", desk, {"label": "cup"}], "relations": [stated]}
    desk = {"id": "desk", "label": "desk", "position": [2, 0, 0.4], "size": [1, 2, 1]}
    cups = [{"id": name, "label": "cup"} for name in ("cup_1", "cup_2")]
    annotated = {"objects": [cups[0], desk, cups[1]], "relations": [["cup_2", "on-top", "desk"]]}
    path = tmp_path / "own.jsonl"
    path.write_text("".join(f"{json.dumps(line)}\n" for line in (request, annotated)))
    first, second = read_scenes(path)
    assert (first.scene_id, first.group, second.scene_id) == (
        "own.jsonl:1", "own.jsonl:1", "own.jsonl:2",
    )  # fmt: skip
    assert (first.objects, first.relations) == (second.objects, second.relations)
    assert first.objects[1].position == (2.0, 0.0, 0.4)


@pytest.mark.parametrize("name", ["again.jsonl", "again.jsonl.gz"])
def test_jsonl_is_read_as_it_was_written(tmp_path: Path, name: str) -> None:
    """Relations of a source whose predicates a reader has translated stay as they are."""
    translated = [
        replace(scene("s", "cup", "table", relations=[(0, "on-top", 1)]), source=source)
        for source in ("3dssg", "vrd", "nr3d")
    ]
    scenes = [*read_scenes(write_jsonl(tmp_path)), *generate_rooms(10, 0), *translated]
    jsonl.write_jsonl(scenes, tmp_path / name)
    assert read_scenes(tmp_path / name) == scenes


def test_each_invalid_line_of_jsonl_is_an_error(tmp_path: Path) -> None:
    path = write_jsonl(tmp_path)
    deep = "[" * 100_000
    path.write_text(f"\ufeff{path.read_text()}[]\n{deep}\n{path.read_text()}")
    with path.open("ab") as file:
        file.write(json.dumps(BARE_SCENE).encode().replace(b"b", b"\xff", 1))
    *valid, first, second, third, fourth, fifth = jsonl.scan_jsonl(path)
    assert [type(scene).__name__ for scene in valid] == ["AnnotatedScene"] * 2
    errors = (first, second, third, fourth, fifth)
    wheres = [getattr(error, "where", None) for error in errors]
    assert wheres == ["line 4", "line 5", "line 6", "line 8", "line 9"]
    with pytest.raises(DatasetError, match="line 4: Input should be an object"):
        read_scenes(path)


def test_a_truncated_gzip_file_is_an_error(tmp_path: Path) -> None:
    packed = tmp_path / "packed.jsonl.gz"
    packed.write_bytes(gzip.compress(write_jsonl(tmp_path).read_bytes())[:-20])
    with pytest.raises(DatasetError, match=r"packed\.jsonl\.gz: cannot be read"):
        read_scenes(packed)


def write_scene(folder: Path, **fields: Any) -> Path:
    """Write one scene of a cup and a table."""
    things = [{"id": 0, "label": "cup"}, {"id": 1, "label": "table"}]
    scene = {"scene_id": "a", "source": "alfred", "objects": things}
    return write_json(folder / "scene.jsonl", scene | fields)


def test_jsonl_translates_the_predicates_of_known_sources(tmp_path: Path) -> None:
    listed = [[0, "on the top of", 1], [0, "wear", 1], [1, "beneath", 1]]
    denied = [[0, "on", 1], [1, "under", 0]]
    fields = {"source": "vrd", "relations": listed, "false_relations": denied}
    (scene,) = read_scenes(write_scene(tmp_path, **fields))
    assert scene.relations == ((0, "on-top", 1),)
    assert scene.false_relations == ((0, "on-top", 1), (1, "under", 0))


def test_older_files_of_bedrooms_have_viewer_axes(tmp_path: Path) -> None:
    (scene,) = read_scenes(write_scene(tmp_path, source="sunrgbd-bedroom-3d"))
    assert scene.viewer_frame is True


def test_counts_name_labels_with_one_object(tmp_path: Path) -> None:
    (scene,) = read_scenes(write_scene(tmp_path, counts={"cup": 3}))
    assert [thing.count for thing in scene.objects] == [3, 1]
    for counts, problem in (
        ({"fork": 1}, "'fork', which needs exactly one object, but the scene has 0"),
        ({"cup": 0}, "count: .* greater than or equal to 1"),
        ({"cup": 10**20}, "count: .* less than or equal to 1000000"),
        ({"cup": 1.5}, r"counts\.cup: .* integer"),
        ({"cup": True}, r"counts\.cup: .* integer"),
    ):
        with pytest.raises(ValueError, match=problem):
            read_scenes(write_scene(tmp_path, counts=counts))


def test_files_of_named_sources_are_read_from_the_folder_extra(tmp_path: Path) -> None:
    (tmp_path / "extra").mkdir()
    scenes = read_scenes(write_scene(tmp_path))
    jsonl.write_jsonl(scenes, tmp_path / "extra" / "nr3d.jsonl.gz")
    (scene,) = read_sources(DataConfig(sources=("nr3d",)), tmp_path)["nr3d"]
    assert scene.source == "nr3d"
    for source in ("vsr", "nr3d.jsonl.gz"):
        with pytest.raises(ConfigError, match="1 of 1 files of scenes are missing"):
            read_sources(DataConfig(sources=(source,)), tmp_path)


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("{", "Invalid JSON"),
        ([], "Input should be an object"),
        ({"scene_id": "a"}, "objects: Field required"),
        *(
            (BARE_SCENE | fields, message)
            for fields, message in (
                ({"scene_id": " "}, "scene_id: "),
                ({"colour": "red"}, "colour: Extra inputs"),
                ({"objects": [["bed"]]}, r"objects\.0: "),
                ({"objects": [{"id": 0}]}, r"0\.label: "),
                ({"objects": [{"id": 0, "label": "a", "sizes": 1}]}, r"0\.sizes: "),
                ({"objects": [{"id": 1.5, "label": "a"}]}, r"0\.id: "),
                ({"objects": BARE_SCENE["objects"] * 2}, "with the same id"),
                ({"viewer_frame": "yes"}, "viewer_frame: "),
                ({"relations": [[0, "left"]]}, r"relations\.0"),
                ({"relations": [{"subject": 0, "object": 0}]}, r"relations\.0"),
                ({"relations": [[0, "left", 7]]}, "not in the scene"),
            )
        ),
        (
            {"objects": ["cup", "cup", "bed"], "relations": [["cup", "left", "bed"]]},
            "not in the scene",
        ),
        (DESK_SCENE | {"relations": [[0, "near", 1]]}, "unknown relation 'near'"),
        *(
            (BARE_SCENE | {"objects": [{"id": 0, "label": "a"} | extra]}, message)
            for extra, message in (
                ({"position": [1, 2]}, r"0\.position"),
                ({"position": [1, 2, "3"]}, r"0\.position\.2"),
                ({"position": {"x": 1, "y": 2}}, r"0\.position"),
                ({"size": [1, 2, -1]}, r"0\.size\.2"),
                ({"yaw": math.nan}, r"0\.yaw: .* finite"),
                ({"box2d": [3, 0, 1, 1]}, r"0\.box2d: must be \(xmin"),
                ({"supported_by": 9}, "supported_by of '0' is '9', which is no object"),
            )
        ),
    ],
)
def test_malformed_jsonl(tmp_path: Path, line: Any, message: str) -> None:
    path = tmp_path / "scenes.jsonl"
    text = line if isinstance(line, str) else json.dumps(line)
    path.write_text(f"{json.dumps(BARE_SCENE | {'scene_id': 'good'})}\n{text}\n")
    check_malformed(path, message, "line 2")


# ------------------------------------------------------------------------------- COCO

COCO: dict[str, Any] = {
    "images": [{"id": 9, "file_name": "9.jpg"}, {"id": 4, "file_name": "4.jpg"}],
    "categories": [{"id": 62, "name": "chair"}, {"id": 67, "name": "dining table"}],
    "annotations": [
        {"id": 1, "image_id": 9, "category_id": 62, "bbox": [10, 100, 50, 80], "iscrowd": 0},
        {"id": 2, "image_id": 9, "category_id": 67, "bbox": [90, 110, 100.5, 60], "iscrowd": 0},
        {"id": 3, "image_id": 9, "category_id": 62, "bbox": [0, 0, 640, 480], "iscrowd": 1},
    ],
}


def write_coco(folder: Path) -> Path:
    return write_json(folder / "instances_val2017.json", COCO)


def test_coco(tmp_path: Path) -> None:
    (scene,) = read_scenes(write_coco(tmp_path))
    assert (scene.scene_id, scene.relations) == ("coco-9", None)
    assert [(thing.label, thing.box2d) for thing in scene.objects] == [
        ("chair", (10.0, 100.0, 60.0, 180.0)),
        ("dining table", (90.0, 110.0, 190.5, 170.0)),
    ]


MALFORMED_COCO = [
    ({"images": [], "annotations": []}, "categories: Field required"),
    (COCO | {"images": []}, r"annotations\.0: image_id 9 is not among the images"),
    (COCO | {"categories": []}, r"annotations\.0: category_id 62 is not among"),
    *(
        (COCO | {"annotations": [COCO["annotations"][0] | {"bbox": box}]}, r"\.0\.bbox\.")
        for box in ([1, 2, 3], [1, 2, -3, 4], [1, 2, 3, "4"])
    ),
    (COCO | {"annotations": COCO["annotations"][:1] * 2}, r"annotations\.1: two annotations"),
]


@pytest.mark.parametrize(("content", "message"), MALFORMED_COCO)
def test_malformed_coco(tmp_path: Path, content: Any, message: str) -> None:
    check_malformed(write_json(write_coco(tmp_path), content), message)


# ------------------------------------------------------------------------------- all of them


@pytest.mark.parametrize("triple", [(0, "left", 1), (-1, "left", 0)])
def test_relations_of_unknown_objects_are_refused(triple: tuple[int, str, int]) -> None:
    problem = r"a relation has object index -?1, but the scene has 1 objects"
    with pytest.raises(ValueError, match=problem):
        AnnotatedScene("s", "t", "g", None, (AnnotatedObject("0", "bed"),), (triple,))


LAYOUTS = {jsonl.read_jsonl: write_jsonl, readers.read_coco: write_coco}


@pytest.mark.parametrize("reader", LAYOUTS, ids=["jsonl", "coco"])
def test_readers_are_found_by_file_name(reader: Any, tmp_path: Path) -> None:
    assert set(LAYOUTS) == set(readers.READERS.values())
    path = LAYOUTS[reader](tmp_path)
    assert readers.reader_of(path) is reader
    scenes = read_scenes(path)
    assert scenes
    assert scenes == reader(path)
    assert len({(scene.source, scene.scene_id) for scene in scenes}) == len(scenes)
    assert all(scene.group for scene in scenes)


@pytest.mark.parametrize("write", LAYOUTS.values())
@pytest.mark.parametrize("content", [None, b"", b"\x00\xff\xfe nonsense", b"[1, 2"])
def test_missing_and_malformed_files(
    write: Callable[[Path], Path], content: bytes | None, tmp_path: Path
) -> None:
    path = write(tmp_path)
    path.unlink() if content is None else path.write_bytes(content)
    if write is write_jsonl and content == b"":
        assert read_scenes(path) == []
        return
    with pytest.raises(DatasetError, match="(?i)" + path.name) as caught:
        read_scenes(path)
    assert caught.value.problem


@pytest.mark.parametrize("box", ["9" * 400 + ", 1, 1, 1]}]}", "[" * 100_000])
def test_huge_numbers_and_deep_lists_in_a_json_file_are_errors(tmp_path: Path, box: str) -> None:
    path = tmp_path / "instances.json"
    annotation = '{"id": 1, "image_id": 1, "category_id": 1, "bbox": ['
    path.write_text('{"categories": [], "images": [], "annotations": [' + annotation + box)
    with pytest.raises(DatasetError, match=r"instances\.json"):
        read_scenes(path)


HEAD = "\t".join(COLUMNS)


def table(folder: Path, *rows: str, head: str = HEAD) -> Path:
    path = folder / "pairs.tsv"
    path.write_text("".join(f"{row}\n" for row in (head, *rows)))
    return path


def test_rows_become_scenes_of_two_objects(tmp_path: Path) -> None:
    path = table(
        tmp_path,
        "virtualhome_placing\tfood bread\ton-top\ttable\t1\tattic",
        "virtualhome_placing\tcup\tat\ttable\t1\t",
        "virtualhome_placing\tcup\tinside\tcabinet\t1\t",
        "ithor_receptacles\tcups\ton-top\tcup\t1\t",
        "ithor_receptacles\tbread\tbelow\ttable\t2\t",
        "housekeep_votes\tcup\tinside\tcabinet\t3\tkitchen",  # votes of people are skipped
    )
    scenes = read_prior_scenes(path)
    assert {scene.source for scene in scenes} == {SOURCE}
    assert [thing.label for thing in scenes[0].objects] == ["bread", "table"]
    assert [(scene.group, scene.relations) for scene in scenes] == [
        ("bread table", ((0, "on-top", 1),)),
        ("cup cabinet", ((0, "inside", 1),)),
        ("bread table", ((0, "below", 1),)),
    ]


@pytest.mark.parametrize(
    ("row", "message"),
    [
        ("nobody\tcup\ton-top\ttable\t1\t", "line 2: unknown source 'nobody'"),
        ("tidybot\tcup\ton-top\ttable\t1", "line 2: the row has 5 columns, not 6"),
        ("x" * MAX_LINE, f"line 2: the line is longer than {MAX_LINE} bytes"),
        ("\udcff", "line 2: is not UTF-8"),
    ],
)
def test_malformed_rows(tmp_path: Path, row: str, message: str) -> None:
    path = tmp_path / "pairs.tsv"
    path.write_bytes(f"{HEAD}\n{row}\n".encode("utf-8", "surrogateescape"))
    with pytest.raises(DatasetError, match=message):
        read_prior_scenes(path)


def test_files_that_are_no_table(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.tsv\.gz: no such file"):
        read_prior_scenes(tmp_path / "none.tsv.gz")
    with pytest.raises(DatasetError, match="line 1: must name the columns source, subject"):
        read_prior_scenes(table(tmp_path, head="a\tb"))
