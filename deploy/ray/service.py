"""The service as an application of Ray Serve, with the import path ``deploy.ray.service:app``."""

from __future__ import annotations

from logging.config import dictConfig

from ray import serve
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from app.__main__ import tune
from app.main import create_app
from app.serving.logs import log_config
from app.settings import Settings

_REQUEST_ID = b"x-request-id"


class OneRequestId:
    """Middleware that removes the request id from answers, because Ray Serve adds it again.

    Ray Serve gives every request an id and copies the id into the answer. The service answers with
    the same id. A client would get the header twice.
    """

    def __init__(self, app: ASGIApp) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_without_id(message: Message) -> None:
            if message["type"] == "http.response.start":
                headers = message["headers"]
                message["headers"] = [pair for pair in headers if pair[0] != _REQUEST_ID]
            await send(message)

        await self._app(scope, receive, send_without_id)


@serve.deployment(name="scene")
@serve.ingress()
class Replica:
    """One replica. Its settings are those of the environment."""

    def __serve_build_asgi_app__(self) -> ASGIApp:
        """Build the application. Ray Serve calls this method in the replica's process."""
        tune()
        settings = Settings()
        dictConfig(log_config(settings.log_level, settings.log_format, settings.secrets))
        app = create_app(settings)
        self._runtime = app.state.runtime
        return OneRequestId(app)

    def check_health(self) -> None:
        """Raise an error if the service is not ready. Ray Serve then replaces the replica."""
        self._runtime.check_ready()

    def __del__(self) -> None:
        """Refuse further requests. Ray Serve calls this method after the requests in progress."""
        self._runtime.drain()


app = Replica.bind()
