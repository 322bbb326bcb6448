"""The HTTP contract: plain pydantic, shared by the service and its clients.

A question has a module of its own. `requests` and `answers` hold the parts that questions share.
"""

from __future__ import annotations

from scene_client.schemas.answers import *  # noqa: F403
from scene_client.schemas.generate import *  # noqa: F403
from scene_client.schemas.missing import *  # noqa: F403
from scene_client.schemas.models import *  # noqa: F403
from scene_client.schemas.outliers import *  # noqa: F403
from scene_client.schemas.relations import *  # noqa: F403
from scene_client.schemas.requests import *  # noqa: F403
