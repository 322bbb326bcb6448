"""The fixtures of the service, for attacks on it."""

from tests.http.conftest import client, shared_store

__all__ = ["client", "shared_store"]
