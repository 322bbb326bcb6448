"""Conditions for BehaviorTree.CPP, compiled against a stand-in of it, against a running service."""

import json
import socket
from pathlib import Path
from typing import Any

import pytest

from scene_client import Client
from scene_client.sightings import SceneFields
from tests.client import callers
from tests.conftest import run_program

pytestmark = [pytest.mark.system, pytest.mark.slow]


@pytest.fixture(scope="module")
def program(repository, tmp_path_factory, find_tool):
    here = Path(__file__).parent
    return callers.compiled(
        find_tool,
        here / "conditions.cpp",
        tmp_path_factory.mktemp("conditions") / "conditions",
        repository / "clients" / "ros2" / "behaviortree_cpp",
        here,
    )


def tick(program: Path, url: str, kind: str, *ports: Any, timeout: float = 60.0) -> list[Any]:
    """What becomes of one condition, ticked to its end with one set of ports after the other."""
    lines = "".join(json.dumps(entry) + "\n" for entry in ports)
    done = run_program(program, url, kind, str(timeout), input=lines)
    return [json.loads(line) for line in done.stdout.splitlines()]


def test_scene_complete(program: Path, url: str, scene: SceneFields) -> None:
    with Client(url, timeout=60.0) as client:
        missing = client.missing(**scene).missing
    highest = max(missing, key=lambda thing: thing.log_odds)
    ports = {"scene": json.dumps(scene)}
    limits = [{"log_odds": str(highest.log_odds + margin)} for margin in (0.01, -0.01)]
    lists = [ports | limits[0], ports | limits[1], ports]
    above, below, default = tick(program, url, "SceneComplete", *lists)
    because = "nothing is missing"
    assert above == {"status": "SUCCESS", "because": because, "waited": True, "woken": 1}
    assert (below["status"], below["because"]) == ("FAILURE", f"missing: {highest.label}")
    absent = [thing.label for thing in missing if thing.log_odds >= 0]
    assert (default["status"] == "FAILURE") is bool(absent)
    assert all(label in default["because"] for label in absent)
    # The robot's own word is named.
    couch = {"scene": json.dumps({**scene, "candidates": ["couch"]}), "log_odds": "-1000"}
    (own,) = tick(program, url, "SceneComplete", couch)
    assert own["because"] == "missing: couch"


def test_object_belongs(program: Path, url: str, scene: SceneFields) -> None:
    with Client(url, timeout=60.0) as client:
        outliers = client.outliers(**scene).outliers
    (toilet,) = (thing for thing in outliers if thing.label == "toilet")
    strict = {"scene": json.dumps({**scene, "threshold": toilet.probability - 0.001})}
    mild = {"scene": json.dumps({**scene, "threshold": toilet.probability + 0.001})}
    objects = ({"object": name} for name in ("toilet_1", "toilet", "sofa"))
    ports = [mild | {"object": "toilet_1"}, *(strict | name for name in objects), strict]
    found = tick(program, url, "ObjectBelongs", *ports)
    assert [(entry["status"], entry["because"]) for entry in found] == [
        ("SUCCESS", "toilet_1 belongs"),
        ("FAILURE", "toilet_1 is an outlier"),
        ("FAILURE", "toilet_1 is an outlier"),
        ("FAILURE", "no sofa was seen"),
        ("FAILURE", "no object was named"),
    ]
    couch = {"scene": '{"objects": ["bed", {"id": "s", "label": "Couches"}], "threshold": 1}'}
    words = [couch | {"object": word} for word in ("Couches", "sofa", "couch")]
    found = tick(program, url, "ObjectBelongs", *words)
    assert [entry["because"] for entry in found] == ["s belongs"] * 2 + ["no couch was seen"]
    # A desk is a table.
    desk = {"scene": '{"objects": ["bed", "desk"], "threshold": 1}', "object": "table"}
    (found,) = tick(program, url, "ObjectBelongs", desk)
    assert found["because"] == "desk belongs"


def test_an_unreachable_service_fails_the_condition(program: Path) -> None:
    scene = {"scene": '{"objects": ["bed"]}'}
    with socket.create_server(("127.0.0.1", 0)) as server:  # accepts and never answers
        url = f"http://127.0.0.1:{server.getsockname()[1]}"
        (late,) = tick(program, url, "SceneComplete", scene, timeout=0.2)
    assert (late["status"], late["waited"]) == ("FAILURE", True)
    assert late["because"] == f"{url}/missing did not answer within 0.2 s"
    (refused,) = tick(program, "http://127.0.0.1:9", "SceneComplete", scene)
    assert (refused["status"], refused["waited"]) == ("FAILURE", True)
