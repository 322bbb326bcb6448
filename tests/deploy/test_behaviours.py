"""Conditions of behaviour trees, in py_trees itself, against a running service."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import py_trees
import pytest
from py_trees.common import Status

from scene_client import Client
from scene_client.schemas import OutliersAnswer
from scene_client.vision_msgs import SceneFields
from tests.deploy.ros import load_package
from tests.services import LiveService, wait_until


@pytest.fixture(scope="module")
def client(live: LiveService) -> Iterator[Client]:
    with Client(f"http://127.0.0.1:{live.port}", timeout=20.0) as client:
        yield client


@pytest.fixture
def behaviours(monkeypatch: pytest.MonkeyPatch) -> Any:
    load_package(monkeypatch)
    return importlib.import_module("scene_reasoning.behaviours")


Plant = Callable[[Any], Any]


@pytest.fixture
def plant(request: pytest.FixtureRequest) -> Plant:
    """Return a function that makes a tree of one condition; the test's end shuts it down."""

    def make(condition: Any) -> Any:
        root = py_trees.composites.Sequence("root", memory=True, children=[condition])
        tree = py_trees.trees.BehaviourTree(root)
        request.addfinalizer(tree.shutdown)
        return tree

    return make


def settle(tree: Any) -> Status:
    """Tick until the tree has a result."""

    def is_settled() -> bool:
        tree.tick()
        return tree.root.status is not Status.RUNNING

    wait_until(is_settled)
    return tree.root.status


def test_a_scene_is_complete_if_nothing_missing_is_rather_there_than_not(
    behaviours: Any, client: Client, scene: SceneFields, plant: Plant
) -> None:
    best = client.missing(**scene).missing
    highest = max(best, key=lambda thing: thing.log_odds)
    for margin, expected in ((0.01, Status.SUCCESS), (-0.01, Status.FAILURE)):
        condition = behaviours.SceneComplete(
            "complete", client, lambda: scene, timeout=30.0, log_odds=highest.log_odds + margin
        )
        assert settle(plant(condition)) is expected
        assert condition.answer.missing == best
        assert (highest.label in condition.feedback_message) is (expected is Status.FAILURE)


@pytest.mark.parametrize("thing", ["toilet_1", "toilet"])
def test_a_thing_belongs_unless_it_is_an_outlier(
    behaviours: Any, client: Client, scene: SceneFields, plant: Plant, thing: str
) -> None:
    (toilet,) = (entry for entry in client.outliers(**scene).outliers if entry.object == "toilet_1")
    for margin, expected in ((0.001, Status.SUCCESS), (-0.001, Status.FAILURE)):
        condition = behaviours.ObjectBelongs(
            "belongs",
            client,
            lambda: scene,
            thing,
            timeout=30.0,
            threshold=toilet.probability + margin,
        )
        assert settle(plant(condition)) is expected
        assert condition.feedback_message.startswith("toilet_1: an outlier with probability 0.")


@pytest.mark.parametrize(
    ("thing", "moved", "is_misplaced", "message"),
    [
        ("pillow_1", "pillow_1", True, "pillow_1: in the wrong place, pillow_1 on-top floor"),
        ("pillow", "pillow_1", True, "pillow_1: in the wrong place, pillow_1 on-top floor"),
        ("pillow_1", "bed", True, None),
        ("pillow_1", None, False, None),
    ],
)
def test_a_thing_in_the_wrong_place_does_not_belong(
    behaviours: Any, plant: Plant, thing: str, moved: str | None, is_misplaced: bool, message: Any
) -> None:
    outlier = {"probability": 0.01, "log_odds": 2.0, "is_outlier": False}
    place = {"subject": "pillow_1", "relation": "on-top", "object": "floor", "probability": 0.9}
    answer = OutliersAnswer.model_validate(
        {
            "model": {"name": "home", "version": "1.0.0", "variant": "rbm", "digest": "0"},
            "request_id": "r",
            "outliers": [outlier | {"object": "pillow_1", "label": "pillow"}],
            "misplaced": [place | {"is_misplaced": is_misplaced, "moved": moved}],
        }
    )
    client = SimpleNamespace(outliers=lambda **fields: answer)
    condition = behaviours.ObjectBelongs("belongs", client, lambda: {"objects": ["bed"]}, thing)
    assert settle(plant(condition)) is (Status.FAILURE if message else Status.SUCCESS)
    likely = "pillow_1: an outlier with probability 0.01"
    assert condition.feedback_message == (message or likely)


LAMP = {"candidates": ["lamp"], "at": {"relation": "on-top", "object": "desk"}, "log_odds": -1e3}


@pytest.mark.parametrize(
    ("kind", "arguments", "options", "message"),
    [
        ("SceneComplete", [lambda: None], {}, "nothing was seen"),
        ("SceneComplete", [lambda: {"objects": []}], {}, "nothing was seen"),
        ("SceneComplete", [], LAMP, "missing: lamp"),
        ("ObjectBelongs", [None, "sofa"], {}, "no sofa was seen"),
    ],
)
def test_a_condition_fails_with_a_reason(
    behaviours: Any,
    client: Client,
    scene: SceneFields,
    plant: Plant,
    kind: str,
    arguments: list[Any],
    options: dict[str, Any],
    message: str,
) -> None:
    source, *others = arguments or [None]
    condition = getattr(behaviours, kind)(
        "condition", client, source or (lambda: scene), *others, timeout=30.0, **options
    )
    assert settle(plant(condition)) is Status.FAILURE
    assert condition.feedback_message == message


def test_a_service_that_is_not_there_fails_the_condition(behaviours: Any, plant: Plant) -> None:
    with Client("http://127.0.0.1:9") as client:
        condition = behaviours.SceneComplete(
            "complete", client, lambda: {"objects": ["bed"]}, timeout=30.0
        )
        assert settle(plant(condition)) is Status.FAILURE
    assert condition.feedback_message.startswith("UnreachableError: ")


class Slow:
    """A client that answers when it is told to."""

    def __init__(self) -> None:
        self.answering, self.asked = threading.Event(), threading.Semaphore(0)
        self.scenes: list[Any] = []

    def missing(self, **fields: Any) -> Any:
        self.scenes.append(fields["objects"])
        self.asked.release()
        assert self.answering.wait(30)
        return SimpleNamespace(missing=[])


def test_a_tick_never_waits_and_a_condition_fails_in_time(behaviours: Any, plant: Plant) -> None:
    client, clock = Slow(), SimpleNamespace(now=100.0)
    condition = behaviours.SceneComplete("complete", client, lambda: {"objects": ["bed"]})
    behaviours.time = SimpleNamespace(monotonic=lambda: clock.now)
    tree = plant(condition)
    for clock.now in (100.0, 100.5, 100.99):
        tree.tick()
        assert tree.root.status is Status.RUNNING
    clock.now = 101.01
    tree.tick()
    assert tree.root.status is Status.FAILURE
    assert condition.feedback_message == "no answer in time"
    client.answering.set()


def test_an_interrupted_condition_uses_the_next_scene(behaviours: Any, plant: Plant) -> None:
    client, scenes = Slow(), iter([["bed"], ["lamp"], ["sofa"]])
    condition = behaviours.SceneComplete(
        "complete", client, lambda: {"objects": next(scenes)}, timeout=30.0
    )
    tree = plant(condition)
    tree.tick()
    assert client.asked.acquire(timeout=30)
    # Interrupted twice: the second time its question had not even begun.
    for _ in range(2):
        tree.root.stop(Status.INVALID)
        assert condition.status is Status.INVALID
        tree.tick()
        assert condition.status is Status.RUNNING
    client.answering.set()
    assert settle(tree) is Status.SUCCESS
    assert client.scenes == [["bed"], ["lamp"]]
