"""The HTTP contract as pydantic models, which the service and its clients share."""

from __future__ import annotations

from scene_client.schemas.answers import *  # noqa: F403
from scene_client.schemas.models import *  # noqa: F403
from scene_client.schemas.requests import *  # noqa: F403
