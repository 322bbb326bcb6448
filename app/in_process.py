"""An httpx transport that runs the service in the process of the client."""

from __future__ import annotations

import asyncio
import secrets
import weakref
from concurrent.futures import Future
from pathlib import Path
from threading import Thread

import httpx
from fastapi import FastAPI
from pydantic import SecretStr, ValidationError

from app.main import create_app
from app.settings import Settings
from scene_client.errors import InvalidRequestError


class _FixedSettings(Settings):
    """Settings without environment variables, which configure only separate processes."""

    reads_environment = False


class InProcess(httpx.BaseTransport):
    """Transport that runs the application on its own event loop in its own thread.

    Args:
        store: directory of published models.

    Attributes:
        admin_key: random key for the administration routes of this application.

    Raises:
        InvalidRequestError: the store is not a directory.
    """

    def __init__(self, store: Path) -> None:
        self.admin_key = secrets.token_hex()
        try:
            settings = _FixedSettings(
                store=store,
                admin_key=SecretStr(self.admin_key),
                metrics=False,
                access_log=False,
                docs=False,
                allowed_hosts=("*",),
            )
        except ValidationError:
            raise InvalidRequestError.about("the store must be an existing directory") from None
        app = create_app(settings)
        self._asgi = httpx.ASGITransport(app, raise_app_exceptions=False)
        started: Future[asyncio.AbstractEventLoop] = Future()
        ending = asyncio.Event()
        thread = Thread(target=_run, args=(app, started, ending), daemon=True, name="scene")
        thread.start()
        self._loop = started.result()
        # The finalizer ends the thread when the transport is closed or deleted, or at program exit.
        self._finalize = weakref.finalize(self, _stop, self._loop, ending, thread)

    def handle_request(self, request: httpx.Request) -> httpx.Response:
        """Send one request to the application and return its response."""
        future = asyncio.run_coroutine_threadsafe(self._answer(request), self._loop)
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


def _run(app: FastAPI, started: Future[asyncio.AbstractEventLoop], ending: asyncio.Event) -> None:
    """Run the application until ``ending`` is set. ``started`` receives the loop or the error."""

    async def run_until_end() -> None:
        async with app.router.lifespan_context(app):
            started.set_result(asyncio.get_running_loop())
            await ending.wait()

    try:
        asyncio.run(run_until_end())
    except BaseException as error:
        if started.done():
            raise
        started.set_exception(error)


def _stop(loop: asyncio.AbstractEventLoop, ending: asyncio.Event, thread: Thread) -> None:
    loop.call_soon_threadsafe(ending.set)
    thread.join()
