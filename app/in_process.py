"""An httpx transport that runs the service in the process of the client."""

import weakref
from contextlib import ExitStack
from pathlib import Path

import httpx
from anyio.from_thread import start_blocking_portal
from pydantic import ValidationError

from app.main import create_app
from app.settings import Settings
from scene_client.errors import InvalidRequestError


class _FixedSettings(Settings):
    """Settings without environment variables, which configure only separate processes."""

    reads_environment = False


class InProcess(httpx.BaseTransport):
    """Transport that runs the application on its own event loop in its own thread.

    Raises:
        InvalidRequestError: the store is not a directory.
    """

    def __init__(self, store: Path) -> None:
        """Start the application with the models of a store."""
        try:
            settings = _FixedSettings(
                store=store, metrics=False, access_log=False, docs=False, allowed_hosts=("*",)
            )
        except ValidationError:  # of the store, because all other values are fixed
            raise InvalidRequestError.about("the store must be an existing directory") from None
        app = create_app(settings)
        self._asgi = httpx.ASGITransport(app, raise_app_exceptions=False)
        with ExitStack() as stack:
            self._portal = stack.enter_context(start_blocking_portal(name="scene"))
            lifespan = app.router.lifespan_context(app)
            stack.enter_context(self._portal.wrap_async_context_manager(lifespan))
            # It ends the thread when the transport is closed or deleted, or at program exit.
            self._finalize = weakref.finalize(self, stack.pop_all().close)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send one request to the application and return its response."""
        future = self._portal.start_task_soon(self._answer, request)
        try:
            return future.result(request.extensions["timeout"]["read"])
        except TimeoutError:
            future.cancel()
            raise httpx.ReadTimeout("the timeout has expired", request=request) from None

    async def _answer(self, request: httpx.Request) -> httpx.Response:
        response = await self._asgi.handle_async_request(request)
        # The caller runs on another thread, so this event loop must read the whole body.
        body = await response.aread()
        return httpx.Response(response.status_code, headers=response.headers, content=body)

    def close(self) -> None:
        """End the application and its thread."""
        self._finalize()
