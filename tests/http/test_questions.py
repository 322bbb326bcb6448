"""The questions, answered by real artifacts of every variant."""

import json
import math
import re
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from httpx import AsyncClient

from app import questions
from app.model import Counts
from app.questions import QUESTIONS
from app.scene import RelationTable, Scene, SceneObject
from scene_client.frames import is_world_fixed, viewer_axes
from tests.http.stores import PROFILES, VOCABULARY, C, V, publish
from tests.http.test_problems import problem
from tests.questions.test_placements import offsets_of_every_pair
from tests.services import defect, serve


def at(x: float, y: float, z: float) -> dict[str, float]:
    return {"x": x, "y": y, "z": z}


SCENES = [question for question in QUESTIONS if question.rooms_of is None]
ANSWERS = {question.name: question.response for question in SCENES}
SCENE: dict[str, Any] = {
    "objects": ["bed", "chair", "chair", {"id": "l", "label": "lamp", "confidence": 0.5}],
    "relations": [{"subject": "l", "relation": "on-top", "object": "bed"}],
    "room_type": "bedroom",
}
LAMP_ON_DESK: list[dict[str, Any]] = [
    {"id": "d", "label": "desk", "position": at(2, 0, 0.4), "size": at(0.7, 1.4, 0.8)},
    {"id": "l", "label": "lamp", "position": at(2, 0.5, 1), "size": at(0.2, 0.2, 0.4)},
]
MODELS = ["home", "home@1.1.0", "candidate", "plain", "general@0.1.0"]


def triples(listed: list[dict[str, Any]]) -> set[tuple[str, str, str]]:
    return {(entry["subject"], entry["relation"], entry["object"]) for entry in listed}


async def ask(client: AsyncClient, question: str, **request: Any) -> dict[str, Any]:
    """Return the answer, which must match its schema without further fields."""
    response = await client.post(f"/{question}", json=request)
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "application/json"
    answer: dict[str, Any] = json.loads(response.content, parse_constant=pytest.fail)
    validated = ANSWERS[question].model_validate(answer, extra="forbid")
    assert json.loads(validated.model_dump_json(exclude_none=True)) == answer
    return answer


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("question", ANSWERS)
async def test_every_model_answers(client: AsyncClient, question: str, model: str) -> None:
    stamp = {"sec": 12, "nanosec": 5}
    answer = await ask(client, question, **SCENE, model=model, frame_id="map", stamp=stamp)
    name = {"home": "home@1.1.0", "candidate": "home@1.1.0", "plain": "plain@1.0.0"}.get(model)
    used = answer["model"]
    assert f"{used['name']}@{used['version']}" == (name or model)
    assert len(used["digest"]) == 64
    assert (answer["frame_id"], answer["stamp"]) == ("map", stamp)
    assert answer["ignored"] == answer["mapped"] == answer["warnings"] == []
    numbers = re.findall(r"-?\d+\.\d+(?:e-?\d+)?", json.dumps(answer | {"model": None}))
    assert all(x == float(f"{x:.6g}") for x in map(float, numbers)), "six significant digits"


@pytest.mark.parametrize("question", ANSWERS)
async def test_observed_relations_are_returned(client: AsyncClient, question: str) -> None:
    answer = await ask(client, question, objects=LAMP_ON_DESK)
    assert answer["observed_relations"] == [{"subject": "l", "relation": "on-top", "object": "d"}]
    assert "observed_relations" not in await ask(client, question, objects=["desk", "lamp"])
    odd = {"label": "lamp", "size": at(200, 200, 400)}
    (warning,) = (await ask(client, question, objects=["bed", odd]))["warnings"]
    assert (warning["code"], warning["objects"]) == ("implausible-size", ["lamp"])


@pytest.mark.parametrize(
    ("question", "details"),
    [
        ("missing", {"placements", "because"}),
        ("outliers", {"because", "usually_with"}),
        ("rooms", {"because"}),
    ],
)
async def test_scores_and_details(client: AsyncClient, question: str, details: set[str]) -> None:
    entries, name = {}, {"rooms": "room_types"}.get(question, question)
    for detail in ("full", "scores"):
        body = {**SCENE, "detail": detail}
        answer = (await client.post(f"/{question}", json=body)).json()
        ANSWERS[question].model_validate(answer, extra="forbid")
        batch = (await client.post(f"/{question}/batch", json={"scenes": [body]})).json()
        entries[detail] = answer[name]
        assert batch["results"][0]["result"][name] == answer[name]
    assert entries["scores"] == [
        {field: value for field, value in entry.items() if field not in details}
        for entry in entries["full"]
    ]
    assert all(details <= entry.keys() for entry in entries["full"])


async def test_a_model_without_room_types_names_none(tmp_path: Path) -> None:
    publish(tmp_path, "new", "1.0.0", classes=5, room_types=0, alias="default")
    async with serve(tmp_path) as client:
        answer = await ask(client, "rooms", objects=["bed"])
        assert answer["room_types"] == []
        assert [one["code"] for one in answer["warnings"]] == ["not-judged"]


async def test_rare_room_types_are_named_and_not_sampled(tmp_path: Path) -> None:
    """The other questions accept them. Without a room type, no scene has a rare one."""
    publish(tmp_path, "home", "1.0.0", calibration={"rare_rooms": (1,)}, alias="default")
    async with serve(tmp_path) as client:
        words = (await client.get("/models/default/vocabulary")).json()
        (rare,) = words["rare_room_types"]
        assert rare == words["room_types"][1]
        request = {"objects": ["bed"], "room_type": rare}
        document = problem(await client.post("/generate", json=request), 422, "rare-room-type")
        assert [one["pointer"] for one in document["errors"]] == ["#/room_type"]
        assert (await client.post("/missing", json=request)).status_code == 200
        other = await ask(client, "generate", room_type=words["room_types"][0], count=2)
        assert {one["room_type"] for one in other["scenes"]} == {words["room_types"][0]}


async def test_the_seed_is_reported(client: AsyncClient) -> None:
    first = await ask(client, "generate", count=3)
    assert 0 <= first["seed"] < 2**53
    again = await ask(client, "generate", count=3, seed=first["seed"])
    assert first["scenes"] == again["scenes"]
    assert (await ask(client, "generate", count=3))["seed"] != first["seed"]


@pytest.mark.parametrize(
    ("variant", "classes"), [("rbm", 1), ("gbm", 1), ("triway", 1), ("triway", 3)]
)
async def test_models_of_few_classes_answer(tmp_path: Path, variant: str, classes: int) -> None:
    publish(tmp_path, "tiny", "1.0.0", variant=variant, classes=classes, alias="default")
    async with serve(tmp_path) as client:
        assert (await client.get("/health/ready")).status_code == 200
        for question in ANSWERS:
            # The default top_k is larger than these vocabularies.
            await ask(client, question, objects=["bed"])
        refused = await client.post("/missing", json={"objects": ["bed"], "top_k": classes + 1})
        assert refused.status_code == 422


async def test_a_model_of_too_few_scenes_gives_no_judgement(tmp_path: Path) -> None:
    publish(tmp_path, "new", "1.0.0", alias="default", calibration={})
    async with serve(tmp_path) as client:
        on_top = [["lamp", "on-top", "bed"]]
        for relations, parts in (([], ["objects"]), (on_top, ["objects", "relations"])):
            answer = await ask(client, "outliers", objects=["bed", "lamp"], relations=relations)
            assert answer["outliers"] == answer["misplaced"] == []
            assert "threshold" not in answer
            assert [one["code"] for one in answer["warnings"]] == ["not-judged"] * len(parts)
            for warning, part in zip(answer["warnings"], parts, strict=True):
                assert f"does not judge {part}" in warning["message"]
        assert (await ask(client, "missing", objects=["bed"]))["warnings"] == []
        assert (await ask(client, "generate", objects=["bed"]))["scenes"]


async def test_the_default_coverage_is_that_of_the_model(client: AsyncClient) -> None:
    assert (await ask(client, "missing", **SCENE))["coverage"] == 0.5
    assert (await ask(client, "missing", **SCENE, coverage=0.125))["coverage"] == 0.125


async def test_a_profile_changes_base_rates_only(client: AsyncClient) -> None:
    for question, changes in (("missing", True), ("outliers", True), ("relations", False)):
        answers = [
            (await ask(client, question, **SCENE, profile=profile))[question]
            for profile in (None, *PROFILES)
        ]
        assert (answers[0] != answers[1] != answers[2]) == changes


async def test_relations_of_chosen_pairs(client: AsyncClient) -> None:
    pairs = [{"subject": "chair_2", "object": "lamp"}, {"subject": "bed", "object": "chair_1"}]
    found = (await ask(client, "relations", **SCENE, pairs=pairs, top_k=4096))["relations"]
    ends = {(entry["subject"], entry["object"]) for entry in found}
    assert ends == {("chair_2", "l"), ("bed", "chair_1")}


async def test_misplaced_relations_are_spelled_as_stated(client: AsyncClient) -> None:
    stated = [("lamp", "under", "bed"), ("lamp", "left", "bed"), ("desk", "behind", "lamp")]
    answer = await ask(client, "outliers", objects=["bed", "lamp", "desk"], relations=stated)
    assert triples(answer["misplaced"]) == {*stated}
    assert len(answer["misplaced"]) == 3
    assert all(type(one["is_misplaced"]) is bool for one in answer["misplaced"])


LABELS = ("bed", "nightstand", "chair", "chair")
CHAIR, NIGHTSTAND = VOCABULARY.index("chair"), VOCABULARY.index("nightstand")


@pytest.fixture(scope="module")
async def measured(
    tmp_path_factory: pytest.TempPathFactory, anyio_backend: str
) -> AsyncIterator[AsyncClient]:
    """A service with a model whose scenes usually have one nightstand and four chairs."""
    root, share = tmp_path_factory.mktemp("store"), [[0.8, 0.1, 0.05, 0.05], [0.1, 0.1, 0.1, 0.7]]
    log_share, weights = np.log(share).astype("f4"), np.zeros((2, 2, 3 + C + V), np.float32)
    counts = Counts(np.array([NIGHTSTAND, CHAIR]), np.array([3, 3]), log_share, weights)
    groups = counts, offsets_of_every_pair(V)
    publish(root, "measured", "1.0.0", alias="default", groups=groups)
    async with serve(root) as client:
        yield client


async def test_likely_further_instances_are_listed(measured: AsyncClient) -> None:
    (entry,) = (await ask(measured, "missing", objects=LABELS))["more"]
    assert [entry[name] for name in ("label", "listed_count", "low", "high")] == ["chair", 2, 2, 4]
    assert entry["probability"] == pytest.approx(0.8 / 0.9, abs=1e-3)
    # The first object of a class is its word.
    for labels, word in ((("Chairs", "chair"), "Chairs"), (("chair", "Chairs"), None)):
        objects = [*LABELS[:2], *labels]
        (again,) = (await ask(measured, "missing", objects=objects))["more"]
        assert again.pop("listed_as", None) == word
        assert again == entry
    # A question about a place lists none.
    place = {"relation": "on-top", "object": "bed"}
    assert (await ask(measured, "missing", objects=LABELS, at=place))["more"] == []


# Nothing is derived or stated, so that every request asks the same question of the model.
POSED = ("bed", "chair", "desk")
PLACE = {"x": 1.0, "y": 0.0, "z": 0.5}
REQUEST: dict[str, Any] = {
    "objects": [{"id": str(k), "label": POSED[k], "position": PLACE} for k in range(3)],
    "relations": [],
    "top_k": 11,
}


@pytest.mark.parametrize(
    ("frame", "viewpoint", "up"),
    [
        (None, None, None),
        ("base_link", None, None),
        ("map", {"x": 4.0, "y": -3.0, "yaw": math.pi / 2}, None),
        ("camera_optical_frame", None, None),
        ("robot_1/map", None, None),
        ("base_link", None, "y"),
        ("map", None, "y"),
        ("map", {"x": 4.0, "y": -3.0, "yaw": math.pi / 2}, "y"),
    ],
)
async def test_offsets_are_in_the_axes_of_the_frame(measured, frame, viewpoint, up):
    """In a map without a viewpoint, the relations left and front have no offset."""
    options = {"frame_id": frame, "viewpoint": viewpoint, "up": up}
    options = {name: value for name, value in options.items() if value is not None}
    axes = viewer_axes(frame or "", None if viewpoint is None else viewpoint["yaw"], up)
    answer = await ask(measured, "missing", **REQUEST, **options)
    position = tuple(PLACE.values())
    things = (
        SceneObject(str(k), label, VOCABULARY.index(label), position=position)
        for k, label in enumerate(POSED)
    )
    model = measured.app.state.runtime.models.served["measured", "1.0.0"].model
    scene = Scene(tuple(things), RelationTable.stated(()))
    has_viewer = viewpoint is not None or not is_world_fixed(frame)
    expected = questions.missing(model, scene, top_k=11, axes=axes, has_viewer=has_viewer)
    assert answer["missing"] == expected["missing"]
    places = [place for entry in answer["missing"] for place in entry["placements"]]
    kinds = {"offset" in place for place in places}
    assert kinds == ({True} if has_viewer else {True, False})


CONVENTIONS = {"up": "y", "units": "cm", "extents": "half", "box_origin": "bottom"}


@pytest.mark.parametrize("question", ["relations", "outliers", "missing", "rooms"])
async def test_a_scene_in_other_conventions_has_the_same_answer(measured, question):
    """A desk and a lamp on it, seen from a viewpoint in a map: z up in metres, and y up in cm."""
    boxes = (("desk", (2.0, 0.5, 0.4), (0.7, 1.4, 0.8)), ("lamp", (2.0, 0.8, 1.0), (0.2, 0.3, 0.4)))
    plain, other = [], []
    for label, (x, y, z), (a, b, c) in boxes:
        errors = {"yaw": 0.3, "position_std": 0.06, "size_std": 0.08}
        plain.append({"label": label, "position": [x, y, z], "size": [a, b, c], **errors})
        place, half = (-100 * y, 100 * (z - c / 2), -100 * x), (50 * b, 50 * c, 50 * a)
        errors = {"yaw": 0.3, "position_std": 6.0, "size_std": 4.0}
        other.append({"label": label, "position": place, "size": half, **errors})
    view = {"x": 0.5, "y": -0.25, "yaw": 0.1}
    usual = await ask(measured, question, objects=plain, frame_id="map", viewpoint=view)
    view = {"x": 50.0, "y": -25.0, "yaw": 0.1}
    answer = await ask(
        measured, question, objects=other, frame_id="map", viewpoint=view, **CONVENTIONS
    )
    # Only offsets are in the axes of the frame.
    for one in (usual, answer):
        one.pop("request_id")
        for entry in one.get("missing", ()):
            for place in entry["placements"]:
                place.pop("offset", None)
    assert answer == usual


async def test_larger_errors_make_relations_of_boxes_less_certain(measured):
    """A lamp on a desk. Without the fields, a position has 5 cm, and a height 10 % of it."""

    async def on_top(**errors: float) -> float:
        objects = [
            {"label": "desk", "position": [2, 0, 0.4], "size": [0.7, 1.4, 0.8], **errors},
            {"label": "lamp", "position": [2, 0, 0.9], "size": [0.2, 0.2, 0.2], **errors},
        ]
        if not errors:
            objects = [{**objects[0], "size_std": 0.08}, {**objects[1], "size_std": 0.02}]
        found = (await ask(measured, "relations", objects=objects, top_k=50))["relations"]
        wanted = ("lamp", "on-top", "desk")
        (entry,) = [x for x in found if (x["subject"], x["relation"], x["object"]) == wanted]
        return float(entry["probability"])

    errors = (0.0, 0.05, 0.1, 0.2)
    p = [await on_top(position_std=error, size_std=0.0) for error in errors]
    assert p == sorted(p, reverse=True)
    assert p[0] > 0.95
    assert p[-1] < 0.7
    assert await on_top() < await on_top(position_std=0.05, size_std=0.0)


@pytest.mark.parametrize("field", ["position_std", "size_std"])
@pytest.mark.parametrize("value", [-0.1, "x", 1e8])
async def test_errors_of_boxes_are_checked(measured, field, value):
    desk = {"label": "desk", "position": [2, 0, 0.4], "size": [0.7, 1.4, 0.8], field: value}
    response = await measured.post("/relations", json={"objects": [desk, "lamp"]})
    (error,) = problem(response, 422, "invalid-request")["errors"]
    assert error["pointer"] == f"#/objects/0/{field}"


async def test_up_in_an_optical_frame_is_refused(measured):
    body = {"objects": REQUEST["objects"], "frame_id": "camera_optical_frame", "up": "z"}
    response = await measured.post("/outliers", json=body)
    (error,) = problem(response, 422, "contradictory-evidence")["errors"]
    assert error["pointer"] == "#/up"


ENTRIES: list[Any] = [
    {"objects": ["bed", "lamp"]},
    {"objects": ["bed", "droid"]},
    "no scene at all",
    {"objects": ["bed", {"label": "lamp", "confidence": 3}]},
    {"objects": ["bed", "lamp"], "model": "nobody"},
    {"objects": []},
    {"objects": ["bed", "chair"], "model": "plain"},
]
NAMES = [question.name for question in SCENES if not question.samples]


@pytest.mark.parametrize("question", NAMES)
async def test_batch_entries_are_single_answers(client: AsyncClient, question: str) -> None:
    headers = {"X-Request-Id": "one"}
    response = await client.post(f"/{question}/batch", json={"scenes": ENTRIES}, headers=headers)
    assert response.status_code == 200
    answer = response.json()
    assert answer["request_id"] == "one"
    assert [entry["status"] for entry in answer["results"]] == [200, 422, 422, 422, 404, 422, 200]
    for number, (entry, scene) in enumerate(zip(answer["results"], ENTRIES, strict=True)):
        alone = await client.post(f"/{question}", json=scene, headers=headers)
        expected = alone.json()
        for error in expected.get("errors", []):
            error["pointer"] = error["pointer"].replace("#", f"#/scenes/{number}")
        part = "result" if alone.is_success else "problem"
        assert entry == {"status": alone.status_code, part: expected}


@pytest.mark.parametrize("fault", ["raised", math.nan])
async def test_a_defect_affects_one_entry(client, replace, caplog, fault):
    def fail_on_sofas(outliers: Any, artifact: Any, scene: Any, **parameters: Any) -> Any:
        answer = outliers(artifact, scene, **parameters)
        if any(thing.label == "sofa" for thing in scene.objects):
            if fault == "raised":
                defect()
            answer["outliers"][0]["log_odds"] = fault
        return answer

    replace("outliers", fail_on_sofas)
    scenes = [{"objects": ["bed"]}, {"objects": ["sofa"]}, {"objects": ["lamp"]}]
    response = await client.post("/outliers/batch", json={"scenes": scenes})
    assert [entry["status"] for entry in response.json()["results"]] == [200, 500, 200]
    assert response.json()["results"][1]["problem"]["type"] == "/problems/internal-error"
    assert "secret" not in response.text
    problem(await client.post("/outliers", json=scenes[1]), 500, "internal-error")
    assert ("not finite" in caplog.text) == (fault != "raised")


async def test_an_id_may_be_the_text_nan(client: AsyncClient) -> None:
    objects = [{"id": "NaN", "label": "bed"}, {"id": "-Infinity", "label": "lamp"}]
    answer = (await client.post("/outliers", json={"objects": objects})).json()
    assert {entry["object"] for entry in answer["outliers"]} == {"NaN", "-Infinity"}
