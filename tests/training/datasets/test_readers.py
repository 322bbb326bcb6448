"""Every reader, on small files of the official layout written here. A reader is tested by being
listed: `LAYOUTS` must name every format of `READERS`."""

import gzip
import itertools
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.io import savemat

from tests.training.scenes import scene
from training.datasets import (
    AnnotatedObject,
    AnnotatedScene,
    DatasetError,
    generate_rooms,
    jsonl,
    read_scenes,
)
from training.datasets.readers import (
    PRIOR_COLUMNS,
    PRIORS,
    READERS,
    guess_format,
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
    assert READERS["jsonl"](write_jsonl(tmp_path)) == [
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


def test_declared_conventions_become_metres_with_z_up(tmp_path: Path) -> None:
    """A frame whose y axis points up, centimetres, half extents, and positions at the bottom."""
    bed = {"label": "bed", "position": [-100, 0, -300], "size": [80, 30, 100], "yaw": 0.5}
    fields = {"up": "y", "units": "cm", "extents": "half", "box_origin": "bottom"}
    (scene,) = read_scenes(write_scene(tmp_path, objects=[bed], **fields))
    (thing,) = scene.objects
    assert thing.position == pytest.approx((3.0, 1.0, 0.3))
    assert thing.size == pytest.approx((2.0, 1.6, 0.6))
    assert thing.yaw == pytest.approx(0.5)
    jsonl.write_jsonl([scene], tmp_path / "again.jsonl")
    (again,) = read_scenes(tmp_path / "again.jsonl")
    assert again == replace(scene, conventions=again.conventions)
    with pytest.raises(DatasetError, match="units: "):
        read_scenes(write_scene(tmp_path, units="ft"))


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
    jsonl.write_jsonl(read_scenes(write_scene(tmp_path)), tmp_path / "extra" / "nr3d.jsonl.gz")
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


RESCANS = [
    {"reference": "room-1", "type": "train", "scans": [{"reference": "room-1b", "removed": []}]},
    {"reference": "room-2", "type": "validation", "scans": []},
]
SCAN = {
    "scan": "room-1b",
    "split": 2,
    "objects": {"1": "floor", "4": "bed", "7": "pillow"},
    "relationships": [
        [7, 4, 15, "lying on"], [4, 1, 14, "standing on"], [7, 4, 1, "left"],
        [4, 7, 2, "right"], [7, 4, 5, "close by"], [7, 7, 9, "bigger than"],
    ],
}  # fmt: skip
WHOLE = {"scans": [{"scan": "room-2", "relationships": [["3", "2", 11, "higher than"]]}]}
THINGS = [
    {"global_id": "6", "label": "shelf", "id": "2", "ply_color": "#aec7e8"},
    {"global_id": "7", "label": "picture", "id": "3", "attributes": {}},
]
OBJECTS = {"scans": [{"scan": "room-2", "objects": THINGS}]}


def write_3dssg(folder: Path) -> Path:
    write_json(folder / "3RScan.json", RESCANS)
    return write_json(folder / "relationships_train.json", {"scans": [SCAN]})


def test_3dssg_splits(tmp_path: Path) -> None:
    (scene,) = READERS["3dssg"](write_3dssg(tmp_path))
    assert (scene.scene_id, scene.group) == ("3dssg-room-1b-2", "3rscan-room-1")
    things = [(thing.id, thing.label) for thing in scene.objects]
    assert things == [("1", "floor"), ("4", "bed"), ("7", "pillow")]
    on_top, left = ((2, "on-top", 1), (1, "on-top", 0)), ((2, "left", 1), (1, "right", 2))
    assert scene.relations == on_top + left


def test_3dssg_whole(tmp_path: Path) -> None:
    write_3dssg(tmp_path)
    write_json(tmp_path / "objects.json", OBJECTS)
    (scene,) = read_scenes(write_json(tmp_path / "relationships.json", WHOLE))
    assert (scene.scene_id, scene.group) == ("3dssg-room-2", "3rscan-room-2")
    assert [thing.label for thing in scene.objects] == ["shelf", "picture"]
    assert scene.relations == ((1, "above", 0),)


def test_3dssg_needs_its_other_files(tmp_path: Path) -> None:
    path = write_json(tmp_path / "relationships.json", WHOLE)
    for file, content, message in (
        ("other.json", [], r"3RScan\.json: no such file"),
        ("3RScan.json", RESCANS, r"objects\.json: no such file"),
        ("objects.json", {"scans": []}, r"scans\.0: scan room-2 is not in objects\.json"),
        ("objects.json", OBJECTS, None),
        ("3RScan.json", RESCANS[:1], r"scans\.0: scan room-2 is not in 3RScan\.json"),
    ):
        write_json(tmp_path / file, content)
        if message:
            with pytest.raises(DatasetError, match=message):
                read_scenes(path)


MALFORMED_3DSSG = [
    ({}, "scans: Field required"),
    *(
        ({"scans": [SCAN | fields]}, message)
        for fields, message in (
            ({"objects": {"1": ""}, "relationships": []}, r"scans\.0\.objects\.1: "),
            ({"relationships": [[7, 4]]}, r"scans\.0\.relationships\.0\.2: "),
            ({"relationships": [[9, 4, 1, "left"]]}, r"scans\.0: .* not in the scan"),
        )
    ),
    ({"scans": [SCAN, SCAN]}, r"scans\.1: scene 3dssg-room-1b-2 is listed twice"),
]


TURN = math.radians(30)
COS, SIN = math.cos(TURN), math.sin(TURN)
TURNED = [[COS, SIN, 0.0], [-SIN, COS, 0.0], [0.0, 0.0, 1.0]]


def box(classname: str, basis: Any, coeffs: list[float], centroid: list[float]) -> dict[str, Any]:
    half, centre = np.array([coeffs]), np.array([centroid])
    extra = {"orientation": np.array([[0.0, -1.0, 0.0]]), "label": np.array([[1]])}
    values = {"basis": np.array(basis), "coeffs": half, "centroid": centre}
    return values | {"classname": classname} | extra


BOXES = [
    box("bed", np.eye(3), [1.0, 0.5, 0.4], [0.5, 3.0, -0.6]),
    # Turned by 30 degrees against the clock, seen from above; a negative half extent occurs.
    box("night_stand", TURNED, [-0.2, 0.3, 0.25], [1.2, 2.5, -0.7]),
]


def struct_array(entries: list[dict[str, Any]]) -> np.ndarray:
    if not entries:
        return np.zeros((0, 0))
    array = np.empty((1, len(entries)), dtype=[(name, object) for name in entries[0]])
    for column, entry in enumerate(entries):
        array[0, column] = tuple(entry.values())
    return array


def frame(name: str, boxes: list[dict[str, Any]]) -> dict[str, Any]:
    extra = {"Rtilt": np.eye(3), "K": np.eye(3), "sensorType": "kv2", "valid": np.array([[1]])}
    return {"sequenceName": name, "groundtruth3DBB": struct_array(boxes)} | extra


def write_mat(folder: Path) -> Path:
    path = folder / "SUNRGBDMeta3DBB_v2.mat"
    frames = [
        frame("SUNRGBD/kv2/kinect2data/0001", BOXES),
        frame("SUNRGBD/kv2/kinect2data/0002", []),
        frame("SUNRGBD/kv2/kinect2data/0003", BOXES[:1]),
        frame("SUNRGBD/xtion/sun3ddata/brown_1/f1/", BOXES[:1]),
        frame("SUNRGBD/xtion/sun3ddata/brown_1/f2/", BOXES[:1]),
    ]
    room = folder / "SUNRGBD/kv2/kinect2data/0001"
    room.mkdir(parents=True, exist_ok=True)
    (room / "scene.txt").write_text("bedroom")
    savemat(path, {"SUNRGBDMeta": struct_array(frames)})
    return path


def test_sunrgbd_mat(tmp_path: Path) -> None:
    scenes = READERS["sunrgbd-mat"](write_mat(tmp_path))
    assert [scene.scene_id.rpartition("/")[2] for scene in scenes] == ["0001", "0003", "f1", "f2"]
    assert [scene.room_type for scene in scenes] == ["bedroom", None, None, None]
    first, second, brown, brown_again = (scene.group for scene in scenes)
    assert first == second != brown == brown_again
    assert all(scene.viewer_frame for scene in scenes)
    bed, stand = scenes[0].objects
    assert (bed.label, stand.label) == ("bed", "night_stand")
    # 3 m away and half a metre to the right: x away, y left.
    assert bed.position == (3.0, -0.5, -0.6)
    assert stand.size == pytest.approx((0.4, 0.6, 0.5))
    assert [corners(bed), corners(stand)] == [expected_corners(box) for box in BOXES]


SIGNS = np.array(list(itertools.product((-1, 1), repeat=2)))


def corners(thing: Any) -> list[list[float]]:
    cos, sin = math.cos(thing.yaw), math.sin(thing.yaw)
    points = SIGNS * thing.size[:2] / 2 @ [[cos, sin], [-sin, cos]] + thing.position[:2]
    return sorted(points.round(6).tolist())


def expected_corners(box: dict[str, Any]) -> list[list[float]]:
    """Centroid plus signed half extents along the basis; x is away from the viewer, y left."""
    points = box["centroid"][0] + np.c_[SIGNS, np.zeros(4)] * box["coeffs"][0] @ box["basis"]
    return sorted(np.c_[points[:, 1], -points[:, 0]].round(6).tolist())


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("coeffs", np.array([[1.0, 0.5]])),
        ("centroid", np.array([[1.0, math.nan, 0.0]])),
        ("basis", "none"),
        ("classname", ""),
    ],
)
def test_malformed_sunrgbd_mat(tmp_path: Path, field: str, value: Any) -> None:
    path = tmp_path / "SUNRGBDMeta3DBB_v2.mat"
    boxes = [BOXES[0] | {field: value}]
    savemat(path, {"SUNRGBDMeta": struct_array([frame("SUNRGBD/kv2/a/1", boxes)])})
    check_malformed(path, field, f"0.groundtruth3DBB.0.{field}")


def test_mat_files_of_other_content(tmp_path: Path) -> None:
    path = tmp_path / "other.mat"
    savemat(path, {"data": np.eye(2)})
    check_malformed(path, "lacks the variable SUNRGBDMeta")
    savemat(path, {"SUNRGBDMeta": struct_array([{"K": np.eye(3)}])})
    check_malformed(path, "Field required", "0.sequenceName")


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
    (scene,) = READERS["coco"](write_coco(tmp_path))
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


@pytest.mark.parametrize(
    ("write", "content", "message"),
    [
        *((write_3dssg, *case) for case in MALFORMED_3DSSG),
        *((write_coco, *case) for case in MALFORMED_COCO),
    ],
)
def test_malformed_json(tmp_path: Path, write: Any, content: Any, message: str) -> None:
    check_malformed(write_json(write(tmp_path), content), message)


@pytest.mark.parametrize("triple", [(0, "left", 1), (-1, "left", 0)])
def test_relations_of_unknown_objects_are_refused(triple: tuple[int, str, int]) -> None:
    problem = r"a relation has object index -?1, but the scene has 1 objects"
    with pytest.raises(ValueError, match=problem):
        AnnotatedScene("s", "t", "g", None, (AnnotatedObject("0", "bed"),), (triple,))


LAYOUTS = {"jsonl": write_jsonl, "3dssg": write_3dssg, "sunrgbd-mat": write_mat, "coco": write_coco}


@pytest.mark.parametrize("name", READERS)
def test_readers_are_found_by_file_name(name: str, tmp_path: Path) -> None:
    path = LAYOUTS[name](tmp_path)
    assert guess_format(path) == name
    scenes = read_scenes(path)
    assert scenes
    assert scenes == READERS[name](path)
    assert len({(scene.source, scene.scene_id) for scene in scenes}) == len(scenes)
    assert all(scene.group for scene in scenes)


@pytest.mark.parametrize("name", READERS)
@pytest.mark.parametrize("content", [None, b"", b"\x00\xff\xfe nonsense", b"[1, 2"])
def test_missing_and_malformed_files(name: str, content: bytes | None, tmp_path: Path) -> None:
    path = LAYOUTS[name](tmp_path)
    path.unlink() if content is None else path.write_bytes(content)
    if name == "jsonl" and content == b"":
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


def test_rows_become_scenes_of_two_objects(tmp_path: Path) -> None:
    rows = [
        "\t".join(PRIOR_COLUMNS),
        "virtualhome_placing\tfood bread\ton-top\ttable\t1\tattic",
        "virtualhome_placing\tcup\tat\ttable\t1\t",
        "virtualhome_placing\tcup\tinside\tcabinet\t1\t",
        "ithor_receptacles\tcups\ton-top\tcup\t1\t",
        "ithor_receptacles\tbread\tbelow\ttable\t2\t",
        "housekeep_votes\tcup\tinside\tcabinet\t3\tkitchen",  # votes of people are skipped
    ]
    path = tmp_path / "pairs.tsv"
    path.write_text("\n".join(rows))
    scenes = read_prior_scenes(path)
    assert {scene.source for scene in scenes} == {PRIORS}
    assert [thing.label for thing in scenes[0].objects] == ["bread", "table"]
    assert [(scene.group, scene.relations) for scene in scenes] == [
        ("bread table", ((0, "on-top", 1),)),
        ("cup cabinet", ((0, "inside", 1),)),
        ("bread table", ((0, "below", 1),)),
    ]
    path.write_text("\n".join([*rows, "nobody\tcup\ton-top\ttable\t1\t"]))
    with pytest.raises(DatasetError, match=r"line 8, column source: must be .*, not 'nobody'"):
        read_prior_scenes(path)
