"""Conditions of behaviour trees, in py_trees itself, about a home."""

import importlib
import sys
import threading
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import py_trees
import pytest
from py_trees.common import Status

from scene_client import Client, Home, Settings, UnreachableError
from tests.client.homes import FakeClient, thing
from tests.deploy.ros import load_package
from tests.services import PATIENCE, LiveService, wait_until

DESK = [thing("desk", 1.0), thing("chair", 2.0), thing("toilet", 3.0)]
Make = Callable[..., Any]


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Make:
    """Return a function that makes a condition, its tree, and its home after twelve frames."""
    load_package(monkeypatch)
    behaviours = importlib.import_module("scene_reasoning.behaviours")
    threads = importlib.import_module("scene_reasoning.home_thread")

    def make(kind: str, client: Any, *arguments: Any, frame: Any = DESK, **options: Any) -> Any:
        home = threads.HomeThread(Home(client, settings=Settings(timeout=60.0)))
        request.addfinalizer(home.close)
        for second in range(12):
            home.see(lambda home, at=second: home.update(frame, (0, 0, 0), at, room="bathroom"))
            home.ask(lambda home: home).result(PATIENCE)
        options = {"timeout": PATIENCE, **options}
        condition = getattr(behaviours, kind)("condition", home, *arguments, **options)
        root = py_trees.composites.Sequence("root", memory=True, children=[condition])
        condition.tree = py_trees.trees.BehaviourTree(root)
        request.addfinalizer(condition.tree.shutdown)
        return condition

    return make


def settle(condition: Any) -> tuple[Status, str]:
    """Tick until the tree has a result."""

    def is_settled() -> bool:
        condition.tree.tick()
        return condition.tree.root.status is not Status.RUNNING

    wait_until(is_settled)
    return condition.tree.root.status, condition.feedback_message


def test_scene_complete(make: Make, live: LiveService) -> None:
    with Client(live.url, timeout=60.0) as client:
        found = make("SceneComplete", client).home.ask(lambda home: home.missing()).result().missing
        highest = max(found, key=lambda one: one.log_odds)
        for margin, expected in ((0.01, Status.SUCCESS), (-0.01, Status.FAILURE)):
            condition = make("SceneComplete", client, log_odds=highest.log_odds + margin)
            status, reason = settle(condition)
            assert status is expected
            assert (highest.label in reason) is (expected is Status.FAILURE)
        couch = {"candidates": ["couch"], "log_odds": -1e3}
        assert settle(make("SceneComplete", client, **couch))[1] == "missing: couch"


def test_object_belongs_and_is_known(make: Make) -> None:
    client = FakeClient()
    client.odd = {"toilet"}
    cases = [
        ("ObjectBelongs", "toilet", {}, False, "toilet t3: out-of-place, 0.90"),
        ("ObjectBelongs", "t3", {}, False, "toilet t3: out-of-place, 0.90"),
        ("ObjectBelongs", "desk", {}, True, "desk belongs"),
        ("ObjectBelongs", "sofa", {}, False, "no sofa was seen"),
        ("ObjectBelongs", "toilet", {"room": "kitchen"}, False, "no toilet was seen"),
        ("ObjectKnown", "toilet", {"room": "bathroom"}, True, "present: t3"),
        ("ObjectKnown", "sofa", {}, False, "no sofa was seen"),
    ]
    for kind, label, options, holds, reason in cases:
        condition = make(kind, client, label, **options)
        asked = len(client.asked)
        assert settle(condition) == (Status.SUCCESS if holds else Status.FAILURE, reason)
        assert len(client.asked) == asked


def test_a_condition_fails_with_a_reason(make: Make) -> None:
    client = FakeClient()
    empty = make("SceneComplete", client, frame=[])
    assert settle(empty) == (Status.FAILURE, "nothing was seen")
    lost = make("SceneComplete", client)
    client.error = UnreachableError("gone")
    assert settle(lost) == (Status.FAILURE, "UnreachableError: gone")


def test_a_condition_fails_at_its_timeout(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    clock, answering = SimpleNamespace(now=100.0), threading.Event()
    condition = make("ObjectKnown", FakeClient(), "desk", timeout=1.0)
    condition.home.ask(lambda _: answering.wait(PATIENCE))
    module = sys.modules[type(condition).__module__]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    for clock.now in (100.0, 100.5, 100.99):
        condition.tree.tick()
        assert condition.status is Status.RUNNING
    clock.now = 101.01
    condition.tree.tick()
    assert condition.status is Status.FAILURE
    assert condition.feedback_message == "no answer in time"
    answering.set()


def test_an_interrupted_condition_asks_again(make: Make) -> None:
    answering, asked = threading.Event(), []
    condition = make("ObjectKnown", FakeClient(), "desk")
    judge = condition.judge
    condition.judge = lambda home: asked.append(home) or judge(home)
    condition.home.ask(lambda _: answering.wait(PATIENCE))
    for _ in range(3):
        condition.tree.root.stop(Status.INVALID)
        assert condition.status is Status.INVALID
        condition.tree.tick()
        assert condition.status is Status.RUNNING
    answering.set()
    assert settle(condition) == (Status.SUCCESS, "present: t1")
    assert len(asked) == 1
