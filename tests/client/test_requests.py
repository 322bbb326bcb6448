"""Requests of the clients: bodies, headers, and errors before a request is sent."""

import json
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from scene_client import AsyncClient, Client, InvalidRequestError, ProblemError
from scene_client.command import app
from scene_client.schemas import Anchor, Detection, MissingRequest, Position, Relation, SceneRequest

EVERYTHING: dict[str, Any] = {
    "model": {"name": "a", "version": "1.0.0", "variant": "rbm", "digest": "0"},
    "request_id": "r",
    "seed": 1,
    **{key: [] for key in ("relations", "disagreements", "missing", "outliers", "misplaced")},
    **{key: [] for key in ("scenes", "results")},
}
"""An answer to every question."""


class Recorder:
    """A service that gives one answer, and records the requests."""

    def __init__(self, answer: Any = EVERYTHING, status: int = 200) -> None:
        self.answer, self.status = answer, status
        self.requests: list[httpx.Request] = []

    def __call__(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        return httpx.Response(self.status, json=self.answer)

    @property
    def body(self) -> Any:
        return json.loads(self.requests[-1].content)


@pytest.fixture
def recorder() -> Recorder:
    return Recorder()


@pytest.fixture
def scene(recorder: Recorder) -> Client:
    return Client("http://robot/api/", transport=httpx.MockTransport(recorder))


def test_short_and_long_forms_are_sent_alike(scene: Client, recorder: Recorder) -> None:
    lamp = Detection(label="lamp", id="l", position=Position(x=1.0, y=0.0, z=0.5))
    plain = {"label": "lamp", "id": "l", "position": {"x": 1.0, "y": 0.0, "z": 0.5}}
    stated: Any = {"subject": "l", "relation": "on-top", "object": "desk"}
    place: Any = {"relation": "left", "object": "desk"}
    forms: Any = (
        (lamp, Relation(**stated), Anchor(**place)),
        (plain, stated, place),
        (plain, ("l", "on-top", "desk"), ("left", "desk")),
    )
    for detection, relation, at in forms:
        scene.missing(("desk", detection), relations=[relation], at=at)
        assert recorder.body == {"objects": ["desk", plain], "relations": [stated], "at": place}


LAMPS = {"objects": ["bed"], "candidates": ["lamp"]}


@pytest.mark.parametrize(
    ("ask", "path", "body"),
    [
        (lambda scene: scene.missing(MissingRequest(**LAMPS)), "missing", LAMPS),
        (lambda scene: scene.missing(LAMPS), "missing", LAMPS),
        (
            lambda scene: scene.missing(["bed"], at=("left", "bed"), top_k=5),
            "missing",
            {"objects": ["bed"], "at": {"relation": "left", "object": "bed"}, "top_k": 5},
        ),
        (lambda scene: scene.generate(), "generate", {"objects": []}),
        (
            lambda scene: scene.relations(["bed", "lamp"], pairs=[("bed", "lamp")]),
            "relations",
            {"objects": ["bed", "lamp"], "pairs": [{"subject": "bed", "object": "lamp"}]},
        ),
        (
            lambda scene: scene.missing_batch([["bed"], LAMPS, MissingRequest(objects=["desk"])]),
            "missing/batch",
            {"scenes": [{"objects": ["bed"]}, LAMPS, {"objects": ["desk"]}]},
        ),
    ],
)
def test_scenes_of_every_form(scene, recorder, ask, path, body):
    """A request has only the fields that are set."""
    ask(scene)
    assert recorder.body == body
    assert recorder.requests[-1].url.path == f"/api/{path}"
    assert recorder.requests[-1].headers["content-type"] == "application/json"


def test_the_model_of_the_client_is_the_default(recorder: Recorder) -> None:
    scene = Client("http://robot", model="plain", transport=httpx.MockTransport(recorder))
    scene.relations(["bed"])
    assert recorder.body["model"] == "plain"
    scene.relations(["bed"], model="home")
    assert recorder.body["model"] == "home"
    scene.relations_batch([["bed"], {"objects": ["bed"], "model": "home"}])
    assert [entry["model"] for entry in recorder.body["scenes"]] == ["plain", "home"]


@pytest.mark.parametrize(
    ("ask", "pointer", "word"),
    [
        (lambda scene: scene.missing([]), "#/objects", "empty"),
        (lambda scene: scene.missing(["bed"], topk=5), "#/topk", "top_k"),
        (lambda scene: scene.missing(["\ud800"]), "#/objects/0", "string"),
        (lambda scene: scene.generate(temperature=float("nan")), "#/temperature", "number"),
        (lambda scene: scene.missing(SceneRequest(objects=["bed"]), top_k=1), "#", "top_k"),
        (lambda scene: scene.missing_batch([["bed"], []]), "#/scenes/1/objects", "empty"),
        (lambda scene: scene.missing_batch([]), "#/scenes", "256"),
        (lambda scene: scene.missing(["bed"], timeout=0.0), "#", "timeout"),
        (lambda scene: scene.vocabulary(".."), "#", "name"),
        (lambda scene: scene.model("home", ""), "#", "name"),
    ],
)
def test_invalid_requests_are_not_sent(scene, recorder, ask, pointer, word):
    with pytest.raises(InvalidRequestError, match=word) as raised:
        ask(scene)
    assert pointer in [error.pointer for error in raised.value.errors]
    assert recorder.requests == []


@pytest.mark.parametrize("url", ["", "robot:8000", "ftp://robot", "http://", "http://robot?a=b"])
def test_invalid_urls_are_refused(url: str) -> None:
    for kind in (Client, AsyncClient):
        with pytest.raises(InvalidRequestError, match="URL"):
            kind(url)


def test_the_key_is_not_shown() -> None:
    assert "aaaa" not in repr(Client("http://robot", api_key="a" * 16).options)


def test_names_are_quoted_in_addresses() -> None:
    recorder = Recorder(status=404)
    scene = Client("http://robot", transport=httpx.MockTransport(recorder))
    quoted = {"a/b": b"a%2Fb", "ä b": b"%C3%A4%20b", "x@1.0": b"x%401.0", "../x": b"..%2Fx"}
    for name, text in quoted.items():
        with pytest.raises(ProblemError):
            scene.vocabulary(name)
        assert recorder.requests[-1].url.raw_path == b"/models/%b/vocabulary" % text


KEYS = ["secret-key\n", "secret-\rkey", "sécret-key", "secret key", "secret\x7f", "secret\udcff"]
MESSAGE = "a key must have only ASCII characters, without spaces or line breaks"


@pytest.mark.parametrize("key", KEYS)
def test_invalid_keys_are_refused(monkeypatch: pytest.MonkeyPatch, key: str) -> None:
    for kind in (Client, AsyncClient):
        with pytest.raises(InvalidRequestError) as raised:
            kind("http://robot", api_key=key)
        assert str(raised.value) == MESSAGE
    monkeypatch.setenv("SCENE_API_KEY", key)
    result = CliRunner().invoke(app, ["missing", "bed"])
    assert (result.exit_code, result.stdout, result.stderr) == (2, "", MESSAGE + "\n")
