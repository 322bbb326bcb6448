"""The HTTP contract of `/confirm`: a scene that a person has confirmed, for `training adapt`."""

from __future__ import annotations

from scene_client.schemas.answers import Reply
from scene_client.schemas.requests import SceneRequest, SomeObjects


class ConfirmRequest(SceneRequest):
    """A scene in which everything is right."""

    objects: SomeObjects


class ConfirmAnswer(Reply):
    """The service has written the scene to its recording."""

    request_id: str
    scene_id: str
    """id of the scene in the recording"""
