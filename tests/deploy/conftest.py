"""The recorded detections: as JSON, as a ROS message, and as the fields of a scene."""

import json
from pathlib import Path
from typing import Any

import pytest

from scene_client.sightings import SceneFields
from scene_client.vision_msgs import from_message
from tests.deploy.ros import from_json


@pytest.fixture
def envelope(repository: Path) -> Any:
    """The message as rosbridge sends it."""
    return json.loads((repository / "clients/ros2/detections.json").read_text())


@pytest.fixture
def recorded(envelope: Any) -> Any:
    return from_json("vision_msgs/msg/Detection3DArray", envelope["msg"])


@pytest.fixture
def scene(envelope: Any) -> SceneFields:
    return from_message(envelope)
