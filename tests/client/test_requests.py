"""Requests of the clients, with attempts, pauses and deadlines on a simulated clock."""

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from email.utils import format_datetime
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from hypothesis import given
from hypothesis import strategies as st
from typer.testing import CliRunner

from scene_client import (
    AnswerError,
    AsyncClient,
    Client,
    DeadlineError,
    InvalidRequestError,
    ProblemError,
    UnreachableError,
    calls,
    sync,
)
from scene_client.calls import LONGEST_PAUSE
from scene_client.command import app
from scene_client.connection import RETRIES
from scene_client.errors import problem_of
from scene_client.schemas import (
    Anchor,
    Detection,
    HomeRoom,
    MissingRequest,
    Position,
    Relation,
    SceneRequest,
    Searched,
    WhereRequest,
)

Received = tuple[int, dict[str, str], bytes]
Outcome = Received | Exception
FINE: Received = (200, {}, b'{"models": [], "aliases": {}}')
REFUSED = httpx.ConnectError("refused")
BROKEN = httpx.ReadError("broke")


def refusal(status: int, retry_after: str | None = None) -> Received:
    problem = {
        "type": "/problems/not-ready",
        "title": "The service is not ready",
        "status": status,
        "detail": "It is starting.",
        "instance": "/problems/not-ready#r1",
        "request_id": "r1",
        "errors": [{"pointer": "#/objects/0", "message": "unknown", "suggestions": ["bed"]}],
    }
    headers = {"location": "http://elsewhere/models"}
    headers |= {} if retry_after is None else {"retry-after": retry_after}
    return status, headers, json.dumps(problem).encode()


class World:
    """A service and a clock. Every attempt takes ``seconds``; the last outcome repeats."""

    def __init__(self, *outcomes: Outcome, seconds: float = 0.0) -> None:
        self.outcomes = list(outcomes)
        self.seconds = seconds
        self.clock = 100.0
        self.requests: list[httpx.Request] = []
        self.pauses: list[float] = []
        self.transport = httpx.MockTransport(self._answer)

    @property
    def timeouts_ms(self) -> list[int]:
        """Of each attempt, as sent to the service."""
        return [int(request.headers["X-Request-Timeout-Ms"]) for request in self.requests]

    @property
    def left(self) -> list[float]:
        """Seconds that the client waits for each attempt."""
        return [request.extensions["timeout"]["read"] for request in self.requests]

    @property
    def body(self) -> Any:
        """The last request."""
        return json.loads(self.requests[-1].content)

    def _answer(self, request: httpx.Request) -> httpx.Response:
        self.requests.append(request)
        left = self.left[-1]
        outcome = self.outcomes.pop(0) if len(self.outcomes) > 1 else self.outcomes[0]
        self.clock += min(self.seconds, left)
        if self.seconds > left:
            raise httpx.ReadTimeout("late")
        if isinstance(outcome, Exception):
            raise outcome
        status, headers, body = outcome
        return httpx.Response(status, headers=headers, content=body)

    def _sleep(self, seconds: float) -> None:
        self.pauses.append(seconds)
        self.clock += seconds

    def run(
        self,
        ask: Callable[[Client], Any] = Client.models,
        timeout: float = 10.0,
        jitter: float = 0.5,
        retries: int = RETRIES,
    ) -> Any:
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sync, "monotonic", lambda: self.clock)
            patch.setattr(sync, "time", SimpleNamespace(sleep=self._sleep))
            patch.setattr(calls, "random", lambda: jitter)
            options: Any = {"timeout": timeout, "retries": retries, "transport": self.transport}
            with Client("http://robot", **options) as client:
                return ask(client)


def test_unknown_fields_of_an_answer_are_ignored() -> None:
    assert World((200, {}, b'{"models": [], "aliases": {}, "mood": "fine"}')).run().models == []
    # So are unknown fields of parts that requests have too.
    relation = {"subject": "a", "relation": "left", "object": "b", "probability": 0.5}
    scene = {"objects": ["bed"], "relations": [relation], "log_score": -1.0}
    model = {"name": "a", "version": "1.0.0", "variant": "rbm", "digest": "0"}
    answer = {"model": model, "request_id": "r", "seed": 1, "scenes": [scene | {"mood": "fine"}]}
    read = World((200, {}, json.dumps(answer).encode())).run(Client.generate)
    assert read.scenes[0].relations[0].subject == "a"


@pytest.mark.parametrize("body", [b"", b"<html>", b"{}", b"[]", b'{"models": 1}'])
def test_an_unreadable_answer_is_an_error(body: bytes) -> None:
    world = World((200, {}, body))
    with pytest.raises(AnswerError, match="/models does not match the schema ModelList"):
        world.run()
    assert len(world.timeouts_ms) == 1


@pytest.mark.parametrize("status", [429, 503])
def test_retries_wait_for_retry_after(status: int) -> None:
    world = World(refusal(status, "2"), refusal(status, "3"), FINE)
    assert world.run().models == []
    # The random part of the pause comes on top of the stated time.
    assert [round(pause, 3) for pause in world.pauses] == [2.025, 3.05]
    assert world.timeouts_ms == pytest.approx([10000, 7975, 4925], abs=1)


def test_retry_after_may_be_a_date_and_is_none_if_invalid() -> None:
    for seconds, expected in ((60, pytest.approx(55, abs=5)), (-60, 0)):
        date = format_datetime(datetime.now(UTC) + timedelta(seconds=seconds), usegmt=True)
        assert problem_of(*refusal(503, date)).retry_after == expected
    for value in ("", "soon", "-1", "1.5", "٣", "Mon, 99 Foo 2026"):
        assert problem_of(*refusal(503, value)).retry_after is None


def test_a_retry_after_beyond_the_deadline_is_an_error() -> None:
    world = World(refusal(503, "2"), FINE)
    with pytest.raises(ProblemError) as raised:
        world.run(timeout=1.0)
    assert raised.value.retry_after == 2
    assert (len(world.timeouts_ms), world.pauses) == (1, [])


@pytest.mark.parametrize("status", [301, 400, 401, 404, 409, 413, 415, 422, 500, 502])
def test_permanent_errors_are_not_retried(status: int) -> None:
    world = World(refusal(status, "1"))
    with pytest.raises(ProblemError) as raised:
        world.run()
    assert raised.value.status == status
    assert len(world.timeouts_ms) == 1


def test_other_error_answers_become_problems() -> None:
    with pytest.raises(ProblemError) as raised:
        World((502, {"x-request-id": "p7"}, b"<html>Bad Gateway</html>")).run()
    problem = raised.value
    assert (problem.type, problem.status, problem.title) == ("about:blank", 502, "Bad Gateway")
    assert problem.request_id == "p7"
    with pytest.raises(ProblemError, match="799"):
        World((799, {}, b"")).run()


def test_status_504_is_a_deadline_error() -> None:
    world = World(refusal(504))
    with pytest.raises(DeadlineError) as raised:
        world.run()
    assert raised.value.request_id == "r1"
    assert len(world.timeouts_ms) == 1


def test_a_broken_connection_is_tried_again_with_growing_pauses() -> None:
    world = World(BROKEN, REFUSED)
    with pytest.raises(UnreachableError, match="refused"):
        world.run(timeout=600.0, jitter=1.0, retries=8)
    assert len(world.timeouts_ms) == 9
    assert world.pauses == [0.05, 0.1, 0.2, 0.4, 0.8, 1.6, 2.0, 2.0]


failures = [refusal(429, "1"), refusal(503), refusal(503, "0"), REFUSED, BROKEN]


@given(
    outcomes=st.lists(st.sampled_from([*failures, FINE]), min_size=1, max_size=12),
    seconds=st.floats(0, 1),
    timeout=st.floats(0.001, 5),
    retries=st.integers(0, 10),
    jitter=st.floats(0, 1, exclude_max=True),
)
def test_no_call_outlasts_its_deadline(outcomes, seconds, timeout, retries, jitter):
    world = World(*outcomes, seconds=seconds)
    try:
        answer = world.run(timeout=timeout, retries=retries, jitter=jitter)
    except (ProblemError, UnreachableError, DeadlineError):
        pass
    else:
        assert answer.models == []
    assert world.clock - 100.0 <= timeout + 1e-9
    assert len(world.timeouts_ms) <= retries + 1
    for timeout_ms, left in zip(world.timeouts_ms, world.left, strict=True):
        # The service gets at most the time that is left, and at least 1 ms.
        assert 1 <= timeout_ms <= max(1, left * 1e3)
    assert all(0 <= pause <= 1 + LONGEST_PAUSE for pause in world.pauses)


EVERYTHING: dict[str, Any] = {
    "model": {"name": "a", "version": "1.0.0", "variant": "rbm", "digest": "0"},
    "request_id": "r",
    "seed": 1,
    **{key: [] for key in ("relations", "disagreements", "missing", "outliers", "misplaced")},
    **{key: [] for key in ("scenes", "results", "places", "rooms")},
    "label": "lamp",
    "not_here": 1.0,
}
"""An answer to every question."""


@pytest.fixture
def service() -> World:
    return World((200, {}, json.dumps(EVERYTHING).encode()))


@pytest.fixture
def scene(service: World) -> Client:
    return Client("http://robot/api/", transport=service.transport)


def test_short_and_long_forms_are_sent_alike(scene: Client, service: World) -> None:
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
        assert service.body == {"objects": ["desk", plain], "relations": [stated], "at": place}


LAMPS = {"objects": ["bed"], "candidates": ["lamp"]}
ROOMS = [
    {"id": "bedroom", "objects": ["bed", {"label": "desk", "position": {"x": 1, "y": 2, "z": 0}}]}
]


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
        (lambda scene: scene.where("lamp", ROOMS), "where", {"label": "lamp", "rooms": ROOMS}),
        (
            lambda scene: scene.where(
                "lamp",
                (HomeRoom(id="7", room_type="office"), {"id": 8, "objects": ("bed",)}),
                searched=[Searched(room="7"), {"room": "8", "object": "bed", "seen_share": 0.5}],
                top_k=3,
            ),
            "where",
            {
                "label": "lamp",
                "rooms": [{"id": "7", "room_type": "office"}, {"id": "8", "objects": ["bed"]}],
                "searched": [{"room": "7"}, {"room": "8", "object": "bed", "seen_share": 0.5}],
                "top_k": 3,
            },
        ),
        (
            lambda scene: scene.where_batch(
                [
                    WhereRequest(label="lamp", rooms=[HomeRoom(id="a")]),
                    {"label": "bed", "rooms": ROOMS},
                ]
            ),
            "where/batch",
            {
                "scenes": [
                    {"label": "lamp", "rooms": [{"id": "a"}]},
                    {"label": "bed", "rooms": ROOMS},
                ]
            },
        ),
    ],
)
def test_scenes_of_every_form(scene, service, ask, path, body):
    """A request has only the fields that are set."""
    ask(scene)
    assert service.body == body
    assert service.requests[-1].url.path == f"/api/{path}"
    assert service.requests[-1].headers["content-type"] == "application/json"


def test_the_model_of_the_client_is_the_default(service: World) -> None:
    scene = Client("http://robot", model="plain", transport=service.transport)
    scene.relations(["bed"])
    assert service.body["model"] == "plain"
    scene.relations(["bed"], model="home")
    assert service.body["model"] == "home"
    scene.relations_batch([["bed"], {"objects": ["bed"], "model": "home"}])
    assert [entry["model"] for entry in service.body["scenes"]] == ["plain", "home"]
    scene.where("lamp", ROOMS)
    assert service.body["model"] == "plain"
    scene.where_batch([{"label": "lamp", "rooms": ROOMS, "model": "home"}])
    assert service.body["scenes"][0]["model"] == "home"


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
        (lambda scene: scene.where("lamp", []), "#/rooms", "empty"),
        (lambda scene: scene.where("lamp", [{"name": "a"}]), "#/rooms/0/name", "id"),
        (
            lambda scene: scene.where_batch([{"label": "a", "rooms": ROOMS}, {"rooms": ROOMS}]),
            "#/scenes/1/label",
            "required",
        ),
        (lambda scene: scene.where_batch([]), "#/scenes", "256"),
        (lambda scene: scene.missing(["bed"], timeout=0.0), "#", "timeout"),
        (lambda scene: scene.vocabulary(".."), "#", "name"),
        (lambda scene: scene.model("home", ""), "#", "name"),
    ],
)
def test_invalid_requests_are_not_sent(scene, service, ask, pointer, word):
    with pytest.raises(InvalidRequestError, match=word) as raised:
        ask(scene)
    assert pointer in [error.pointer for error in raised.value.errors]
    assert service.requests == []


@pytest.mark.parametrize("url", ["", "robot:8000", "ftp://robot", "http://", "http://robot?a=b"])
def test_invalid_urls_are_refused(url: str) -> None:
    for kind in (Client, AsyncClient):
        with pytest.raises(InvalidRequestError, match="URL"):
            kind(url)


def test_the_key_is_not_shown() -> None:
    assert "aaaa" not in repr(Client("http://robot", api_key="a" * 16).options)


def test_names_are_quoted_in_addresses() -> None:
    service = World((404, {}, b""))
    scene = Client("http://robot", transport=service.transport)
    quoted = {"a/b": b"a%2Fb", "ä b": b"%C3%A4%20b", "x@1.0": b"x%401.0", "../x": b"..%2Fx"}
    for name, text in quoted.items():
        with pytest.raises(ProblemError):
            scene.vocabulary(name)
        assert service.requests[-1].url.raw_path == b"/models/%b/vocabulary" % text


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
