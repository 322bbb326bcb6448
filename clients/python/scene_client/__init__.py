"""Python clients of the scene-reasoning service, based on httpx and pydantic.

docs/clients.md describes the clients.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from scene_client.asynchronous import AsyncClient
    from scene_client.errors import (
        AnswerError,
        ClientError,
        DeadlineError,
        HomeFileError,
        InvalidRequestError,
        ProblemError,
        UnknownThingError,
        UnreachableError,
    )
    from scene_client.files import from_file, rooms_from_file
    from scene_client.formats import from_data
    from scene_client.home import Home
    from scene_client.home_settings import Settings
    from scene_client.home_state import Event
    from scene_client.offline import OfflineClient
    from scene_client.recorder import Recorder
    from scene_client.ros_fields import MessageError
    from scene_client.sync import Client

__version__ = "2.0.0"

__all__ = [
    "AnswerError", "AsyncClient", "Client", "ClientError", "DeadlineError", "Event", "Home",
    "HomeFileError", "InvalidRequestError", "MessageError", "OfflineClient", "ProblemError",
    "Recorder", "Settings", "UnknownThingError", "UnreachableError", "from_data", "from_file",
    "rooms_from_file",
]  # fmt: skip

# Maps each name to the module that defines the name. The package imports the module on first use of
# the name. So the service, which needs only the schemas, starts without httpx.
_MODULES = {
    "AsyncClient": "asynchronous", "Client": "sync", "Event": "home_state", "Home": "home",
    "MessageError": "ros_fields",
    "OfflineClient": "offline", "Recorder": "recorder", "Settings": "home_settings",
    "from_data": "formats", "from_file": "files", "rooms_from_file": "files",
}  # fmt: skip


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULES.get(name, 'errors')}"), name)
