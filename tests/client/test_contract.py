"""The answers and problems of each client, compared with those of the service."""

import os
import re
import sys
from pathlib import Path
from typing import Any

import pytest

from app import questions
from app.api.examples import REQUESTS
from scene_client import Client, OfflineClient, ProblemError
from tests.client.callers import Caller
from tests.client.conftest import EVERY
from tests.conftest import run_program
from tests.services import LiveService

every_client = pytest.mark.parametrize("caller", EVERY, indirect=True)

BEDROOM = REQUESTS["relations"]["relations"].value
QUESTIONS: list[tuple[str, dict[str, Any]]] = [
    *[
        (question.name, case.value | ({"seed": 7} if question.name == "generate" else {}))
        for question in questions.QUESTIONS
        for case in question.examples.values()
        if case.problem is None
    ],
    ("relations", {**BEDROOM, "include_opposites": True, "min_probability": 0.1}),
    ("missing", {"objects": ["desk", "big lamp"], "coverage": 0.9, "unknown_labels": "nearest"}),
    ("missing", {"objects": ["desk", "bed"], "candidates": ["lamp", "TV"], "model": "plain"}),
    ("outliers", {**BEDROOM, "sensitivity": "high", "stamp": {"sec": 1, "nanosec": 2}}),
]


def _same(answer: dict[str, Any], other: dict[str, Any]) -> bool:
    return {**answer, "request_id": ""} == {**other, "request_id": ""}


@every_client
@pytest.mark.parametrize("number", range(len(QUESTIONS)))
def test_answers_are_those_of_the_service(caller: Caller, live: LiveService, number: int) -> None:
    question, request = QUESTIONS[number]
    response = live.client.post(f"/{question}", json=request)
    assert response.status_code == 200
    # The probabilities are equal to the last digit.
    assert _same(caller(question, request), response.json())


@every_client
def test_each_scene_of_a_batch_has_its_answer_or_problem(caller: Caller, live: LiveService) -> None:
    scenes = [{"objects": ["bed"]}, {"objects": ["nonsuch"]}, {"objects": ["desk", "lamp"]}]
    for question in ("relations", "missing", "outliers", "rooms"):
        found = caller(f"{question}_batch", scenes)["results"]
        assert [entry["status"] for entry in found] == [200, 422, 200]
        assert found[1]["problem"]["type"] == "/problems/unknown-labels"
        response = live.client.post(f"/{question}", json=scenes[2]).json()
        assert _same(found[2]["result"], response)


@every_client
def test_each_question_of_a_batch_about_homes_has_its_answer_or_problem(
    caller: Caller, live: LiveService
) -> None:
    rooms = [{"id": "bedroom", "objects": ["bed"]}, {"id": "room_2", "room_type": "office"}]
    homes = [{"label": label, "rooms": rooms} for label in ("lamp", "nonsuch", "bed")]
    found = caller("where_batch", homes)["results"]
    assert [entry["status"] for entry in found] == [200, 422, 200]
    assert found[1]["problem"]["errors"][0]["pointer"] == "#/scenes/1/label"
    assert _same(found[0]["result"], live.client.post("/where", json=homes[0]).json())
    assert found[2]["result"]["places"][0]["is_listed"]


@every_client
def test_unknown_labels_are_a_problem(caller: Caller) -> None:
    with pytest.raises(ProblemError) as raised:
        caller("missing", {"objects": ["nightstnad", *(f"nonsuch {n}" for n in range(11))]})
    problem, text = raised.value, str(raised.value)
    assert (problem.type, problem.status) == ("/problems/unknown-labels", 422)
    assert problem.errors[0].suggestions[0] == "nightstand"
    assert [error.pointer for error in problem.errors] == [f"#/objects/{n}" for n in range(12)]
    assert problem.request_id
    assert "12 errors" in problem.detail
    assert problem.retry_after is None
    assert problem.title in text
    assert ": the model does not know this label (did you mean night" in text
    for way_out in ("`ignore`", "synonyms", "init --update", "training adapt"):
        assert way_out in problem.detail
    assert "#/objects/9: " in text
    assert "#/objects/10: " not in text
    assert text.endswith("\n  and 2 more errors")


def test_the_error_quotes_unknown_labels(url: str) -> None:
    unknown = "the model does not know this label"
    objects = ["bed", {"label": "nonsuch"}, "nightstnad"]
    with Client(url) as client, pytest.raises(ProblemError) as raised:
        client.missing(objects)
    text = str(raised.value)
    assert re.search(rf'#/objects/1\S*: "nonsuch": {unknown}', text)
    assert f'#/objects/2: "nightstnad": {unknown} (did you mean nightstand' in text


def test_offline_and_online_clients_list_models_alike(url: str, shared_store: Path) -> None:
    with Client(url) as online, OfflineClient(shared_store) as offline:
        for ask in (
            lambda client: client.model("home"),
            lambda client: client.model("home", "1.0.0"),
            lambda client: client.vocabulary(),
            lambda client: client.vocabulary("plain"),
            lambda client: client.word("divan/couch"),
            lambda client: client.is_live(),
        ):
            assert ask(online) == ask(offline)


UNCLOSED = """
import sys
from scene_client import DeadlineError, OfflineClient
scene = OfflineClient(sys.argv[1])
try:
    scene.generate(count=64, steps=500, timeout=0.01)
except DeadlineError:
    print("late")
"""


def test_an_unclosed_offline_client_does_not_block_the_exit(shared_store: Path) -> None:
    # The client ignores the settings of a service.
    environment = {**os.environ, "SCENE_API_KEY": "short", "SCENE_STORE": "/nowhere"}
    command = (sys.executable, "-W", "error", "-c", UNCLOSED, shared_store)
    done = run_program(*command, env=environment)
    assert (done.stdout, done.stderr) == ("late\n", "")
