"""Reading of scenes: ids, labels, relations, poses, and warnings."""

import math
from typing import Any

import pytest
from httpx import AsyncClient

from scene_client.schemas import RoomsAnswer
from tests.http.test_problems import pointers, problem
from tests.http.test_questions import LAMP_ON_DESK, ask, at, triples

CAMERA = "camera_optical_frame"
Triples = set[tuple[str, str, str]]


async def read(client: AsyncClient, **scene: Any) -> tuple[dict[str, str], Triples]:
    """The label of every object by its id, and the relations that the scene states."""
    answer = await ask(client, "outliers", **scene)
    labels = {entry["object"]: entry["label"] for entry in answer["outliers"]}
    return labels, triples(answer["misplaced"])


async def observed(client: AsyncClient, **scene: Any) -> Triples:
    """The relations that are derived from poses."""
    return triples((await ask(client, "outliers", **scene)).get("observed_relations", []))


@pytest.mark.parametrize(
    ("objects", "expected"),
    [
        (["bed", "TV"], {"bed": "bed", "TV": "television"}),
        (["chair", "chair"], {"chair_1": "chair", "chair_2": "chair"}),
        (
            ["chair", {"id": "chair_1", "label": "table"}, "chair"],
            {"chair_2": "chair", "chair_1": "table", "chair_3": "chair"},
        ),
        (["chair", {"id": "c", "label": "chair"}], {"chair": "chair", "c": "chair"}),
        ([{"id": "chair", "label": "table"}, "chair"], {"chair": "table", "chair_1": "chair"}),
        ([{"label": "lamp"}, {"label": "lamp"}], {"lamp_1": "lamp", "lamp_2": "lamp"}),
    ],
)
async def test_labels_are_ids_of_objects(client, objects, expected):
    assert (await read(client, objects=objects))[0] == expected


async def test_ids_come_before_labels(client: AsyncClient) -> None:
    objects = [{"id": "lamp", "label": "bed"}, {"id": "x", "label": "lamp"}, "trash can"]
    stated = [["lamp", "left", "x"], ["Garbage_Bins", "behind", "beds"]]
    answer = await ask(client, "relations", objects=objects, relations=stated, top_k=4096)
    marked = triples([entry for entry in answer["relations"] if entry["observed"]])
    assert marked == {("lamp", "left", "x"), ("lamp", "front", "trash can")}


async def test_a_repeated_relation_is_no_contradiction(client: AsyncClient) -> None:
    stated = [["bed", "left", "lamp"], ["lamp", "right", "bed"]]
    stated.append(["bed", "front", "lamp"])
    _, found = await read(client, objects=["bed", "lamp"], relations=stated)
    assert {("bed", "front", "lamp")} < found
    assert len(found) == 2


async def test_ignored_labels_remove_their_relations(client: AsyncClient) -> None:
    scene: dict[str, Any] = {
        "objects": ["bed", "flux capacitor", {"id": "r2", "label": "droid"}, "lamp"],
        "relations": [
            ["lamp", "left", "Flux_Capacitor"],
            ["r2", "left", "bed"],
            ["lamp", "left", "bed"],
        ],
        "room_type": "hangar",
        "unknown_labels": "ignore",
    }
    answer = await ask(client, "outliers", **scene)
    assert answer["ignored"] == ["flux capacitor", "r2", "hangar"]
    known = {"objects": ["bed", "lamp"], "relations": scene["relations"][2:]}
    expected = await ask(client, "outliers", **known)
    assert answer | {"request_id": "", "ignored": []} == expected | {"request_id": ""}
    response = await client.post("/outliers", json={**scene, "objects": ["droid"]})
    assert pointers(response)[0] == "#/objects"


async def test_unknown_labels_become_the_nearest_class(client: AsyncClient) -> None:
    scene: dict[str, Any] = {
        "objects": ["bed", "nigthstand", {"id": "x", "label": "big lamp"}, "nigthstand"],
        "relations": [["big lamp", "left", "bed"], ["lamp", "front", "bed"]],
        "room_type": "bedrom",
        "unknown_labels": "nearest",
    }
    answer = await ask(client, "outliers", **scene)
    mapped = [(one["label"], one["class"]) for one in answer["mapped"]]
    assert mapped == [("nigthstand", "nightstand"), ("big lamp", "lamp"), ("bedrom", "bedroom")]
    assert all(0.8 <= one["similarity"] <= 1 for one in answer["mapped"])
    own = [{"id": f"nigthstand_{k}", "label": "nightstand"} for k in (1, 2)]
    expected = await ask(
        client,
        "outliers",
        objects=["bed", own[0], {"id": "x", "label": "lamp"}, own[1]],
        relations=[["x", "left", "bed"], ["x", "front", "bed"]],
        room_type="bedroom",
    )
    stated = {(one["relation"], one["probability"]) for one in expected["misplaced"]}
    assert {(one["relation"], one["probability"]) for one in answer["misplaced"]} == stated
    words = {one["object"]: one.pop("listed_as", None) for one in answer["outliers"]}
    misspelt = {f"nigthstand_{k}": "nigthstand" for k in (1, 2)}
    assert words == {"bed": None, "x": "big lamp", **misspelt}
    assert answer["outliers"] == expected["outliers"]
    # A label that is like none is refused all the same. Such a room type is ignored.
    scene |= {"objects": [*scene["objects"], "droid"], "room_type": "hangar"}
    response = await client.post("/outliers", json=scene)
    assert pointers(response, "unknown-labels") == ["#/objects/4"]


WORDS: dict[str, Any] = {
    "objects": ["bed", {"id": "o", "label": "Futon_3"}, "futons", "zxqvw", "nigthstand"],
    "unknown_labels": "by-meaning",
}


@pytest.mark.parametrize("model", ["home", "candidate", "plain"])
async def test_words_are_read_by_meaning(client: AsyncClient, model: str) -> None:
    """Two spellings are one word. A spelling is corrected first, and nonsense is left out."""
    scene = WORDS | {"model": model, "relations": [["o", "on-top", "bed"]]}
    answer = await ask(client, "outliers", **scene)
    assert answer["ignored"] == ["zxqvw"]
    *read, spelt = answer["mapped"]
    assert [one["label"] for one in read] == ["Futon_3", "futons"]
    assert {one["rule"] for one in read} == {"meaning"}
    assert {one["class"] for one in read} < {"bed", "table", "chair", "sofa", "pillow"}
    assert all(0 < one["similarity"] < 1 for one in read)
    assert (spelt["class"], spelt["rule"]) == ("nightstand", "spelling")
    listed = {one["object"]: (one["label"], one.get("listed_as")) for one in answer["outliers"]}
    expected = {"o": ("futon", "Futon_3"), "futons": ("futon", "futons")}
    assert expected.items() <= listed.items()
    assert not any(one["is_outlier"] for one in answer["outliers"] if one["object"] in expected)
    for question in ("missing", "rooms", "relations", "generate"):
        other = await ask(client, question, **scene, **({"seed": 1} if "gen" in question else {}))
        assert (other["mapped"], other["ignored"]) == (answer["mapped"], answer["ignored"])
    drawn = await ask(client, "generate", **scene, seed=1)
    assert drawn["listed_as"]["futon"] == "Futon_3"
    assert all("futon" in one["objects"] for one in drawn["scenes"])


async def test_a_candidate_is_read_by_its_meaning(client: AsyncClient) -> None:
    body = WORDS | {"objects": ["bed"], "candidates": ["Mugs", "lamp", "zxqvw"], "coverage": 0.5}
    answer = await ask(client, "missing", **body)
    assert answer["ignored"] == ["zxqvw"]
    words = {one["label"]: one.get("listed_as") for one in answer["missing"]}
    assert words == {"lamp": None, "mug": "Mugs"}
    (mapped,) = answer["mapped"]
    assert (mapped["label"], mapped["rule"]) == ("Mugs", "meaning")
    # A place may be at a word, and a word may be at a place.
    at_word = WORDS | {"at": {"relation": "on-top", "object": "FUTONS"}, "top_k": 3}
    at_word["objects"] = ["bed", "futon"]
    assert len((await ask(client, "missing", **at_word))["missing"]) == 3
    body |= {"at": {"relation": "on-top", "object": "bed"}}
    answer = await ask(client, "missing", **body)
    assert {one["label"] for one in answer["missing"]} == {"lamp", "mug"}


async def test_words_need_the_treatment_by_meaning(client: AsyncClient) -> None:
    for treatment in ("error", "nearest"):
        response = await client.post("/rooms", json=WORDS | {"unknown_labels": treatment})
        assert "#/objects/2" in pointers(response, "unknown-labels")
    answer = await ask(client, "rooms", **WORDS | {"unknown_labels": "nearest-or-ignore"})
    assert answer["ignored"] == ["o", "futons", "zxqvw"]
    known = {"objects": ["bed", "lamp", "nigthstand"]}
    first, second = [
        await ask(client, "missing", **known, unknown_labels=treatment)
        for treatment in ("nearest-or-ignore", "by-meaning")
    ]
    assert first | {"request_id": ""} == second | {"request_id": ""}


async def test_poses_of_words_give_relations(client: AsyncClient) -> None:
    placed = [
        *LAMP_ON_DESK,
        {"id": "m", "label": "mug", "position": at(2, 0, 0.85), "size": at(0.1, 0.1, 0.1)},
        {"id": "p", "label": "spaceship", "position": at(2, -0.4, 0.85)},
    ]
    answer = await ask(client, "outliers", objects=placed, unknown_labels="by-meaning")
    assert ("m", "on-top", "d") in triples(answer["observed_relations"])
    unsized = [one for one in answer["warnings"] if one["code"] == "unknown-sizes"]
    assert [one["objects"] for one in unsized] == [["p"]]


@pytest.mark.parametrize(
    ("label", "expected", "rule"),
    [
        ("lamp_(light_source)", "lamp", "qualifier"),
        ("table_(desk)", "table", "qualifier"),  # the model knows "desk table"
        ("bin (trash can)", None, None),
        ("divan/couch;lounge", "sofa", "alternative"),
        ("desk/waste basket", "desk", "alternative"),
        ("waste/trash basket", "garbage bin", "alternative"),  # both are baskets
        ("The lamp", "lamp", "article"),
        ("chair_12", "chair", "instance"),
        ("Book_b045e42b", "book", "instance"),
        ("book_v2", "book", "instance"),
        ("book.n.01", "book", "instance"),
        ("book.n.01_3", "book", "instance"),
        ("objects/book_a1b2", "book", "instance"),
        ("study::book_1::link", "book", "instance"),
        ("Bed|-01.0|+00.0", "bed", "instance"),
        ("011_pillow", "pillow", "instance"),
        ("a photo of a chair", "chair", "prompt"),
        ("a photo of a sofa/couch", "sofa", "alternative"),
        ("chair facade", None, None),
        ("3d lamp", None, None),
    ],
)
@pytest.mark.parametrize("treatment", ["error", "ignore", "nearest-or-ignore"])
async def test_the_syntax_of_detectors_is_read(client, treatment, label, expected, rule):
    scene = {"objects": [{"id": "x", "label": label}, "lamp"], "unknown_labels": treatment}
    response = await client.post("/outliers", json=scene)
    if expected is None and treatment == "error":
        problem(response, 422, "unknown-labels")
    elif expected is None and treatment == "ignore":
        assert (response.json()["mapped"], response.json()["ignored"]) == ([], ["x"])
    elif expected is not None:
        entry = {"label": label, "class": expected, "similarity": 1.0, "rule": rule}
        assert response.json()["mapped"] == [entry]


async def test_aliases_of_room_types_and_candidates_are_named(client: AsyncClient) -> None:
    """Aliases of objects are not mapped, because answers name objects by id."""
    study = {"label": "study", "class": "office", "similarity": 1.0, "rule": "alias"}
    answer = await ask(client, "rooms", objects=["couch"], candidates=["study", "Bedrooms"])
    assert {one["room_type"] for one in answer["room_types"]} == {"office", "bedroom"}
    assert answer["mapped"] == [study]
    candidates = ["tv", "bottle of milk", "Lamps", "box of books", "pair of sofas"]
    body = {"objects": ["couch"], "room_type": "study", "unknown_labels": "ignore"}
    answer = await ask(client, "missing", **body, candidates=candidates)
    assert answer["ignored"] == ["bottle of milk", "box of books"]
    assert [(one["label"], one["class"], one["rule"]) for one in answer["mapped"]] == [
        ("study", "office", "alias"),
        ("tv", "television", "alias"),
        ("pair of sofas", "sofa", "phrase"),
    ]


Words = set[tuple[str, str | None]]


def words_of(entries: list[dict[str, Any]]) -> Words:
    """The class of each entry, and the word of the request if it differs."""
    return {(entry["label"], entry.get("listed_as")) for entry in entries}


async def test_entries_have_class_and_word(client: AsyncClient) -> None:
    objects = ["bed", "TV", "Chairs", {"id": "s", "label": "couch"}, "desk", "table"]
    answer = await ask(client, "outliers", objects=objects)
    assert {(one["object"], *entry) for one in answer["outliers"] for entry in words_of([one])} == {
        ("bed", "bed", None),
        ("TV", "television", "TV"),
        ("Chairs", "chair", "Chairs"),
        ("s", "sofa", "couch"),
        ("desk", "desk", None),
        ("table", "table", None),
    }
    broader = {one["object"]: one["broader"] for one in answer["outliers"] if "broader" in one}
    assert broader == {"desk": ["table"]}
    # Candidates of one class have one entry, with the word of the first.
    candidates = ["desk", "Sofas", "couch", "tv", "television", "table"]
    answer = await ask(client, "missing", objects=["bed"], candidates=candidates)
    expected: Words = {("desk", None), ("sofa", "Sofas"), ("television", "tv"), ("table", None)}
    assert words_of(answer["missing"]) == expected


async def test_sampled_scenes_have_classes(client: AsyncClient) -> None:
    objects = ["bed", "couch", {"id": "s", "label": "Sofas"}]
    relations = [["couch", "left", "bed"]]
    answer = await ask(client, "generate", objects=objects, relations=relations, steps=1)
    assert answer["listed_as"] == {"sofa": "couch"}
    (scene,) = answer["scenes"]
    assert {"bed", "sofa"} <= set(scene["objects"])
    assert ("sofa", "left", "bed") in triples(scene["relations"])
    assert "listed_as" not in await ask(client, "generate", objects=["bed", "sofa"], steps=1)


@pytest.mark.parametrize("treatment", ["ignore", "nearest", "nearest-or-ignore"])
async def test_unknown_room_types_are_ignored(client: AsyncClient, treatment: str) -> None:
    """Without a room type that it knows, `/generate` has no question to answer."""
    scene: dict[str, Any] = {"objects": ["bed", "lamp"], "unknown_labels": treatment}
    for question in ("missing", "outliers", "relations", "rooms"):
        known = await ask(client, question, **scene)
        answer = await ask(client, question, **scene, room_type="Room 17")
        assert answer["ignored"] == ["Room 17"]
        assert answer | {"request_id": "", "ignored": []} == known | {"request_id": ""}
    response = await client.post("/generate", json=scene | {"room_type": "Room 17"})
    assert pointers(response, "unknown-labels") == ["#/room_type"]
    # Candidates of `/rooms` are room types too.
    answer = await ask(client, "rooms", **scene, candidates=["hangar", "office"])
    assert answer["ignored"] == ["hangar"]
    entries = [(one["room_type"], one["probability"]) for one in answer["room_types"]]
    assert entries == [("office", 1.0)]


async def test_candidates_of_one_room_type_share_its_probability(client: AsyncClient) -> None:
    names = ["toilet", "bedroom", "bathroom", "Toilet", "toilet", "study"]
    answer = await ask(client, "rooms", objects=["bed", "lamp"], candidates=names)
    found = {one.room_type: one for one in RoomsAnswer.model_validate(answer).room_types}
    assert {name: one.listed_as for name, one in found.items()} == {
        "bathroom": ["toilet", "bathroom", "Toilet"],
        "bedroom": None,
        "office": ["study"],
    }
    once = ["bathroom", "bedroom", "office"]
    every = await ask(client, "rooms", objects=["bed", "lamp"], candidates=once)
    p = {one["room_type"]: one["probability"] for one in every["room_types"]}
    assert {name: one.probability for name, one in found.items()} == p
    assert sum(p.values()) == pytest.approx(1, abs=1e-3)


async def test_a_training_scene_is_a_request(client: AsyncClient) -> None:
    bed = {"id": 0, "label": "bed", "position": [2, 1, 0.2], "size": [2, 1.5, 0.4], "yaw": 0.5}
    scene = {
        "scene_id": "bench-3",
        "source": "own",
        "group": None,
        "room_type": "bedroom",
        "objects": [bed, {"id": 1, "label": "lamp"}, {"id": 2, "label": "book", "supported_by": 1}],
        "relations": [[1, "on-top", 0]],
    }
    answer = await ask(client, "outliers", **scene)
    assert triples(answer["misplaced"]) == {("1", "on-top", "0"), ("2", "on-top", "1")}
    assert answer["frame_id"] == "map"
    assert "frame_id" not in await ask(client, "outliers", **scene, viewer_frame=True)
    # The same boxes as arrays and as objects.
    boxes = [
        {**entry, "position": [*entry["position"].values()], "size": [*entry["size"].values()]}
        for entry in LAMP_ON_DESK
    ]
    assert await observed(client, objects=boxes) == await observed(client, objects=LAMP_ON_DESK)
    yaw, orientation = [
        await ask(client, "outliers", objects=[boxes[0] | turn, boxes[1]])
        for turn in ({"yaw": 0.5}, {"orientation": [0, 0, math.sin(0.25), math.cos(0.25)]})
    ]
    assert yaw | {"request_id": ""} == orientation | {"request_id": ""}


async def test_a_map_without_a_viewpoint_shows_no_sides(client: AsyncClient) -> None:
    """The recorder's tests compare the relations in other frames with those of the training."""
    chair = {"id": "c", "label": "chair", "position": at(2, 1.4, 0.3), "size": at(0.5, 0.5, 0.9)}
    things = [*LAMP_ON_DESK, chair]
    stacked = ("l", "on-top", "d")
    assert await observed(client, objects=things) >= {stacked, ("c", "left", "d")}
    assert await observed(client, objects=things, frame_id="map") == {stacked}


def boxes(count: int, **size: float) -> list[dict[str, Any]]:
    """Books in a row, in the plane z = 0."""
    return [
        {"id": str(k), "label": "book", "position": at(0.4 * k, 0.1 * k, 0), "size": size}
        for k in range(count)
    ]


CUBE = at(0.2, 0.2, 0.2)
FAR = {"id": "far", "label": "chair", "position": at(2000, 300, 400), "size": at(1, 1, 1)}
MOVED = [thing | {"position": thing["position"] | {"x": 502.0}} for thing in LAMP_ON_DESK]
NEAR = {"x": 499, "y": 0, "yaw": 0}
SIZES = [
    {"id": "a", "label": "bed", "size": at(500, 2, 1)},
    {"id": "b", "label": "bed", "size": at(0, 0, 0.0005)},
]
# The vocabulary has typical sizes of lamps and desks, of beds it has none.
BARE = [{key: value for key, value in one.items() if key != "size"} for one in LAMP_ON_DESK]
BED = {"id": "b", "label": "bed", "position": at(2, 1, 0.3)}


@pytest.mark.parametrize(
    ("scene", "code", "named"),
    [
        ({"objects": ["bed", "lamp"]}, None, []),
        ({"objects": LAMP_ON_DESK}, None, []),
        ({"objects": LAMP_ON_DESK, "frame_id": "map"}, None, []),
        # Millimetres.
        ({"objects": [*LAMP_ON_DESK, FAR]}, "implausible-position", ["far"]),
        ({"objects": SIZES}, "implausible-size", ["a", "b"]),
        ({"objects": [{"label": "bed", "size": at(2, 3, 0)}]}, None, []),
        # A map may be large, but not around the robot.
        ({"objects": MOVED}, "implausible-position", ["d", "l"]),
        ({"objects": MOVED, "frame_id": "map"}, None, []),
        ({"objects": MOVED, "frame_id": "map", "viewpoint": NEAR}, None, []),
        # A camera without depth.
        ({"objects": boxes(3, **CUBE), "frame_id": CAMERA}, "flat-scene", ["0", "1", "2"]),
        ({"objects": boxes(2, **CUBE), "frame_id": CAMERA}, None, []),
        ({"objects": boxes(3, **CUBE), "frame_id": "base_link"}, None, []),
        ({"objects": [*BARE, BED]}, "unknown-sizes", ["b"]),
        ({"objects": [BARE[0], BED]}, "unknown-sizes", ["b"]),
        ({"objects": [BED]}, None, []),
        ({"objects": [*BARE, BED], "relations": []}, None, []),
    ],
)
async def test_implausible_scenes_get_warnings(client, scene, code, named):
    found = (await ask(client, "missing", **scene))["warnings"]
    assert [(one["code"], one["objects"]) for one in found] == ([(code, named)] if code else [])
    assert all(one["message"] for one in found)
