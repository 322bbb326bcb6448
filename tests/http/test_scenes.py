"""``POST /scenes``: files of detectors, annotation tools and simulators as scenes."""

import base64
import json
from pathlib import Path
from typing import Any

import pytest
from httpx import AsyncClient

from app.api.scenes import MOST_PARTS
from scene_client import from_file
from scene_client.schemas import ScenesAnswer
from tests.client.scene_files import EXAMPLES, REFUSED
from tests.http.test_problems import problem
from tests.services import serve


async def read(client: AsyncClient, text: str, name: str = "a.json", **fields: Any) -> Any:
    response = await client.post("/scenes", json={"text": text, "name": name, **fields})
    assert response.status_code == 200, response.text
    ScenesAnswer.model_validate(response.json(), extra="forbid")
    return response.json()


async def refusal(client: AsyncClient, text: str, **fields: Any) -> str:
    """The reason why a file is refused: a short line."""
    response = await client.post("/scenes", json={"text": text, "name": "a.json", **fields})
    detail: str = problem(response, 422, "unreadable-file")["detail"]
    assert len(detail) <= 300
    assert detail.isprintable()
    return detail


@pytest.mark.parametrize("name", EXAMPLES)
async def test_files_become_scenes(client: AsyncClient, tmp_path: Path, name: str) -> None:
    example = EXAMPLES[name]
    names = example.labels
    labels = {"label_map": json.dumps(names) if isinstance(names, dict) else names} if names else {}
    answer = await read(client, example.text, name, **labels)
    number, found = next(
        (number, one["scene"])
        for number, one in enumerate(answer["scenes"])
        if one["name"] == example.scene or len(answer["scenes"]) == 1
    )
    (tmp_path / name).write_text(example.text, "utf-8")
    fields = from_file(tmp_path / name, example.labels, scene=example.scene)
    assert found == json.loads(json.dumps(fields))
    notes = [one for one in answer["notes"] if one["scene"] == number]
    listed = [(one["detection"], one["reason"], one["detail"]) for one in notes]
    assert listed == [tuple(note) for note in fields.notes[:16]]


@pytest.mark.parametrize("name", REFUSED)
async def test_files_are_refused_as_by_the_client(client: AsyncClient, name: str) -> None:
    text, words = REFUSED[name]
    if "choose one" in words:
        names = [one["name"] for one in (await read(client, text, name))["scenes"]]
        assert f"{len(names)} scenes ({', '.join(names)})" in words
    else:
        detail = await refusal(client, text, name=name)
        assert words in detail
        assert name not in detail


async def test_a_scene_that_cannot_be_read_leaves_the_others(client: AsyncClient) -> None:
    seen = [{"category_id": label, "image_id": label, "bbox": [1, 2, 3, 4]} for label in (5, "bed")]
    answer = await read(client, json.dumps(seen))
    (one,) = answer["scenes"]
    assert (one["name"], one["scene"]["objects"][0]["label"]) == ("bed", "bed")
    (note,) = answer["notes"]
    assert (note["scene"], note["detection"], note["reason"]) == (None, None, "refused")
    assert note["detail"].startswith("5: the class ids are numbers")


async def test_bytes_are_read_too(client: AsyncClient) -> None:
    def body(content: bytes) -> dict[str, str]:
        return {"base64": base64.b64encode(content).decode(), "name": "a.txt"}

    response = await client.post("/scenes", json=body("\ufeffbed, chair\n".encode()))
    assert response.json()["scenes"][0]["scene"] == {"objects": ["bed", "chair"]}
    for content, words in ((b"PK\x03\x04\0", "compressed"), (b"bed\xff", "no text in UTF-8")):
        response = await client.post("/scenes", json=body(content))
        assert words in problem(response, 422, "unreadable-file")["detail"]
    response = await client.post("/scenes", json={"base64": "Ym=Vk", "name": "a.txt"})
    assert problem(response, 422, "invalid-request")["errors"][0]["pointer"] == "#/base64"


@pytest.mark.parametrize("content", [{}, {"text": "bed", "base64": "YmVk"}, {"text": 3}])
async def test_a_file_is_text_or_bytes(client: AsyncClient, content: dict[str, Any]) -> None:
    problem(await client.post("/scenes", json={"name": "a.txt", **content}), 422, "invalid-request")


@pytest.mark.parametrize(
    "names", ["stool\nbed", "names:\n  0: stool\n  1: 'bed'\n", '{"0": "stool", "1": "bed"}']
)
async def test_a_label_map_may_be_a_file(client: AsyncClient, names: str) -> None:
    answer = await read(client, "1 0.5 0.5 0.2 0.2\n", label_map=names)
    assert answer["scenes"][0]["scene"]["objects"][0]["label"] == "bed"
    assert "label map" in await refusal(client, "1 1 1 1 1\n", label_map="[3]")


LARGE = {
    # A body may have one of them for every five bytes.
    "lists": "[     " * (MOST_PARTS + 1),
    "objects": "{     " * (MOST_PARTS + 1),
    "elements": "<a>" * (MOST_PARTS + 1),
    "attributes": "<annotations " + "a='' " * (MOST_PARTS + 1),
    "rows": "label,x\n" + "a,1\n" * MOST_PARTS,
    "labels": "a," * (8 * MOST_PARTS + 1),
}

ODD = {
    # Each of these once took minutes, or another error than a refusal.
    "digits": ("label,x,y,z\na,0,0," + "1" * 100_000 + "x\n", "is not a number"),
    "boxes": (
        json.dumps(
            {"objects": [{"id": n, "label": str(n), "box2d": [0, 0, 1, 1]} for n in range(30_000)]}
        ),
        "more than 256 boxes",
    ),
    "depth": ('{"objects":[{"label":' + "[" * 900 + "]" * 900 + "}]}", "not valid JSON"),
    "surrogate": ('{"objects": ["\\ud800"]}', "not valid JSON"),
    "surrogate in a name": ('{"\\ud800\\n": 1}', "with the fields \ufffd"),
    "long integer": ('{"objects": [' + "1" * 5000 + "]}", "not JSON"),
}


@pytest.mark.parametrize("name", [*LARGE, *ODD])
async def test_a_hostile_file_is_refused(client: AsyncClient, name: str) -> None:
    text, words = (LARGE[name], "more than 32768 entries") if name in LARGE else ODD[name]
    assert words in await refusal(client, text)


async def test_a_hostile_label_map_is_read_in_linear_time(client: AsyncClient) -> None:
    names = "names:\n- stool" + " " * 60_000 + "b\n- bed\n"
    answer = await read(client, "1 1 1 1 1\n", label_map=names)
    assert answer["scenes"][0]["scene"]["objects"][0]["label"] == "bed"


async def test_the_answer_has_the_first_scenes(shared_store: Path) -> None:
    lines = '{"objects": ["bed"]}\n' * 300
    async with serve(shared_store, max_answer_bytes=2**16) as client:
        answer = await read(client, lines)
        assert [one["name"] for one in answer["scenes"]] == [str(n) for n in range(1, 257)]
        (note,) = answer["notes"]
        assert note["detail"] == "the answer leaves out 44 of 300 scenes"
        # The answer has 64 KiB at most.
        long = json.dumps({"objects": ["x" * 20_000]}) + "\n"
        answer = await read(client, long * 5)
        assert len(answer["scenes"]) == 3
        assert "no room" in answer["notes"][0]["detail"]
        assert "no room" in await refusal(client, json.dumps({"objects": ["x" * 70_000]}))


async def test_a_file_may_be_as_large_as_a_batch(shared_store: Path) -> None:
    text = "bed" + " " * 400_000
    async with serve(shared_store, max_body_bytes=500_000, max_scene_bytes=2000) as client:
        assert (await read(client, text))["scenes"][0]["scene"] == {"objects": ["bed"]}
        response = await client.post("/scenes", json={"text": text + " " * 10**5, "name": "a"})
        problem(response, 413, "body-too-large")
