"""The HTTP contract: plain pydantic, shared by the service and its clients."""

from __future__ import annotations

from scene_client.schemas.answers import *  # noqa: F403
from scene_client.schemas.models import *  # noqa: F403
from scene_client.schemas.requests import *  # noqa: F403
