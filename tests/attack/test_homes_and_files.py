"""Homes, files and confirmed scenes: limits before work, and costly work off the event loop."""

import base64
import threading
from collections.abc import Callable, Iterator
from itertools import count
from pathlib import Path
from types import UnionType
from typing import Any, get_args, get_origin

import pytest
from pydantic import ValidationError

from app.api import confirm, questions, scenes
from app.api.questions import QUICK_OBJECTS, QUICK_ROOMS, is_quick, is_small
from app.api.scenes import MOST_PARTS
from app.questions import QUESTIONS
from scene_client.formats import from_data
from scene_client.schemas import ConfirmRequest, Request, SceneRequest, WhereRequest
from scene_client.schemas.where import HomeRoom
from scene_client.validation import MAX_ERRORS
from tests.attack.test_labels import fresh
from tests.http.test_confirm import KEY, SCENE
from tests.http.test_problems import problem
from tests.services import serve

FORMS = {*(question.request for question in QUESTIONS), ConfirmRequest, HomeRoom, SceneRequest}


def lists() -> Iterator[tuple[type[Request], str]]:
    """Yield the fields with lists of the schemas of requests."""
    for form in sorted(FORMS, key=lambda form: form.__name__):
        for name, field in form.model_fields.items():
            kinds = get_args(field.annotation) if isinstance(field.annotation, UnionType) else ()
            if list in map(get_origin, (field.annotation, *kinds)):
                yield form, name


@pytest.mark.parametrize(("form", "field"), [*lists()])
def test_validation_stops_at_the_first_invalid_entry(form: type[Request], field: str) -> None:
    def errors(entries: int) -> int:
        entry = {f"unknown_{k}": 1 for k in range(MAX_ERRORS - 1)}
        try:
            form.model_validate({field: [entry] * entries})
        except ValidationError as error:
            return error.error_count()
        return 0

    assert 0 < errors(32) == errors(1)


@pytest.fixture
def threads(monkeypatch: pytest.MonkeyPatch) -> Callable[[Any, str], list[str]]:
    """Return a list of the threads that run a function of a module."""

    def of(module: Any, name: str) -> list[str]:
        names, function = list[str](), getattr(module, name)

        def noted(*values: Any, **named: Any) -> Any:
            names.append(threading.current_thread().name.partition("_")[0])
            return function(*values, **named)

        monkeypatch.setattr(module, name, noted)
        return names

    return of


def home(rooms: int, objects: int, kind: str = "kitchen", **fields: Any) -> dict[str, Any]:
    listed = [{"id": f"{kind}_{k}", "objects": ["bed"] * objects} for k in range(rooms)]
    return {"label": "lamp", "rooms": listed, **fields}


@pytest.mark.parametrize("body", [home(QUICK_ROOMS + 1, 1), home(1, QUICK_OBJECTS + 1)])
async def test_large_homes_are_validated_by_the_worker(client, threads, body):
    assert not is_small(body)
    assert is_small(home(QUICK_ROOMS, 8))
    of_batch = threads(questions, "validated")
    response = await client.post("/where/batch", json={"scenes": [body, home(1, 1)]})
    assert [entry["status"] for entry in response.json()["results"]] == [200, 200]
    assert of_batch == ["slow", "MainThread"]


async def test_objects_of_a_home_are_counted_before_validation(client):
    message = "the rooms must have at most 1024 objects together"
    # The unknown fields of objects would have errors of their own.
    rooms = [{"id": str(k), "objects": [{"a": 1}] * 33} for k in range(32)]
    crowded = {"label": "bed", "rooms": rooms}
    document = problem(await client.post("/where", json=crowded), 422, "invalid-request")
    found = [(one["pointer"], one["message"]) for one in document["errors"]]
    assert found == [("#/rooms", message)]
    (entry,) = (await client.post("/where/batch", json={"scenes": [crowded]})).json()["results"]
    found = [(one["pointer"], one["message"]) for one in entry["problem"]["errors"]]
    assert found == [("#/scenes/0/rooms", message)]
    whole = [HomeRoom(id=str(k), objects=["bed"] * 33) for k in range(32)]
    with pytest.raises(ValidationError, match=message):
        WhereRequest(label="bed", rooms=whole)


async def test_large_homes_are_answered_by_the_worker(client, threads):
    answered = threads(questions, "_read")
    for rooms, objects in ((QUICK_ROOMS, 8), (QUICK_ROOMS, 8), (QUICK_ROOMS + 1, 1)):
        body = home(rooms, objects, "bathroom")
        assert (await client.post("/where", json=body)).status_code == 200
    # The ids of the first request are new.
    assert answered == ["slow", "MainThread", "slow"]


@pytest.mark.parametrize("field", ["id", "room_type"])
def test_new_names_of_rooms_leave_the_event_loop(field: str) -> None:
    vocabulary, numbers = fresh(), count()

    def of(length: int) -> WhereRequest:
        names = [f"{next(numbers):05}".rjust(length, "x") for _ in range(3)]
        rooms = [{"id": name, field: name} for name in names]
        return WhereRequest.model_validate({"label": "bed", "rooms": rooms})

    request = of(20)
    assert not is_quick(request, vocabulary)
    for room in request.rooms:
        for search in ("read", "nearest"):
            getattr(vocabulary, search)(getattr(room, field), is_room=True)
    assert is_quick(request, vocabulary)


async def test_the_answer_about_a_home_has_a_limit(shared_store: Path) -> None:
    body = home(32, 32, top_k=4096)
    async with serve(shared_store, max_answer_bytes=2**16) as client:
        body["rooms"] = [
            {"id": f"r{k}", "objects": [{"label": "bed", "id": f"{k}-{n:099}"} for n in range(32)]}
            for k in range(32)
        ]
        answer = await client.post("/where", json=body)
        (error,) = problem(answer, 422, "answer-too-large")["errors"]
        assert error["pointer"] == "#/top_k"


LINE_ENDS = "\n\r\v\f\x1c\x1d\x1e\x85\u2028\u2029"


@pytest.mark.parametrize("end", LINE_ENDS)
@pytest.mark.parametrize("coding", ["utf-8", "utf-16"])
async def test_lines_are_counted_before_they_are_read(client, threads, end, coding):
    assert all(len(f"a{one}b".splitlines()) == 2 for one in LINE_ENDS)
    read = threads(scenes, "scenes_of")
    for lines in (MOST_PARTS, MOST_PARTS + 1):
        content = base64.b64encode((("a" + end) * lines).encode(coding)).decode()
        response = await client.post("/scenes", json={"base64": content})
        if lines > MOST_PARTS:
            detail = problem(response, 422, "unreadable-file")["detail"]
            assert detail.startswith(f"The file has more than {MOST_PARTS} entries")
    assert read == ["slow"]


@pytest.mark.parametrize("separator", [",", ";", " | ", " . "])
async def test_labels_are_counted_before_they_are_read(client, threads, separator):
    read = threads(scenes, "scenes_of")
    text = ("a" + separator) * (8 * MOST_PARTS + 1)
    detail = problem(await client.post("/scenes", json={"text": text}), 422, "unreadable-file")
    assert "entries" in detail["detail"]
    assert read == []


async def test_a_confirmed_scene_is_written_by_the_worker(shared_store, tmp_path, threads):
    settings = {"api_key": KEY, "recording": tmp_path / "scenes.jsonl", "max_scene_bytes": 2000}
    async with serve(shared_store, **settings) as client:
        client.headers["X-API-Key"] = KEY
        read = threads(confirm, "read_for")
        assert (await client.post("/confirm", json=SCENE)).status_code == 200
        large = SCENE | {"frame_id": " " * 2000}
        problem(await client.post("/confirm", json=large), 413, "body-too-large")
        many = {"objects": ["bed"] * 257}
        problem(await client.post("/confirm", json=many), 422, "invalid-request")
        named = {"objects": ["bed", {"label": "lamp", "id": "\x1b[2J"}]}
        problem(await client.post("/confirm", json=named), 422, "invalid-request")
    assert read == ["slow"]
    assert len((tmp_path / "scenes.jsonl").read_bytes().splitlines()) == 1


def marked(text: str) -> Any:
    cube = {"pose": {"position": {"x": 0, "y": 0, "z": 0}}, "size": {"x": 1, "y": 1, "z": 1}}
    return {"entities": [{"id": "bed", "cubes": [cube], "texts": [{"text": text}]}]}


@pytest.mark.parametrize(("length", "label"), [(0, "chair"), (240, "chair"), (260, "bed")])
def test_a_pattern_reads_short_texts_only(length: int, label: str) -> None:
    fields = from_data(marked("chair" + " " * length + " (.9)"))
    assert [one["label"] for one in fields["objects"]] == [label]


@pytest.mark.parametrize("text", ["|", "|-|\n|", "| : - |"])
async def test_a_table_without_cells_is_no_defect(client, text):
    answer = await client.post("/scenes", json={"text": text})
    assert answer.status_code in (200, 422)
