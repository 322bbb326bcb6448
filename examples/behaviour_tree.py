"""A behaviour tree (py_trees): does an object belong, and is the scene complete?

The conditions are those of clients/ros2/scene_reasoning. docs/robots.md has the tree for Nav2.
"""

from __future__ import annotations

import json
import os
import sys
import time
from pathlib import Path

import py_trees

from scene_client import Client, Home, Settings
from scene_client.vision_msgs import from_message

# In a colcon workspace the package is installed, and needs no path.
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "clients/ros2/scene_reasoning"))

from scene_reasoning.behaviours import ObjectBelongs, SceneComplete
from scene_reasoning.home_thread import HomeThread

DETECTIONS = Path(__file__).resolve().parents[1] / "clients/ros2/detections.json"
FRAME = from_message(json.loads(DETECTIONS.read_text("utf-8")))["objects"]

with Client(os.environ.get("SCENE_URL", "http://127.0.0.1:8000")) as scene:
    home = HomeThread(Home(scene, settings=Settings(timeout=5.0)))
    for second in range(12):  # on a robot, each message of the detector is one frame
        home.ask(lambda home, at=second: home.update(FRAME, (0, 0, 0), at)).result()
    root = py_trees.composites.Selector("desk", memory=True)
    root.add_children(
        [
            ObjectBelongs("belongs", home, "toilet", timeout=5),
            SceneComplete("complete", home, timeout=5),
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
    home.close()
