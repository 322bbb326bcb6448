"""Conditions of behaviour trees, in py_trees itself, against a running service."""

import importlib
import sys
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

import py_trees
import pytest
from py_trees.common import Status

from scene_client import Client
from scene_client.vision_msgs import SceneFields
from tests.deploy.ros import Slow, load_package
from tests.services import PATIENCE, LiveService, wait_until

BED = {"objects": ["bed"]}
NOTHING = SimpleNamespace(missing=[])
Make = Callable[..., Any]


@pytest.fixture(scope="module")
def client(live: LiveService) -> Iterator[Client]:
    with Client(live.url, timeout=60.0) as client:
        yield client


@pytest.fixture
def make(monkeypatch: pytest.MonkeyPatch, request: pytest.FixtureRequest) -> Make:
    """Return a function that makes a condition and its tree; the test's end shuts the tree down."""
    load_package(monkeypatch)
    behaviours = importlib.import_module("scene_reasoning.behaviours")

    def make(kind: str, client: Any, scene: Any, *arguments: Any, **options: Any) -> Any:
        source = scene if callable(scene) else lambda: scene
        condition = getattr(behaviours, kind)(
            "condition", client, source, *arguments, **{"timeout": PATIENCE, **options}
        )
        root = py_trees.composites.Sequence("root", memory=True, children=[condition])
        condition.tree = py_trees.trees.BehaviourTree(root)
        request.addfinalizer(condition.tree.shutdown)
        return condition

    return make


def settle(condition: Any) -> Status:
    """Tick until the tree has a result."""

    def is_settled() -> bool:
        condition.tree.tick()
        return condition.tree.root.status is not Status.RUNNING

    wait_until(is_settled)
    return condition.tree.root.status


def test_scene_complete(make: Make, client: Client, scene: SceneFields) -> None:
    best = client.missing(**scene).missing
    highest = max(best, key=lambda thing: thing.log_odds)
    for margin, expected in ((0.01, Status.SUCCESS), (-0.01, Status.FAILURE)):
        condition = make("SceneComplete", client, scene, log_odds=highest.log_odds + margin)
        assert settle(condition) is expected
        assert condition.answer.missing == best
        assert (highest.label in condition.feedback_message) is (expected is Status.FAILURE)


@pytest.mark.parametrize("thing", ["toilet_1", "toilet"])
def test_object_belongs(make: Make, client: Client, scene: SceneFields, thing: str) -> None:
    (toilet,) = (entry for entry in client.outliers(**scene).outliers if entry.object == "toilet_1")
    for margin, expected in ((0.001, Status.SUCCESS), (-0.001, Status.FAILURE)):
        threshold = toilet.probability + margin
        condition = make("ObjectBelongs", client, scene, thing, threshold=threshold)
        assert settle(condition) is expected
        assert condition.feedback_message.startswith("toilet_1: an outlier with probability 0.")


ANY = {"log_odds": -1e3}
LAMP = {"candidates": ["lamp"], "at": {"relation": "on-top", "object": "desk"}, **ANY}


@pytest.mark.parametrize(
    ("name", "found"), [("Couches", "s"), ("sofa", "s"), ("desk", "desk"), ("table", "desk")]
)
def test_an_object_has_its_label_and_its_classes(make, client, name, found):
    scene = {"objects": ["bed", {"id": "s", "label": "Couches"}, "desk"]}
    condition = make("ObjectBelongs", client, scene, name, threshold=0.0)
    assert settle(condition) is Status.FAILURE
    assert condition.feedback_message.startswith(f"{found}: an outlier")
    complete = make("SceneComplete", client, scene, candidates=["table"], **ANY)
    assert settle(complete) is Status.SUCCESS


def test_a_condition_fails_with_a_reason(make: Make, client: Client, scene: SceneFields) -> None:
    with Client("http://127.0.0.1:9") as unreachable:
        conditions = {
            "nothing was seen": make("SceneComplete", client, None),
            "nothing was seen.": make("SceneComplete", client, {"objects": []}),
            "missing: lamp": make("SceneComplete", client, scene, **LAMP),
            "missing: couch": make("SceneComplete", client, scene, candidates=["couch"], **ANY),
            "no sofa was seen": make("ObjectBelongs", client, scene, "sofa"),
            "UnreachableError: ": make("SceneComplete", unreachable, BED),
        }
        for reason, condition in conditions.items():
            assert settle(condition) is Status.FAILURE
            assert condition.feedback_message.startswith(reason.rstrip("."))


def test_a_condition_fails_at_its_timeout(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    client, clock = Slow(NOTHING), SimpleNamespace(now=100.0)
    condition = make("SceneComplete", client, BED, timeout=1.0)
    module = sys.modules[type(condition).__module__]
    monkeypatch.setattr(module, "time", SimpleNamespace(monotonic=lambda: clock.now))
    for clock.now in (100.0, 100.5, 100.99):
        condition.tree.tick()
        assert condition.status is Status.RUNNING
    clock.now = 101.01
    condition.tree.tick()
    assert condition.status is Status.FAILURE
    assert condition.feedback_message == "no answer in time"
    client.answering.set()


def test_an_interrupted_condition_uses_the_next_scene(make: Make) -> None:
    client, scenes = Slow(NOTHING), iter([["bed"], ["lamp"], ["sofa"]])
    condition = make("SceneComplete", client, lambda: {"objects": next(scenes)})
    condition.tree.tick()
    assert client.started.acquire(timeout=PATIENCE)
    # At the second interruption, the condition's question has not started yet.
    for _ in range(2):
        condition.tree.root.stop(Status.INVALID)
        assert condition.status is Status.INVALID
        condition.tree.tick()
        assert condition.status is Status.RUNNING
    client.answering.set()
    assert settle(condition) is Status.SUCCESS
    assert [fields["objects"] for fields in client.requests] == [["bed"], ["lamp"]]
