"""A behaviour tree (py_trees): does an object fit, and is the scene complete?

The conditions are those of clients/ros2/scene_reasoning. docs/robots.md has the tree for Nav2.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path
from typing import Any

import py_trees

from scene_client import Client
from scene_client.vision_msgs import from_message

# In a colcon workspace the package is installed, and needs no path.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "clients/ros2/scene_reasoning"))

from scene_reasoning.behaviours import ObjectBelongs, SceneComplete

DETECTIONS = Path(__file__).resolve().parents[1] / "clients/ros2/detections.json"
NEWEST = json.loads(DETECTIONS.read_text("utf-8"))


def look() -> dict[str, Any]:
    """Return the current scene. A condition calls this function in its own thread."""
    return from_message(NEWEST)


with Client(os.environ.get("SCENE_URL", "http://127.0.0.1:8000"), timeout=5) as scene:
    root = py_trees.composites.Selector("desk", memory=True)
    root.add_children(
        [
            ObjectBelongs("fits", scene, look, "toilet", timeout=5, threshold=0.5),
            SceneComplete("complete", scene, look, timeout=5),
        ]
    )
    tree = py_trees.trees.BehaviourTree(root)
    tree.tick()
    while root.status is py_trees.common.Status.RUNNING:  # a robot does other things meanwhile
        time.sleep(0.01)
        tree.tick()
    for condition in root.children:
        print(condition.name, condition.feedback_message, sep=": ")
    tree.shutdown()
