"""The HTTP contract as pydantic models. The service and its clients use the same models.

Each question has its own module. The modules `requests` and `answers` contain the shared parts.
"""

from __future__ import annotations

from scene_client.schemas.answers import *  # noqa: F403
from scene_client.schemas.confirm import *  # noqa: F403
from scene_client.schemas.generate import *  # noqa: F403
from scene_client.schemas.missing import *  # noqa: F403
from scene_client.schemas.models import *  # noqa: F403
from scene_client.schemas.outliers import *  # noqa: F403
from scene_client.schemas.relations import *  # noqa: F403
from scene_client.schemas.requests import *  # noqa: F403
from scene_client.schemas.rooms import *  # noqa: F403
from scene_client.schemas.scenes import *  # noqa: F403
from scene_client.schemas.where import *  # noqa: F403
