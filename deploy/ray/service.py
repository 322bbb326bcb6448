"""The service as an application of Ray Serve, with the import path ``deploy.ray.service:app``."""

from __future__ import annotations

from logging.config import dictConfig

from ray import serve
from starlette.types import ASGIApp, Receive, Scope, Send

from app.__main__ import tune
from app.main import create_app
from app.serving.logs import log_config
from app.settings import Settings


@serve.deployment(name="scene")
@serve.ingress()
class Replica:
    """One replica. Its settings are those of the environment."""

    def __serve_build_asgi_app__(self) -> ASGIApp:
        """Build the application. Ray Serve calls this method in the replica's process."""
        tune()
        settings = Settings()
        dictConfig(log_config(settings))
        app = create_app(settings)
        self._runtime = app.state.runtime

        # A function has no routes, so Ray Serve does not match each path a second time.
        async def answer(scope: Scope, receive: Receive, send: Send) -> None:
            await app(scope, receive, send)

        return answer

    def check_health(self) -> None:
        """Raise an error if the service is not ready. Ray Serve then replaces the replica."""
        self._runtime.check_ready()

    def __del__(self) -> None:
        """Refuse further requests. Ray Serve calls this method after the requests in progress."""
        self._runtime.draining = True


app = Replica.bind()
