"""The programs of `examples/`, each with the shipped models."""

import copy
import json
import os
import runpy
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from tests.client.ros_messages import blank
from tests.conftest import REPOSITORY, FindTool, run_program
from tests.deploy.ros import STORE, Ros, from_json
from tests.services import LiveService

pytestmark = pytest.mark.system

EXAMPLES = REPOSITORY / "examples"


def run(*command: str | Path, url: str, **options: Any) -> Any:
    return run_program(*command, cwd=EXAMPLES, env=os.environ | {"SCENE_URL": url}, **options)


def run_python(name: str, url: str, **options: Any) -> Any:
    """Run a Python program with deadlines that a busy machine keeps."""
    path = str(EXAMPLES / name)
    unhurried = (
        f"import re; __file__ = {path!r}; text = open(__file__, encoding='utf-8').read(); "
        r"exec(compile(re.sub(r'\btimeout=[\d.]+', 'timeout=60', text), __file__, 'exec'))"
    )
    return run(sys.executable, "-c", unhurried, url=url, **options)


def test_the_readme_lists_every_program() -> None:
    listed = (EXAMPLES / "README.md").read_text("utf-8")
    for path in EXAMPLES.iterdir():
        if path.is_file() and path.name != "README.md":
            assert f"]({path.name})" in listed
            assert (
                path.suffix in (".ipynb", ".csv") or len(path.read_text("utf-8").splitlines()) <= 60
            )


def test_curl_asks_the_six_questions(shipped: LiveService, find_tool: FindTool) -> None:
    find_tool("curl")
    lines = run(find_tool("bash"), "curl.sh", url=shipped.url).stdout.splitlines()
    answers = dict(zip(lines[::2], map(json.loads, lines[1::2]), strict=True))
    assert list(answers) == ["relations", "missing", "outliers", "rooms", "generate", "where"]
    assert answers["relations"]["relations"][0]["relation"] == "on-top"
    assert "lamp" in {thing["label"] for thing in answers["missing"]["missing"]}
    wrong = [thing["object"] for thing in answers["outliers"]["outliers"] if thing["is_outlier"]]
    assert wrong == ["toilet"]
    assert answers["rooms"]["room_types"][0]["room_type"] == "bathroom"
    assert {"desk", "bed"} <= set(answers["generate"]["scenes"][0]["objects"])
    assert answers["where"]["rooms"][0]["room"] == "bathroom"


def test_the_python_program_asks_and_branches_on_errors(shipped: LiveService) -> None:
    printed = run_python("ask.py", shipped.url).stdout.splitlines()
    values = dict(line.split(": ", 1) for line in printed)
    assert values["read as"] == "{'moniter': 'monitor'}"
    assert values["left out"] == "['qwzx']"
    assert values["relations"] == "[('lamp_1', 'on-top', 'desk_1')]"
    assert "mouse" in values["missing on the desk"]
    assert values["outliers"] == "['toilet']"
    assert values["room"] == "office"
    assert "desk" in values["a whole room"]
    assert values["the toothbrush"].startswith("bathroom")
    assert "nightstand" in values["unknown label at #/objects/1"]


def test_the_python_program_reports_a_missing_service() -> None:
    done = run(sys.executable, "ask.py", url="http://127.0.0.1:9", status=1)
    assert done.stderr.startswith("no answer: ")
    assert len(done.stderr.splitlines()) == 1


def test_the_behaviour_tree_says_why_its_conditions_fail(shipped: LiveService) -> None:
    printed = run_python("behaviour_tree.py", shipped.url).stdout.splitlines()
    assert printed[0].startswith("belongs: toilet t7: out-of-place, 0.9")
    assert printed[1].startswith("complete: missing: computer")


def test_the_ros_node_publishes_events(shipped, monkeypatch):
    recorded = json.loads((REPOSITORY / "clients/ros2/detections.json").read_text("utf-8"))
    message = from_json("vision_msgs/msg/Detection3DArray", recorded["msg"])
    unnamed = copy.deepcopy(message.detections[0])
    unnamed.results = unnamed.results[:1]
    unnamed.results[0].hypothesis.class_id = "7"
    for url in (shipped.url, "http://127.0.0.1:9"):
        ros = Ros({})
        for name, module in ros.modules().items():
            monkeypatch.setitem(sys.modules, name, module)
        monkeypatch.setenv("SCENE_URL", url)
        runpy.run_path(str(EXAMPLES / "ros2_node.py"), run_name="__main__")
        (node,) = ros.spun
        kind, callback = ros.subscriptions["detections"]
        assert kind.ros_name == message.__msgtype__
        node.home.settings = replace(node.home.settings, timeout=60)  # the machine is busy
        messages = [*[message] * 10, blank(STORE, kind.ros_name, detections=[unnamed])]
        for one in messages:
            node.updated.result()  # a message that comes earlier is left out
            one.header.stamp.sec += 1
            callback(one)
        node.thread.shutdown()
        node.scene.close()
        sent = [published.data for published in ros.publishers["~/events"].sent]
        assert {"appeared desk", "appeared chair"} <= set(sent)
        assert ("out-of-place toilet" in sent) is (url == shipped.url)
        assert ("service lost" in sent) is (url != shipped.url)
        assert [text[:40] for text in ros.warned] == ["MessageError: the class ids are numbers:"]
